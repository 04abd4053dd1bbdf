"""Camera models: a ray falls in one cell of the canonical camera, independent of lens and sensor."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from neurove_core.config import CanonicalConfig
from neurove_core.geometry.camera import OUTSIDE, distort, field_of_view_deg, focal_px, lookup_table, undistort
from neurove_protocol import CameraInfo, Sensor
from neurove_protocol.errors import InvalidField

CANONICAL = CanonicalConfig()
ECD = CameraInfo(
    stream="ecd",
    width=240,
    height=180,
    lens="pinhole",
    fx=199.09,
    fy=198.83,
    cx=132.19,
    cy=110.71,
    distortion=(-0.368436, 0.150947, -0.000296, -0.000759),
)
MVSEC = CameraInfo(
    stream="mvsec",
    width=346,
    height=260,
    lens="equidistant",
    fx=226.38,
    fy=226.15,
    cx=173.65,
    cy=133.73,
    distortion=(-0.048, 0.011, -0.055, 0.021),
)
PERFECT = CameraInfo(stream="p", width=640, height=480, lens="pinhole", fx=500.0, fy=500.0, cx=319.5, cy=239.5)
FISHEYE = CameraInfo(stream="f", width=400, height=400, lens="equidistant", fx=110.0, fy=110.0, cx=199.5, cy=199.5)
CAMERAS = {camera.stream: camera for camera in (ECD, MVSEC, PERFECT, FISHEYE)}
TABLES = {name: lookup_table(CANONICAL, camera.sensor, camera) for name, camera in CAMERAS.items()}
each_camera = pytest.mark.parametrize("camera", CAMERAS.values(), ids=CAMERAS)


def image_points(camera: CameraInfo) -> tuple[np.ndarray, np.ndarray]:
    u, v = np.meshgrid(np.arange(camera.width, dtype=float), np.arange(camera.height, dtype=float))
    return (u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy


def cell_of_ray(x: float, y: float, camera: CameraInfo) -> tuple[int, int] | None:
    """Row and column of the cell for the camera pixel nearest to a ray."""
    xd, yd = distort(np.array([x]), np.array([y]), camera)
    u, v = round(float(xd[0]) * camera.fx + camera.cx), round(float(yd[0]) * camera.fy + camera.cy)
    if not (0 <= u < camera.width and 0 <= v < camera.height):
        return None
    cell = int(TABLES[camera.stream][v, u])
    return None if cell == OUTSIDE else divmod(cell, CANONICAL.width)


@each_camera
def test_distorting_every_undistorted_ray_gives_its_pixel_again(camera):
    xd, yd = image_points(camera)
    x, y = undistort(xd, yd, camera)
    in_front = np.isfinite(x)
    assert in_front.mean() > 0.5  # the corners of the fisheye see behind the camera
    back_x, back_y = distort(x[in_front], y[in_front], camera)
    assert np.hypot(back_x - xd[in_front], back_y - yd[in_front]).max() * camera.fx < 1e-4  # [px]


def test_a_pinhole_lens_distorts_by_the_radial_tangential_formula_with_k3_last():
    k1, k2, p1, p2, k3 = distortion = (-0.3, 0.1, 0.02, -0.01, 0.05)
    x, y = 0.4, -0.3
    r2 = 0.16 + 0.09
    radial = 1 + k1 * r2 + k2 * r2**2 + k3 * r2**3
    got = distort(np.array([x]), np.array([y]), PERFECT.model_copy(update={"distortion": distortion}))
    assert got[0][0] == pytest.approx(x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x))
    assert got[1][0] == pytest.approx(y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y)


def test_an_equidistant_lens_maps_a_ray_to_the_polynomial_of_its_angle_from_the_axis():
    k1, k2, k3, k4 = MVSEC.distortion
    theta = math.radians(40)
    r = theta + k1 * theta**3 + k2 * theta**5 + k3 * theta**7 + k4 * theta**9
    got = distort(np.array([0.6 * math.tan(theta)]), np.array([-0.8 * math.tan(theta)]), MVSEC)
    assert (got[0][0], got[1][0]) == pytest.approx((0.6 * r, -0.8 * r))


@pytest.mark.parametrize("camera", [ECD, MVSEC, PERFECT], ids=lambda camera: camera.stream)
def test_every_pixel_of_a_usual_lens_has_a_ray(camera):
    x, y = undistort(*image_points(camera), camera)
    assert np.isfinite(x).all()
    assert np.isfinite(y).all()


@given(
    lens=st.sampled_from(["pinhole", "equidistant"]),
    k=st.tuples(*(st.floats(-0.6, 0.6) for _ in range(4))),
    angle=st.floats(0, 2 * math.pi),
    radius=st.floats(0, 2.5),
)
def test_an_undistorted_ray_maps_back_to_its_point_and_lies_on_the_same_side_of_the_axis(lens, k, angle, radius):
    k = k if lens == "equidistant" else (k[0], k[1], 0.0, 0.0, k[2])
    camera = PERFECT.model_copy(update={"lens": lens, "distortion": k})
    xd, yd = np.array([radius * math.cos(angle)]), np.array([radius * math.sin(angle)])
    x, y = undistort(xd, yd, camera)
    assert np.isnan(x[0]) == np.isnan(y[0])
    if not np.isnan(x[0]):
        back_x, back_y = distort(x, y, camera)
        assert math.hypot(back_x[0] - xd[0], back_y[0] - yd[0]) < 1e-2
        assert x[0] * xd[0] >= 0
        assert y[0] * yd[0] >= 0


def test_a_mirrored_solution_of_the_pinhole_polynomial_gives_no_ray():
    camera = PERFECT.model_copy(update={"distortion": (-0.5, 0.0, 0.0, 0.0)})
    x, _ = undistort(np.array([0.3, 2.0]), np.array([0.0, 0.0]), camera)  # x = -2 solves x (1 - x^2 / 2) = 2
    assert np.isfinite(x).tolist() == [True, False]


def test_no_lens_distorts_the_centre_of_the_image():
    for camera in CAMERAS.values():
        x, y = undistort(np.zeros(1), np.zeros(1), camera)
        assert (float(x[0]), float(y[0])) == (0.0, 0.0)


@each_camera
@pytest.mark.parametrize(("width", "height"), [(86, 65), (85, 64), (43, 33), (8, 8)])
def test_the_pixel_at_the_optical_centre_maps_to_the_centre_cell(camera, width, height):
    canonical = CanonicalConfig(width=width, height=height)
    cell = lookup_table(canonical, camera.sensor, camera)[round(camera.cy), round(camera.cx)]
    row, column = divmod(int(cell), width)
    assert (
        abs(column + 0.5 - width / 2) <= 1
    )  # an even side has no centre cell, so either of its two neighbours is right
    assert abs(row + 0.5 - height / 2) <= 1


@pytest.mark.parametrize("hfov_deg", [40.0, 75.0, 120.0])
@pytest.mark.parametrize(("width", "height"), [(86, 65), (33, 47), (8, 8)])
def test_a_perfect_pinhole_camera_equal_to_the_canonical_one_maps_each_pixel_to_its_own_cell(width, height, hfov_deg):
    canonical = CanonicalConfig(width=width, height=height, hfov_deg=hfov_deg)
    focal = focal_px(canonical)
    camera = CameraInfo(
        stream="canonical",
        width=width,
        height=height,
        lens="pinhole",
        fx=focal,
        fy=focal,
        cx=(width - 1) / 2,
        cy=(height - 1) / 2,
    )
    table = lookup_table(canonical, camera.sensor, camera)
    np.testing.assert_array_equal(table, np.arange(width * height).reshape(height, width))


@pytest.mark.parametrize("factor", [1, 2, 5])
def test_without_a_camera_the_sensor_is_scaled_and_each_cell_gets_an_equal_block_of_pixels(factor):
    sensor = Sensor(factor * CANONICAL.width, factor * CANONICAL.height)
    table = lookup_table(CANONICAL, sensor, None)
    cells = np.arange(CANONICAL.width * CANONICAL.height, dtype=np.int32).reshape(CANONICAL.height, CANONICAL.width)
    np.testing.assert_array_equal(table, np.kron(cells, np.ones((factor, factor), np.int32)))


@pytest.mark.parametrize("sensor", [Sensor(346, 260), Sensor(240, 180), Sensor(1280, 720), Sensor(3, 2)], ids=str)
def test_scaling_keeps_the_order_of_pixels_and_covers_exactly_the_whole_grid(sensor):
    table = lookup_table(CANONICAL, sensor, None)
    rows, columns = np.divmod(table, CANONICAL.width)
    assert (rows == rows[:, :1]).all()
    assert (columns == columns[:1]).all()
    for steps, pixels, cells in ((rows[:, 0], sensor.height, 65), (columns[0], sensor.width, 86)):
        np.testing.assert_array_equal(steps, [math.floor(i * cells / pixels) for i in range(pixels)])
        assert 0 == steps[0] <= steps[-1] < cells


@given(x=st.floats(-0.7, 0.7), y=st.floats(-0.5, 0.5))
def test_all_cameras_map_the_same_ray_to_the_same_or_a_neighbouring_cell(x, y):
    cells = [cell for camera in CAMERAS.values() if (cell := cell_of_ray(x, y, camera)) is not None]
    assert len(cells) >= 2  # PERFECT and FISHEYE see all of these rays
    rows, columns = zip(*cells, strict=True)
    assert max(rows) - min(rows) <= 1
    assert max(columns) - min(columns) <= 1


def test_right_and_down_in_the_image_are_right_and_down_on_the_grid():
    row, column = cell_of_ray(0.3, 0.2, MVSEC) or (0, 0)
    assert column > CANONICAL.width // 2
    assert row > CANONICAL.height // 2


def test_the_table_of_a_fisheye_covers_the_canonical_field_of_view_and_is_outside_beyond_it():
    table = lookup_table(CANONICAL, FISHEYE.sensor, FISHEYE)
    u, v = np.meshgrid(np.arange(400) - FISHEYE.cx, np.arange(400) - FISHEYE.cy)
    theta = np.hypot(u, v) / FISHEYE.fx
    assert (theta.max(), theta[200, 399]) > (math.pi / 2, math.radians(90))  # it sees behind the camera
    corner = math.hypot(CANONICAL.width, CANONICAL.height) / 2 / focal_px(CANONICAL)
    assert (table[theta > math.atan(corner)] == OUTSIDE).all()
    assert (table[theta < math.atan(CANONICAL.height / 2 / focal_px(CANONICAL)) - 0.01] != OUTSIDE).all()
    middle = table[200]
    seen = np.flatnonzero(middle != OUTSIDE)
    half_angle = math.degrees((seen[-1] - seen[0] + 1) / 2 / FISHEYE.fx)
    assert half_angle == pytest.approx(CANONICAL.hfov_deg / 2, abs=0.5)


@pytest.mark.parametrize("lens", ["pinhole", "equidistant"])
@pytest.mark.parametrize("coefficient", [1e300, -1e300, 50.0, -50.0])
def test_extreme_lens_coefficients_give_a_valid_table_and_no_warning(lens, coefficient):
    camera = PERFECT.model_copy(
        update={"width": 24, "height": 18, "fx": 1.0, "lens": lens, "distortion": (coefficient,) * 4}
    )
    table = lookup_table(CANONICAL, camera.sensor, camera)
    assert table.min() >= OUTSIDE
    assert table.max() < CANONICAL.width * CANONICAL.height


@pytest.mark.parametrize("sensor", [Sensor(240, 181), Sensor(241, 180), Sensor(180, 240)], ids=str)
def test_camera_info_of_another_sensor_is_refused_with_both_sizes(sensor):
    with pytest.raises(InvalidField) as refused:
        lookup_table(CANONICAL, sensor, ECD)
    assert "240x180" in refused.value.message
    assert str(sensor) in refused.value.message


def test_the_field_of_view_of_a_lens_is_that_of_its_outer_pixels():
    camera = CameraInfo(stream="c", width=101, height=51, lens="pinhole", fx=50.0, fy=25.0, cx=50.0, cy=25.0)
    assert field_of_view_deg(camera) == pytest.approx((90, 90))
    fisheye = camera.model_copy(update={"lens": "equidistant", "fx": 100 / math.pi})
    assert field_of_view_deg(fisheye)[1] == pytest.approx(math.degrees(2.0), abs=1e-3)
    assert math.isnan(field_of_view_deg(fisheye)[0])  # 180 deg and more: no ray in front of the camera
