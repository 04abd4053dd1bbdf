"""Contrast maximisation finds the motion of synthetic events, and that of real cameras."""

import numpy as np
import pytest

from neurove_core.evaluation.contrast import accumulate, accumulate_reference, angular, image_grid, planar
from neurove_core.geometry import rotations
from neurove_core.geometry.camera import distort
from neurove_core.io.formats.ecd import DAVIS240C, parse_calib
from neurove_core.sources import open_source
from neurove_protocol import CameraInfo, Events
from neurove_protocol.errors import InvalidField
from tests.neurove_core.geometry.test_geometry import ECD, MVSEC
from tests.recordings import shared


def seen(camera: CameraInfo, directions: np.ndarray, t_us: np.ndarray) -> Events:
    """Make an event whenever a point (N, T, 3), in the frame of the camera at the times (T,), enters a pixel."""
    x, y, z = np.moveaxis(directions, -1, 0)
    front = z > 0.2
    xd, yd = distort(x / np.where(front, z, 1), y / np.where(front, z, 1), camera)
    u, v = np.rint(xd * camera.fx + camera.cx), np.rint(yd * camera.fy + camera.cy)
    inside = front & (u >= 0) & (u < camera.width) & (v >= 0) & (v < camera.height)
    entered = inside[:, 1:] & ((np.diff(u, axis=1) != 0) | (np.diff(v, axis=1) != 0))
    point, step = np.nonzero(entered)
    order = np.argsort(step, kind="stable")
    point, step = point[order], step[order] + 1
    return Events.from_columns(t_us[step], u[point, step], v[point, step], point % 2)


def of_rotation(camera: CameraInfo, w: np.ndarray, seconds: float, seed: int = 0, points: int = 800) -> Events:
    """Events of points at infinity for a camera with a constant angular velocity."""
    far = np.random.default_rng(seed).uniform([-1.5, -1.2, 1], [1.5, 1.2, 1], (points, 3))
    t_us = np.arange(0, round(seconds * 1e6), 100)
    back = rotations.exp(-w * (t_us / 1e6)[:, None])
    return seen(camera, rotations.turn(back, far[:, None, :]), t_us)


def of_slide(camera: CameraInfo, velocity_per_depth: np.ndarray, seconds: float, points: int = 800) -> Events:
    """Events of points on a plane for a camera that moves along it."""
    plane = np.random.default_rng(1).uniform([-1.5, -1.2, 1], [1.5, 1.2, 1], (points, 3))
    t_us = np.arange(0, round(seconds * 1e6), 100)
    moved = np.append(velocity_per_depth, 0.0) * (t_us / 1e6)[:, None]
    return seen(camera, plane[:, None, :] - moved, t_us)


def ecd(path: str, calib: str) -> tuple[Events, CameraInfo]:
    lens = parse_calib(shared(calib), shared(calib).read_bytes(), DAVIS240C)
    return Events.join(list(open_source(str(shared(path))).chunks())), lens


@pytest.mark.parametrize("camera", [ECD, MVSEC], ids=lambda camera: camera.stream)
@pytest.mark.parametrize("w", [(0.5, 0, 0), (0, -3, 0), (0.3, 0.4, 2), (1.8, -0.6, 1.4), (-1.3, -5.4, 8)], ids=str)
def test_the_rate_of_a_turning_camera_is_found_within_two_percent_through_its_lens(camera, w):
    w = np.array(w)
    found = angular(of_rotation(camera, w, min(0.1, 0.25 / np.linalg.norm(w))), camera)
    assert np.linalg.norm(found.w_rad_s - w) < 0.02 * np.linalg.norm(w)
    assert found.contrast > 1.2 * found.contrast_stationary


@pytest.mark.parametrize("velocity", [(0.35, 0.0), (-0.8, 0.5), (0.1, -1.5)], ids=str)
def test_the_velocity_over_depth_of_a_sliding_camera_is_found_and_the_image_moves_the_other_way(velocity):
    found = planar(of_slide(ECD, np.array(velocity), 0.1), ECD)
    np.testing.assert_allclose(found.velocity_per_depth, velocity, atol=0.025 * np.linalg.norm(velocity))
    np.testing.assert_allclose(found.flow_px_s, -np.array(velocity) * [ECD.fx, ECD.fy], rtol=0.1, atol=3)
    assert found.contrast > 1.2 * found.contrast_stationary


def test_random_events_have_no_motion_of_higher_contrast():
    rng = np.random.default_rng(2)
    n = 20_000
    t = np.sort(rng.integers(0, 50_000, n))
    found = angular(
        Events.from_columns(t, rng.integers(0, 240, n), rng.integers(0, 180, n), rng.integers(0, 2, n)), ECD
    )
    assert found.contrast < 1.1 * found.contrast_stationary


def test_a_given_start_finds_a_motion_too_fast_for_the_default_starts():
    w = np.array([0.2, 5.0, -0.5])
    events = of_rotation(ECD, w, 0.15)
    found = angular(events, ECD, start=w * 0.8)
    np.testing.assert_allclose(found.w_rad_s, w, atol=0.02 * 5)
    slide = planar(of_slide(ECD, np.array([1.0, 0.0]), 0.1), ECD, start=np.array([-150.0, 10.0]))
    np.testing.assert_allclose(slide.velocity_per_depth, [1, 0], atol=0.02)


def test_the_result_does_not_depend_on_the_absolute_time_of_the_events():
    events = of_rotation(ECD, np.array([1.0, -0.6, 1.4]), 0.05)
    later = events._replace(t=events.t + 1_500_000_000_000_000)
    np.testing.assert_array_equal(angular(later, ECD).w_rad_s, angular(events, ECD).w_rad_s)


@pytest.mark.parametrize("turning", [True, False])
def test_the_compiled_image_of_moved_events_equals_the_reference(turning):
    rng = np.random.default_rng(3)
    x, y, time = rng.uniform(-1, 1, (3, 5_000))
    grid = image_grid(ECD, 2, 1.0, turning)
    for rate in (np.zeros(3), np.array([0.1, -0.3, 0.2]), np.array([1.0, 0.5, -1.0])):
        image, plain = np.zeros((2, grid.height, grid.width))
        accumulate(x, y, time, rate, grid, image)
        accumulate_reference(x, y, time, rate, grid, plain)
        np.testing.assert_allclose(image, plain, atol=1e-9)
        assert image.sum() > 1_000


@pytest.mark.parametrize("estimate", [angular, planar])
def test_too_few_events_are_refused(estimate):
    for events in (
        Events.empty(),
        Events.from_columns([5], [1], [1], [1]),
        Events.from_columns([5] * 9, [1] * 9, [1] * 9, [1] * 9),
    ):
        with pytest.raises(InvalidField, match="two different times"):
            estimate(events, ECD)
    with pytest.raises(InvalidField, match="240x180"):
        estimate(Events.from_columns([1, 2], [240, 1], [1, 1], [1, 1]), ECD)


# --- real cameras ---------------------------------------------------------------------------------------------------


def gyro(start_us: int, stop_us: int) -> np.ndarray:
    """Mean rate (3,) of the gyro of shapes_rotation, less its bias at rest in the first 0.6 s."""
    t_s, *_, wx, wy, wz = np.loadtxt(shared("ecd/shapes_rotation/imu.txt")).T
    rate = np.stack([wx, wy, wz], axis=1)
    within = (t_s >= start_us / 1e6) & (t_s < stop_us / 1e6)
    return rate[within].mean(0) - rate[t_s < 0.6].mean(0)


def test_the_rate_of_a_real_camera_agrees_with_its_gyro():
    events, camera = ecd("ecd/shapes_rotation/events.txt", "ecd/shapes_rotation/calib.txt")
    found, true = angular(events, camera), gyro(events.t[0], events.t[-1])
    assert np.linalg.norm(found.w_rad_s - true) < 0.2 * np.linalg.norm(true)  # the rate doubles within these 106 ms
    assert found.contrast > 1.5 * found.contrast_stationary


def test_the_rate_of_a_real_camera_agrees_with_another_implementation():
    found, estimate = (
        angular(*ecd("ecd/boxes_rotation/events.txt", "ecd/boxes_rotation/calib.txt")),
        (3.66, 4.16, -1.72),
    )
    assert np.linalg.norm(found.w_rad_s - estimate) < 0.08 * np.linalg.norm(estimate)
    assert found.contrast > 1.03 * found.contrast_stationary


def test_the_yaw_of_a_real_camera_follows_its_gyro():
    events, camera = ecd("ecd/shapes_rotation_1.43s.txt", "ecd/shapes_rotation/calib.txt")
    starts = range(650_000, 1_400_000, 50_000)
    spans = [events.t.searchsorted([start, start + 50_000]) for start in starts]
    found = np.array([angular(events.span(int(a), int(b)), camera).w_rad_s[1] for a, b in spans])
    true = np.array([gyro(start, start + 50_000)[1] for start in starts])
    assert np.corrcoef(found, true)[0, 1] > 0.99
    assert np.sqrt(((found - true) ** 2).mean()) < 0.07


def test_the_real_slider_moves_the_image_at_its_known_speed_over_the_depth_of_the_scene():
    events, camera = ecd("slider_depth/events_chunk.txt", "slider_depth/calib.txt")
    found = planar(events, camera)
    assert found.flow_px_s[0] == pytest.approx(-110, abs=8)
    assert abs(found.flow_px_s[1]) < 10
    assert 0.29 / found.velocity_per_depth[0] == pytest.approx(0.9, abs=0.1)  # depth [m]
    assert found.contrast > 1.1 * found.contrast_stationary
