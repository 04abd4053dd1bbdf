"""The estimator refines the linear part by the ground, on simulated streets."""

import numpy as np
import pytest

from neurove_core.estimator import Estimator
from neurove_core.io.packets import slices
from neurove_core.models import find
from neurove_core.refine.stages import State
from neurove_core.sim.motion.trajectory import Trajectory, rotation, slider
from neurove_core.sim.render.camera import named_camera
from neurove_core.sim.simulate import Simulation, simulate
from neurove_core.stream_state import WindowEstimate

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


def followed(simulation: Simulation, odds: float, height_m: float | None) -> tuple[list[WindowEstimate], float]:
    """Estimates of a camera of this height that begins with these odds to be on a vehicle, and the odds at the end."""
    estimator, camera = Estimator(find("default"), refine=True), simulation.camera("cam0")
    assert camera is not None
    state = estimator.initial_state(simulation.sensor, camera.model_copy(update={"height_m": height_m}))
    state, found = state._replace(stages=State(odds=odds)), list[WindowEstimate]()
    for piece in slices(simulation.chunks()):
        result = estimator.push(piece.events, state, piece.t0_us)
        found, state = [*found, *result.estimates], result.state
    return found, state.stages.odds


def test_the_ground_gives_a_free_camera_its_velocity_but_no_turning_and_proves_a_vehicle_by_and_by() -> None:
    simulation = simulate("street", slider(0, 0, 0.5, 2.0), named_camera("davis346-half", 1.0), seed=20001, seconds=0.8)
    free, odds = followed(simulation, -8.0, 1.0)
    turning, _ = followed(simulation, 3.0, None)  # without a height there is no ground
    driving, _ = followed(simulation, 3.0, 1.0)
    assert -8 < odds < 0
    assert not any(one.vehicle for one in free + turning)
    assert [one.vehicle for one in driving] == sorted(one.vehicle for one in driving)  # not before the events show it
    assert not driving[0].vehicle
    assert driving[-1].vehicle
    steady = driving[-1]
    assert steady.covariance is not None
    assert steady.compared is not None  # what its rules compare
    shares = np.diagonal(steady.covariance) / np.diagonal(steady.compared)
    assert shares.max() < 1 + 1e-9
    assert shares.min() < 0.7  # steady answers are more certain
    for one, other, third in zip(free[-4:], turning[-4:], driving[-4:], strict=True):
        np.testing.assert_array_equal(one.twists[:, 3:], other.twists[:, 3:])
        assert not np.array_equal(one.twists[:, 3:], third.twists[:, 3:])
        assert np.linalg.norm(one.twists[:, :3] - [0, 0, 0.5], axis=1).max() < 0.2
        assert one.covariance is not None
        assert np.linalg.eigvalsh(one.covariance)[0] > 0
