"""Linear velocity by the ground: laws on points of a plane, and agreement of the compiled loops with numpy."""

import math

import numpy as np
import pytest
from numpy.typing import NDArray

from neurove_core.geometry import rotations
from neurove_core.refine import ground_kernels as kernels
from neurove_core.refine.ground import (
    LEAST_EVENTS,
    MAX_SIGMAS,
    PITCH,
    SPAN_US,
    Answer,
    GroundEvents,
    GroundState,
    image_of,
    on_ground,
    rays_of,
    refine,
)
from neurove_core.refine.ground_search import Prior, climb, objective
from neurove_core.refine.late import ANSWERS
from neurove_protocol import CameraInfo

Array = NDArray[np.float64]

WINDOW_US = 50_000
LENS = {"width": 172, "height": 130, "lens": "pinhole", "fx": 112.0, "fy": 112.0, "cx": 85.5, "cy": 64.5}
SIGMA_RAD_S = np.full(3, 0.05)


def camera(height_m: float | None = 1.0) -> CameraInfo:
    return CameraInfo.model_validate({"stream": "cam0", "height_m": height_m, **LENS})


def ahead(speed_m_s: float, pitch: float = PITCH, yaw_rad_s: float = 0.0) -> Array:
    """The twist of a camera that drives ahead on level ground and turns about its vertical."""
    c, s = math.cos(pitch), math.sin(pitch)
    return np.array([0.0, -s * speed_m_s, c * speed_m_s, 0.0, c * yaw_rad_s, s * yaw_rad_s])


def seen(
    twist: Array, start_us: int, *, height_m: float = 1.0, pitch: float = PITCH, points: int = 400, wall: int = 0
) -> GroundEvents:
    """A window of events of random points on the ground, and of a wall 3 m to the right, rounded to pixels."""
    rng = np.random.default_rng(0)
    c, s = math.cos(pitch), math.sin(pitch)
    right = np.append(rng.uniform(-3, 3, points), np.full(wall, 3.0))
    down = np.append(np.full(points, height_m), rng.uniform(-2, height_m, wall))
    far = np.append(rng.uniform(0.5, 12, points), rng.uniform(2, 9, wall))
    # in the axes of the camera at time 0; every point is seen 12 times in each window
    world = np.repeat(np.stack([right, c * down - s * far, s * down + c * far], axis=1), 12, axis=0)
    t_us = start_us + np.random.default_rng(start_us).integers(0, WINDOW_US, world.shape[0])
    world, t_us = world[np.argsort(t_us, kind="stable")], np.sort(t_us)
    orientation, position = rotations.pose_of(t_us[:, None] / 1e6 * twist)
    x, y, z = rotations.turn(rotations.inverse(orientation), world - position).T
    with np.errstate(divide="ignore", invalid="ignore"):
        u, v = np.rint(x / z * 112 + 85.5), np.rint(y / z * 112 + 64.5)
    inside = (z > 0.1) & (u >= 0) & (u < 172) & (v >= 0) & (v < 130)
    columns = (((side - centre) / 112)[inside].astype(np.float32) for side, centre in ((u, 85.5), (v, 64.5)))
    return GroundEvents(*columns, t_us[inside])


def answer(twist: Array, known: Array, *, windows: int = 6, height_m: float | None = 1.0, **scene: float) -> Answer:
    """The last answer after some windows of a constant twist, with a constant estimate known before."""
    state = GroundState()
    for number in range(windows):
        start_us = number * WINDOW_US
        events = seen(twist, start_us, height_m=height_m or 1.0, **scene)  # type: ignore[arg-type]
        found = refine(events, start_us, start_us + WINDOW_US, camera(height_m), known, SIGMA_RAD_S, state)
        state = found.state
    return found


@pytest.mark.parametrize(("speed", "known"), [(0.3, 1.1), (0.5, 1.1), (1.0, 1.3), (2.0, 1.8), (4.0, 3.4)])
def test_a_wrong_speed_is_mended_from_a_crawl_to_a_drive(speed: float, known: float) -> None:
    found = answer(ahead(speed), ahead(known))
    assert found.outcome == "accepted"
    assert found.motion is not None
    assert np.linalg.norm(found.motion.twist[:3] - ahead(speed)[:3]) < max(0.05 * speed, 0.1)


@pytest.mark.parametrize("phantom", [0.5, 1.4])
def test_a_camera_that_turns_in_place_does_not_move(phantom: float) -> None:
    truth = ahead(0.0, yaw_rad_s=0.5)
    found = answer(truth, truth + ahead(phantom))
    assert found.motion is not None
    assert np.linalg.norm(found.motion.twist[:3]) < 0.1


def test_a_wall_at_the_side_is_not_taken_for_ground() -> None:
    found = answer(ahead(1.0), ahead(1.4), wall=200)
    assert found.motion is not None
    assert np.linalg.norm(found.motion.twist[:3] - ahead(1.0)[:3]) < 0.1


def test_the_speed_is_proportional_to_the_height() -> None:
    high, unknown = (answer(ahead(2.0), ahead(1.6), height_m=2.0), answer(ahead(1.0), ahead(0.8), height_m=None))
    assert high.motion is not None
    assert unknown.motion is not None
    assert high.motion.twist[2] == pytest.approx(2.0, abs=0.1)
    assert unknown.motion.twist[2] == pytest.approx(1.0, abs=0.05)


@pytest.mark.parametrize("pitch_deg", [1.0, 9.0])
def test_an_unknown_pitch_is_approached(pitch_deg: float) -> None:
    pitch = math.radians(pitch_deg)
    short, long = (answer(ahead(4.0, pitch), ahead(4.0), windows=n, pitch=pitch).state for n in (6, 16))
    wrong = [abs(found - pitch) for found in (PITCH, short.pitch, long.pitch)]
    assert wrong[2] < wrong[1] < wrong[0]
    assert long.pitch_sigma < short.pitch_sigma


def test_without_events_on_the_ground_there_is_no_answer() -> None:
    events = seen(ahead(1.0), 0)
    few = GroundEvents(*(column[: LEAST_EVENTS // 2] for column in events))
    found = refine(few, 0, WINDOW_US, camera(), ahead(1.0), SIGMA_RAD_S, GroundState())
    assert (found.outcome, found.motion) == ("few events", None)


def test_without_events_on_the_ground_only_the_turning_is_known() -> None:
    turning, state = ahead(0.0, yaw_rad_s=0.2), GroundState()
    for number in range(6):
        start_us = number * WINDOW_US
        events = seen(turning, start_us, wall=600)
        far = events.y < -0.15
        events = GroundEvents(*(column[far] for column in events))
        found = refine(events, start_us, start_us + WINDOW_US, camera(), ahead(0.0), SIGMA_RAD_S, state)
        state = found.state
    assert found.outcome == "turning"
    assert found.motion is not None
    assert found.motion.twist[4] == pytest.approx(0.2, abs=0.05)
    assert state.last is None


@pytest.mark.parametrize("events", [1000, 20_000])
def test_noise_of_a_stationary_camera_is_not_taken_for_motion(events: int) -> None:
    rng, state = np.random.default_rng(events), GroundState()
    for number in range(5):
        start_us = number * WINDOW_US
        u, v = rng.integers(0, 172, events), rng.integers(0, 130, events)
        x, y = ((side - centre) / np.float32(112) for side, centre in ((u, 85.5), (v, 64.5)))
        t_us = np.sort(rng.integers(start_us, start_us + WINDOW_US, events))
        noise = GroundEvents(x.astype(np.float32), y.astype(np.float32), t_us)
        found = refine(noise, start_us, start_us + WINDOW_US, camera(), ahead(0.1), SIGMA_RAD_S, state)
        state = found.state
        assert found.outcome == "noise"


def test_a_camera_that_pitches_is_not_refined_until_it_has_been_calm() -> None:
    truth = ahead(1.0)
    pitching = truth + np.array([0.0, 0, 0, 0.4, 0, 0])
    state, outcomes = GroundState(), []
    for number, known in enumerate([truth, pitching, *[truth] * 5]):
        start_us = number * WINDOW_US
        found = refine(seen(truth, start_us), start_us, start_us + WINDOW_US, camera(), known, SIGMA_RAD_S, state)
        state = found.state
        outcomes.append(found.outcome)
    assert outcomes == ["accepted", *["tilting"] * 4, "accepted", "accepted"]


@pytest.mark.parametrize(
    ("wild", "measured", "outcomes"),
    [
        (1, None, ["accepted"] * 3),
        (2, None, ["accepted", "tilting", "tilting"]),
        (1, np.eye(3) * 1e-4, ["tilting"] * 3),
    ],
)
def test_one_window_in_which_only_the_network_tilts_a_vehicle_is_searched(
    wild: int, measured: Array | None, outcomes: list[str]
) -> None:
    truth, state, found = ahead(2.0), GroundState(), []
    tilting = truth + np.array([0.0, 0, 0, -0.3, 0, -0.2])
    for number in range(ANSWERS + 3):
        known = tilting if 0 <= number - ANSWERS < wild else truth
        window = seen(truth, number * WINDOW_US), number * WINDOW_US, (number + 1) * WINDOW_US
        one = refine(*window, camera(), known, SIGMA_RAD_S, state, measured if known is tilting else None)
        state, found = one.state, [*found, one]
    assert [one.outcome for one in found[ANSWERS:]] == outcomes
    for one in found[ANSWERS:]:
        if one.outcome == "accepted":
            assert one.motion is not None
            np.testing.assert_allclose(one.motion.twist[3:], 0.0, atol=0.03)


def test_a_vehicle_that_does_tilt_is_not_searched_further() -> None:
    level, tilting = ahead(2.0), ahead(2.0) + np.array([0.0, 0, 0, 0.5, 0, 0.3])
    state, outcomes = GroundState(), []
    for number in range(ANSWERS + 3):
        truth = tilting if number >= ANSWERS else level
        window = seen(truth, number * WINDOW_US), number * WINDOW_US, (number + 1) * WINDOW_US
        found = refine(*window, camera(), truth, SIGMA_RAD_S, state)
        state, outcomes = found.state, [*outcomes, found.outcome]
    assert outcomes[-2:] == ["tilting", "tilting"]


def test_an_answer_is_accepted_exactly_where_it_is_not_too_far_from_what_is_known() -> None:
    truth, state = ahead(2.0), GroundState()
    for number, aside, accepted in ((0, 0, True), (1, 0, True), (2, 0, True), (3, 0, True), (4, 2.0, False)):
        start_us = number * WINDOW_US
        known = truth + np.array([aside, 0, 0, 0, 0, 0])
        found = refine(seen(truth, start_us), start_us, start_us + WINDOW_US, camera(), known, SIGMA_RAD_S, state)
        state = found.state
        assert found.motion is not None
        assert (found.outcome == "accepted", found.motion.distance < MAX_SIGMAS) == (accepted, accepted)


def test_an_angular_velocity_that_other_events_contradict_is_not_accepted() -> None:
    truth, measured, outcomes = ahead(2.0), np.eye(3) * 0.02**2, []
    for pitching in (0.0, 0.12):
        known, state = truth + np.array([0, 0, 0, pitching, 0, 0]), GroundState()
        for number in range(5):
            start_us = number * WINDOW_US
            events = seen(truth, start_us)
            found = refine(events, start_us, start_us + WINDOW_US, camera(), known, SIGMA_RAD_S, state, measured)
            state = found.state
        outcomes.append(found.outcome)
    assert outcomes == ["accepted", "contradicted"]


def test_a_gap_discards_older_events_and_the_same_windows_give_the_same_answer() -> None:
    truth = ahead(1.0)
    first = refine(seen(truth, 0), 0, WINDOW_US, camera(), truth, SIGMA_RAD_S, GroundState())
    later = 10 * WINDOW_US
    after = refine(seen(truth, 0), later, later + WINDOW_US, camera(), truth, SIGMA_RAD_S, first.state)
    assert len(after.state.recent) == 1
    again, same = answer(truth, ahead(1.3)), answer(truth, ahead(1.3))
    assert again.motion is not None
    assert same.motion is not None
    np.testing.assert_array_equal(again.motion.twist, same.motion.twist)
    np.testing.assert_array_equal(again.motion.covariance, same.motion.covariance)


def test_more_events_make_the_answer_more_certain() -> None:
    sigmas = []
    for points in (25, 400):
        motion = answer(ahead(1.0), ahead(1.2), points=points).motion
        assert motion is not None
        assert np.linalg.eigvalsh(motion.covariance).min() > 0
        sigmas.append(float(np.sqrt(np.trace(motion.covariance[:3, :3]))))
    assert sigmas[1] < sigmas[0]


@pytest.fixture
def rays() -> tuple[kernels.Rays, kernels.Image]:
    image = image_of(camera())
    events = on_ground([seen(ahead(1.0), k * WINDOW_US, wall=100) for k in range(4)], PITCH)
    return rays_of(events, SPAN_US // 2, PITCH, image), image


@pytest.mark.parametrize("seed", range(5))
def test_compiled_sharpness_equals_the_reference(seed: int, rays: tuple[kernels.Rays, kernels.Image]) -> None:
    motion = np.random.default_rng(seed).normal(size=9) * [0.3, 0.3, 2, 0.2, 0.4, 0.2, 0.03, 0.1, 0.1]
    value, _ = kernels.sharpness(rays[0], motion, rays[1])
    assert value == pytest.approx(kernels.sharpness_reference(rays[0], motion, rays[1]), rel=1e-4)


@pytest.mark.parametrize("seed", range(3))
def test_the_compiled_second_derivatives_equal_the_reference(
    seed: int, rays: tuple[kernels.Rays, kernels.Image]
) -> None:
    motion = ahead(1.0)
    motion = np.append(motion, np.zeros(3)) + np.random.default_rng(seed).normal(size=9) * 0.01
    value, gradient, second = kernels.sharpness_and_bend(rays[0], motion, rays[1])
    same, slope = kernels.sharpness(rays[0], motion, rays[1])
    assert value == same
    np.testing.assert_array_equal(gradient, slope)
    reference = kernels.bend_reference(rays[0], motion, rays[1])
    size = np.sqrt(np.abs(np.diagonal(reference))) + 1e-9  # no wall on the left: zeros
    scale = np.outer(size, size)
    np.testing.assert_allclose(
        second / scale, reference / scale, atol=0.05
    )  # it leaves the change of z in the turn out


def test_the_search_ends_at_a_maximum_in_few_steps(rays: tuple[kernels.Rays, kernels.Image]) -> None:
    mean, sigma = np.array([0.0, 0, 1.3, *[0.0] * 6]), np.array([0.3, 0.1, 0.8, *[0.05] * 3, 0.03, 0.1, 0.1])
    prior = Prior(mean, sigma, 0.02, PITCH)
    found = climb(np.zeros(9), rays[0], rays[1], prior, 20, 0.02)
    assert found.evaluations < 15
    assert found.value > objective(np.zeros(9), rays[0], rays[1], prior)[0]
    for step in 0.3 * np.vstack([np.eye(9), -np.eye(9)]):
        assert objective(found.z + step, rays[0], rays[1], prior)[0] < found.value + 1e-3
    assert mean[2] + sigma[2] * found.z[2] == pytest.approx(1.0, abs=0.05)


def test_pitching_is_seen_by_walls_ahead() -> None:
    still, pitching = ahead(4.0), ahead(4.0) + np.array([0.0, 0, 0, 0.06, 0, 0])
    rates = []
    for truth in (still, pitching):
        found = answer(truth, still, wall=400)
        assert found.outcome == "accepted"
        assert found.motion is not None
        rates.append(found.motion.twist[3])
    assert abs(rates[0]) < 0.02
    assert rates[1] - rates[0] > 0.01  # a rate that stays is drawn to zero


def test_a_slow_camera_is_seen_for_a_longer_time() -> None:
    events = []
    for speed, windows in ((0.3, 4), (0.3, 9), (3.0, 4), (3.0, 9)):
        motion = answer(ahead(speed), ahead(speed), windows=windows, points=60).motion
        assert motion is not None
        events.append(motion.events)
    assert events[1] > 1.5 * events[0]
    assert events[3] < 1.5 * events[2]


@pytest.mark.parametrize("seed", range(3))
def test_the_gradient_is_that_of_the_objective(seed: int, rays: tuple[kernels.Rays, kernels.Image]) -> None:
    rng = np.random.default_rng(seed)
    mean, sigma = np.array([0.0, 0, 1, 0, 0.1, 0, 0, 0, 0]), np.array([0.3, 0.1, 0.8, *[0.1] * 3, 0.05, 0.1, 0.1])
    prior = Prior(mean, sigma, 0.02, PITCH)
    z, along = rng.normal(size=9), rng.normal(size=9)
    _, gradient = objective(z, rays[0], rays[1], prior)
    # bilinear weights have kinks, so the difference is a mean over a small stretch
    slopes = [objective(z + s * along, rays[0], rays[1], prior)[1] @ along for s in np.linspace(0, 0.02, 21)]
    rise = objective(z + 0.02 * along, rays[0], rays[1], prior)[0] - objective(z, rays[0], rays[1], prior)[0]
    assert rise / 0.02 == pytest.approx(np.mean(slopes), rel=0.02, abs=2e-3)
    assert np.isfinite(gradient).all()


def test_compiled_crowding_equals_the_reference(rays: tuple[kernels.Rays, kernels.Image]) -> None:
    x, y, image = rays[0].x, rays[0].y, rays[1]
    np.testing.assert_array_equal(kernels.crowding(x, y, image, 2), kernels.crowding_reference(x, y, image, 2))
