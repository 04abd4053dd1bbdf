"""The estimator refines the linear part by the ground, on simulated streets."""

import numpy as np
import pytest

from neurove_core.estimator import Estimator
from neurove_core.models import find
from neurove_core.sim.motion.trajectory import Trajectory, rotation, slider
from neurove_core.sim.render.camera import named_camera
from neurove_core.sim.simulate import simulate

SECONDS = 1.0


def last_errors(trajectory: Trajectory, seed: int, *, refine: bool) -> tuple[float, set[str]]:
    """Mean error of the linear velocity [m/s] in the last 0.4 s, and the sources of its estimates."""
    simulation = simulate("street", trajectory, named_camera("davis346-half", 1.0), seed=seed, seconds=SECONDS)
    estimates = list(Estimator(find("default"), refine=refine).estimates(simulation))[-8:]
    truth = simulation.trajectory.twist(0.5)[:3]
    errors = [np.linalg.norm(estimate.twists[:, :3] - truth, axis=1).mean() for estimate in estimates]
    return float(np.mean(errors)), {estimate.source for estimate in estimates}


@pytest.mark.parametrize(("trajectory", "seed"), [(slider(0, 0, 0.5, 2.0), 20001), (rotation(0, -0.5, 0, 2.0), 20009)])
def test_a_crawl_and_a_turn_in_place_are_mended(trajectory: Trajectory, seed: int) -> None:
    network, _ = last_errors(trajectory, seed, refine=False)
    refined, sources = last_errors(trajectory, seed, refine=True)
    assert refined < 0.25 * network
    assert refined < 0.15
    assert sources == {"refined"}
