"""A camera that translates in front of a scene with depth: its direction and turning are found, and rest stays rest."""

import itertools

import numpy as np
import pytest

from neurove_core.ingest.sample import Sample
from neurove_core.refine import rotation, scene, stages
from neurove_core.refine.alignment import Grid, Rays
from neurove_core.refine.rotation import Given
from neurove_core.refine.stages import State
from neurove_core.refine.view import View
from tests.neurove_core.evaluation.test_contrast import seen
from tests.neurove_core.geometry.test_geometry import ECD

VIEW = View.of(ECD)
WINDOW_US = 50_000
STILL = np.zeros(3)
UNSURE = np.diag([1.0, 1.0, 1.0, 0.1, 0.1, 0.1]) ** 2


def events_of(v, w, windows, slope=0.4, points=700):
    """Samples of windows before a slanted plane at 2 m for a camera with this velocity [m/s] and turning [rad/s]."""
    rng = np.random.default_rng(5)
    ray = rng.uniform([-1.0, -0.8], [1.0, 0.8], (points, 2))
    depth = 2.0 / (1 + slope * ray[:, 0])
    place = np.column_stack([ray, np.ones(points)]) * depth[:, None]
    t_us = np.arange(0, windows * WINDOW_US, 400)
    # exact for the small turns here: points move by -(v + w x p) dt
    at, steps = place.copy(), []
    for _ in t_us:
        steps.append(at)
        at = at - (np.asarray(v) + np.cross(w, at)) * 400e-6
    events = seen(ECD, np.stack(steps, 1), t_us)
    edges = np.searchsorted(events.t, events.t[0] // WINDOW_US * WINDOW_US + np.arange(windows + 1) * WINDOW_US)
    parts = [slice(*edge) for edge in itertools.pairwise(edges)]
    return [Sample((events.t[p] % WINDOW_US).astype(np.int32), events.x[p], events.y[p]) for p in parts]


FREE = State(odds=-1.0)
"""Of a camera that the ground did not explain."""


def refined(samples, twist=(0.0,) * 6, state=FREE, **fields):
    """Answers of `stages.refine` for windows in a row."""
    found = []
    for number, sample in enumerate(samples):
        known = {"covariance": UNSURE, "low_activity": False, "before": None} | fields
        one = stages.refine(Given(number * WINDOW_US, WINDOW_US, sample, VIEW, np.array(twist, float), **known), state)
        found, state = [*found, one], one.state
    return found


@pytest.mark.parametrize(
    ("v", "w"), [((0.6, 0.0, 0.0), STILL), ((-0.4, 0.4, 0.2), STILL), ((0.6, 0.2, 0.0), np.array([0.0, 0.0, 0.25]))]
)
def test_a_slide_before_a_slanted_plane_is_told_from_a_turn(v, w):
    last = refined(events_of(v, w, 16))[-1]
    assert last.velocity is not None
    cosine = last.velocity.v_m_s @ v / np.linalg.norm(last.velocity.v_m_s) / np.linalg.norm(v)
    assert np.degrees(np.arccos(cosine)) < 30
    assert np.linalg.norm(last.turn.rate.w_rad_s - w) < 0.07
    assert not last.level  # no vehicle moves aside


def test_a_camera_that_turns_only_keeps_the_answer_of_the_rotation():
    w = np.array([0.1, -0.5, 0.2])
    found = refined(events_of(STILL, w, 8), twist=np.append(STILL, 0.7 * w))
    assert all(one.velocity is None and one.level for one in found)
    assert np.linalg.norm(found[-1].turn.rate.w_rad_s - w) < 0.05


def test_events_of_noise_show_no_motion():
    rng = np.random.default_rng(3)
    samples = []
    for _ in range(10):
        n = int(rng.integers(1000, 9000))
        t_us = np.sort(rng.integers(0, WINDOW_US, n)).astype(np.int32)
        samples.append(
            Sample(t_us, rng.integers(0, 240, n).astype(np.uint16), rng.integers(0, 180, n).astype(np.uint16))
        )
    found = refined(samples)
    assert all(one.velocity is None and one.level for one in found)
    assert all(one.turn.outcome != "accepted" for one in found)


def test_a_vehicle_that_drives_fast_is_not_searched():
    found = refined(events_of((0.6, 0.0, 0.0), STILL, 8), twist=np.array([0.0, 0, 8, 0, 0, 0]), covariance=UNSURE / 100)
    assert all(one.state.scene is None for one in found)


def test_on_a_vehicle_no_scene_is_searched_and_the_rotation_is_that_of_the_rotation_alone():
    samples = events_of((0.6, 0.0, 0.0), STILL, 6)
    found = refined(samples, state=State())
    assert all(one.velocity is None and one.level and one.state.scene is None for one in found)
    before = None
    for number, (one, sample) in enumerate(zip(found, samples, strict=True)):
        given = Given(number * WINDOW_US, WINDOW_US, sample, VIEW, np.zeros(6), UNSURE, False, before)
        alone = rotation.refine(given)
        before = alone.filter
        np.testing.assert_array_equal(one.turn.rate.w_rad_s, alone.rate.w_rad_s)


def test_a_camera_that_is_taken_from_its_vehicle_is_noticed_and_one_that_is_put_back_as_well():
    state = State()
    for _ in range(200):
        state = state.after_ground("accepted")
    for _ in range(20):  # it is turned and tilted in a hand
        state = state.after_ground("tilting")
    samples = events_of((0.6, 0.0, 0.0), STILL, 16)
    assert refined(samples, state=state)[-1].velocity is not None
    for _ in range(100):
        state = state.after_ground("accepted")
    assert refined(samples, state=state)[-1].velocity is None


def test_a_few_refused_windows_do_not_take_a_camera_from_its_vehicle():
    state = State()
    for outcome in ("noise", "few events", "accepted", "contradicted", "accepted", "tilting", "accepted", "noise"):
        state = state.after_ground(outcome)
    assert refined(events_of((0.6, 0.0, 0.0), STILL, 2), state=state)[-1].state.scene is None


def test_without_a_height_a_scene_is_searched_only_where_the_parts_of_the_image_disagree():
    turning = events_of(STILL, np.array([0.1, -0.5, 0.2]), 8)
    assert any(one.state.scene is not None for one in refined(turning))
    assert all(one.state.scene is None for one in refined(turning, state=State(), knows_height=False))


def test_a_motion_in_a_scene_is_no_steady_turn_that_outweighs_a_fast_vehicle():
    samples = events_of((0.6, 0.0, 0.0), STILL, 16)
    state = refined(samples)[-1].state
    assert state.idle == 0
    fast = np.array([0.0, 0, 8, 0, 0, 0])
    start_us = state.scene.end_us
    one = stages.refine(Given(start_us, WINDOW_US, samples[-1], VIEW, fast, UNSURE / 100, False, None), state)
    assert one.velocity is None
    assert one.turn.outcome != "accepted"


def test_a_gap_forgets_the_scene():
    samples = events_of((0.6, 0.0, 0.0), STILL, 16)
    state = refined(samples)[-1].state
    assert state.scene is not None
    assert state.scene.moves
    known = UNSURE, False, None
    late = Given(10**9, WINDOW_US, samples[0], VIEW, np.zeros(6), *known)
    assert stages.refine(late, state).velocity is None


def test_the_covariance_is_positive():
    for one in refined(events_of((0.3, 0.3, 0.3), np.array([0.2, 0.0, 0.1]), 16)):
        assert np.linalg.eigvalsh(one.turn.rate.covariance)[0] > 0
        assert one.velocity is None or np.linalg.eigvalsh(one.velocity.covariance)[0] > 0
        assert one.state.scene is None or np.linalg.eigvalsh(one.state.scene.covariance)[0] > 0


def test_the_depth_at_the_events_equals_its_reference():
    rng = np.random.default_rng(0)
    grid = Grid(80.0, -0.75, -0.55, 120, 88)
    x, y = rng.uniform([-0.9, -0.7], [0.9, 0.7], (500, 2)).T.astype(np.float32)
    rays = Rays(x, y, np.zeros_like(x), np.ones_like(x))
    depth = rng.uniform(-0.2, 2.0, scene.ROWS * scene.COLUMNS)
    np.testing.assert_allclose(scene.near(rays, depth, grid), scene.near_reference(rays, depth, grid), atol=1e-4)
