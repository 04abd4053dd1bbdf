"""Real recordings with an inertial unit: cameras that do not move, and one that moves smoothly."""

import numpy as np
import pytest

from neurove_core import models
from neurove_core.estimator import Estimator
from neurove_core.evaluation.estimates import Estimates, estimate_recording
from neurove_core.sources import open_source
from tests.recordings import shared


def aided(path: str) -> Estimates:
    return estimate_recording(Estimator(models.find("default")), open_source(str(shared(path))), inertial=True)


@pytest.mark.parametrize("path", ["aedat4/davis346.aedat4", "aedat4/dvxplorer.aedat4"])
def test_a_camera_that_does_not_move_is_known_to_rest(path):
    """Bounds: 0.02 m/s and 0.005 rad/s; the first samples only tell that it rests."""
    found = aided(path)
    later = np.abs(found.twists[found.start_us >= found.start_us[0] + 450_000])
    assert len(later) >= 3
    assert later[..., :3].max() <= 0.02
    assert later[..., 3:].max() <= 0.005
    assert set(found.sources[1:]) == {"gyro"}


def test_a_camera_that_moves_smoothly_is_not_taken_for_one_that_rests():
    found = aided("aedat2/IMU_translBoxes.aedat")
    assert found.twists[1:].any(axis=(1, 2)).all()
