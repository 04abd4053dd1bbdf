"""Contrast maximisation and the simulator are independent, and agree on the angular velocity of a camera."""

import numpy as np
import pytest

from neurove_core.evaluation.contrast import angular
from neurove_core.sources import open_source
from neurove_protocol.events import Events


@pytest.mark.parametrize(
    ("camera", "rate"),
    [("davis240c", (0.0, 1.5, 0.0)), ("davis346-half", (1.0, -0.5, 2.0)), ("davis240c", (-0.7, 0.9, -1.2))],
)
def test_contrast_maximisation_finds_the_rate_of_a_simulated_rotation(camera, rate):
    trajectory = "%26".join(f"w{axis}={value}" for axis, value in zip("xyz", rate, strict=True))
    recording = open_source(f"sim://room?camera={camera}&pitch=0&seconds=0.3&trajectory=rotation?{trajectory}")
    np.testing.assert_allclose(recording.twists().at(np.array([150_000]))[0, 3:], rate, atol=1e-9)
    events = Events.join(list(recording.since(100_000)))
    speed = float(np.linalg.norm(rate))
    first, stop = events.t.searchsorted([100_000, 100_000 + round(1e6 * min(0.1, 0.2 / speed))])
    found = angular(events.span(int(first), int(stop)), recording.camera("cam0"))
    assert np.linalg.norm(np.array(found.w_rad_s) - rate) < 0.02 * speed
