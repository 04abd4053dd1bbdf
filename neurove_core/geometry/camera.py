"""Camera: lens models, and the look-up table from the pixels of any sensor to the canonical camera."""

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from neurove_core.config import CanonicalConfig
from neurove_protocol import CameraInfo, Sensor
from neurove_protocol.errors import InvalidField

OUTSIDE = -1
"""Entry of a look-up table for a pixel outside the canonical camera's field of view."""

PIECE_PX = 1 << 17
"""Pixels of a table that are computed at once: each temporary array has 1 MiB."""

_ITERATIONS = 20  # most iterations of undistortion
_TOLERANCE = 1e-7  # undistortion stops below this error or step (in focal lengths or radians)


def focal_px(canonical: CanonicalConfig) -> float:
    """Focal length of the canonical camera [cells].

    >>> round(focal_px(CanonicalConfig(width=100, height=100, hfov_deg=90)), 3)
    50.0
    """
    return canonical.width / 2 / math.tan(math.radians(canonical.hfov_deg) / 2)


def lookup_table(canonical: CanonicalConfig, sensor: Sensor, camera: CameraInfo | None) -> NDArray[np.int32]:
    """The cell of the canonical camera for each pixel of a sensor.

    With this table, undistortion, scaling and cropping cost one table read per event. Without CameraInfo, the whole
    sensor is scaled to the grid.

    Args:
        canonical: the grid that the network sees.
        sensor: the pixel array of the events.
        camera: the lens of the sensor, if known.

    Returns:
        (sensor.height, sensor.width) of (part * height + row) * width + column, or OUTSIDE; read-only. Without
        subcells the part is 0; else it is that of ingest.channels.

    Raises:
        InvalidField: the camera info describes a sensor of another size.
    """
    if camera is None:
        columns = (np.arange(sensor.width) * canonical.fine.width // sensor.width).astype(np.int32)
        rows = (np.arange(sensor.height) * canonical.fine.height // sensor.height).astype(np.int32)
        return _read_only(_cell(rows[:, None], columns, canonical).astype(np.int32))
    if camera.sensor != sensor:
        raise InvalidField("camera info", "width x height", str(camera.sensor), f"the events' sensor is {sensor}")
    table = np.empty((sensor.height, sensor.width), np.int32)
    step = max(1, PIECE_PX // sensor.width)
    pieces = [slice(first, first + step) for first in range(0, sensor.height, step)]
    took = [_fill(table, piece, canonical, camera, None) for piece in pieces]
    for piece, steps in zip(pieces, took, strict=True):
        if steps < max(took):  # as many steps everywhere as the slowest pixel needs: the pieces leave no trace
            _fill(table, piece, canonical, camera, max(took))
    return _read_only(table)


def _read_only(table: NDArray[np.int32]) -> NDArray[np.int32]:
    """The table, which nobody may change from now on: ingest.scaling examines it once."""
    table.setflags(write=False)
    return table


def _fill(
    table: NDArray[np.int32], piece: slice, canonical: CanonicalConfig, camera: CameraInfo, steps: int | None
) -> int:
    """Fill some rows of a table; return the steps of undistortion, at most `steps` where given."""
    u = np.arange(table.shape[1], dtype=np.float64)
    v = np.arange(table.shape[0], dtype=np.float64)[piece, None]
    xd, yd = np.broadcast_arrays((u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy)
    x, y, steps = _undistort(xd, yd, camera, steps)
    fine = canonical.fine
    focal = focal_px(fine)
    with np.errstate(invalid="ignore", over="ignore"):  # a pixel without a ray is nan, and nan is outside
        column = np.floor(x * focal + fine.width / 2)
        row = np.floor(y * focal + fine.height / 2)
        inside = (column >= 0) & (column < fine.width) & (row >= 0) & (row < fine.height)
        table[piece] = np.where(inside, _cell(row, column, canonical), OUTSIDE)
    return steps


def ray_table(camera: CameraInfo) -> NDArray[np.float32]:
    """The ray through each pixel.

    Args:
        camera: the lens.

    Returns:
        (2, height, width) of x/z and y/z; nan where the lens model has no ray in front of the camera.
    """
    table = np.empty((2, camera.height, camera.width), np.float32)
    step = max(1, PIECE_PX // camera.width)
    u = np.arange(camera.width, dtype=np.float64)
    for first in range(0, camera.height, step):
        v = np.arange(first, min(first + step, camera.height), dtype=np.float64)[:, None]
        xd, yd = np.broadcast_arrays((u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy)
        with np.errstate(over="ignore"):  # a ray that float32 cannot hold is infinite
            table[:, first : first + step] = undistort(xd, yd, camera)
    return table


def _cell(row: NDArray[Any], column: NDArray[Any], canonical: CanonicalConfig) -> NDArray[Any]:
    """The entry of a table for a row and column of the fine grid."""
    n = canonical.subcells
    part = row % n * n + column % n
    entry: NDArray[Any] = (part * canonical.height + row // n) * canonical.width + column // n
    return entry


def field_of_view_deg(camera: CameraInfo) -> tuple[float, float]:
    """Angles between the rays of the outer columns, and of the outer rows, through the optical axis [deg].

    Returns:
        horizontal and vertical; nan where the lens model has no ray for the edge.
    """
    x = (np.array([0.0, camera.width - 1.0]) - camera.cx) / camera.fx
    y = (np.array([0.0, camera.height - 1.0]) - camera.cy) / camera.fy
    across, _ = undistort(x, np.zeros(2), camera)
    _, along = undistort(np.zeros(2), y, camera)
    wide, high = (np.degrees(np.arctan(rays)) for rays in (across, along))
    return float(wide[1] - wide[0]), float(high[1] - high[0])


def undistort(
    xd: NDArray[np.float64], yd: NDArray[np.float64], camera: CameraInfo
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Remove the lens distortion from image points: the rays through them.

    Equidistant lenses use Newton's method on the angle, pinhole lenses a fixed-point iteration.

    Args:
        xd: (u - cx) / fx of any shape.
        yd: (v - cy) / fy of the same shape.
        camera: defines the lens model and its distortion.

    Returns:
        x/z and y/z of the rays; nan where the lens model has no ray in front of the camera for the point.
    """
    x, y, _ = _undistort(xd, yd, camera, None)
    return x, y


def _undistort(
    xd: NDArray[np.float64], yd: NDArray[np.float64], camera: CameraInfo, steps: int | None
) -> tuple[NDArray[np.float64], NDArray[np.float64], int]:
    """As undistort, in exactly so many steps where given; also returns their number."""
    if camera.lens == "equidistant":
        return _undistort_equidistant(xd, yd, camera.distortion, steps)
    return _undistort_pinhole(xd, yd, camera.distortion, steps)


def distort(
    x: NDArray[np.float64], y: NDArray[np.float64], camera: CameraInfo
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Apply the lens distortion to the rays (x, y, 1): the inverse of undistort, in the same units."""
    if camera.lens == "equidistant":
        r = np.hypot(x, y)
        theta = np.arctan(r)
        scale = np.divide(_angle_polynomial(theta, camera.distortion), r, out=np.ones_like(r), where=r > 0)
        return x * scale, y * scale
    radial, dx, dy = _radial_tangential(x, y, camera.distortion)
    return x * radial + dx, y * radial + dy


def _radial_tangential(
    x: NDArray[np.float64], y: NDArray[np.float64], distortion: tuple[float, ...]
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    k1, k2, p1, p2, k3 = (*distortion, *(0.0,) * (5 - len(distortion)))
    r2 = x * x + y * y
    radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
    return radial, 2 * p1 * x * y + p2 * (r2 + 2 * x * x), p1 * (r2 + 2 * y * y) + 2 * p2 * x * y


def _undistort_pinhole(
    xd: NDArray[np.float64], yd: NDArray[np.float64], distortion: tuple[float, ...], steps: int | None
) -> tuple[NDArray[np.float64], NDArray[np.float64], int]:
    x, y = xd.copy(), yd.copy()
    if not any(distortion):
        return x, y, 0
    error, taken = np.zeros_like(x), 0
    with np.errstate(all="ignore"):  # far outside the model's range the iteration may overflow; see `lost`
        for taken in range(_ITERATIONS):
            radial, dx, dy = _radial_tangential(x, y, distortion)
            error = np.hypot(x * radial + dx - xd, y * radial + dy - yd)
            if taken == steps or (steps is None and not (error >= _TOLERANCE).any()):
                break
            x, y = (xd - dx) / radial, (yd - dy) / radial
        else:
            taken = _ITERATIONS
        lost = ~(error < 1e-3) | (radial <= 0)  # radial < 0: the ray is on the opposite side of the axis
    x[lost] = y[lost] = np.nan
    return x, y, taken


def _angle_polynomial(theta: NDArray[np.float64], distortion: tuple[float, ...]) -> NDArray[np.float64]:
    k1, k2, k3, k4 = distortion or (0.0,) * 4
    t2 = theta * theta
    return theta * (1 + t2 * (k1 + t2 * (k2 + t2 * (k3 + t2 * k4))))


def _undistort_equidistant(
    xd: NDArray[np.float64], yd: NDArray[np.float64], distortion: tuple[float, ...], steps: int | None
) -> tuple[NDArray[np.float64], NDArray[np.float64], int]:
    k1, k2, k3, k4 = distortion or (0.0,) * 4
    rd = np.hypot(xd, yd)
    theta, taken = rd.copy(), 0
    with np.errstate(all="ignore"):  # as above
        for taken in range(1, _ITERATIONS + 1):
            t2 = theta * theta
            slope = 1 + t2 * (3 * k1 + t2 * (5 * k2 + t2 * (7 * k3 + t2 * 9 * k4)))
            step = (_angle_polynomial(theta, distortion) - rd) / slope
            theta = theta - step
            if taken == steps or (steps is None and not (np.abs(step) >= _TOLERANCE).any()):
                break
        lost = ~(np.abs(_angle_polynomial(theta, distortion) - rd) < 1e-3) | (theta >= math.pi / 2) | (theta < 0)
        scale = np.where(rd > 0, np.tan(theta) / rd, 1.0)
    scale[lost] = np.nan
    return xd * scale, yd * scale, taken
