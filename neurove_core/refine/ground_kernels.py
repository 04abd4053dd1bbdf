"""Compiled loops of the refinement by the ground: the image of moved events of a plane, and its sharpness."""

from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from neurove_core.compiled import compiled

Array = NDArray[np.float64]
Floats = NDArray[np.float32]


_NEAREST: Final = 0.15  # a moved event whose ray has a smaller z is dropped
_FLAT: Final = 1e-12


class Rays(NamedTuple):
    """Events as undistorted rays (x, y, 1), one row per event."""

    x: Array  # (N,)
    y: Array  # (N,)
    depth: Array  # (N,) height over the depth of the plane along the ray
    tilt: Array  # (N,) derivative of `depth` by the pitch [1/rad]
    time: Array  # (N,) [s] since the reference time, to which all events are moved
    weight: Array  # (N,)


class Image(NamedTuple):
    """Geometry of the image of moved events, and its two smoothing kernels."""

    focal: float  # focal length [cells]
    centre_x: float  # column of the optical axis
    centre_y: float  # row of the optical axis; may be negative
    width: int  # [cells]
    height: int
    narrow: Floats  # (2k + 1,) weights of the narrow smoothing, along rows and columns
    wide: Floats  # (2m + 1,)


@compiled
def place(
    rays: Rays, motion: Array, image: Image, columns: Array, rows: Array, cells: Floats
) -> None:  # pragma: no cover (machine code)
    """Add each moved event to the four cells around it, in place; the column of a dropped event is -1.

    The plane moves by p' = -(v + w x p) for a point p, to second order in time; p = ray / depth.
    """
    height, width = cells.shape
    ux, uy, uz, wx, wy, wz = motion[0], motion[1], motion[2], motion[3], motion[4], motion[5]
    for i in range(rays.x.size):
        x, y, d, t = rays.x[i], rays.y[i], rays.depth[i] + motion[6] * rays.tilt[i], rays.time[i]
        ax, ay, az = d * ux + wy - wz * y, d * uy + wz * x - wx, d * uz + wx * y - wy * x
        half = 0.5 * t * t
        z = 1 + t * az + half * (wx * ay - wy * ax)
        columns[i] = -1.0
        if z < _NEAREST:
            continue
        u = image.focal * (x + t * ax + half * (wy * az - wz * ay)) / z + image.centre_x
        v = image.focal * (y + t * ay + half * (wz * ax - wx * az)) / z + image.centre_y
        if not (0 <= u < width - 1 and 0 <= v < height - 1):
            continue
        columns[i], rows[i] = u, v
        column, row = int(u), int(v)
        u, v, g = u - column, v - row, rays.weight[i]
        cells[row, column] += g * (1 - u) * (1 - v)
        cells[row, column + 1] += g * u * (1 - v)
        cells[row + 1, column] += g * (1 - u) * v
        cells[row + 1, column + 1] += g * u * v


@compiled
def slope(
    rays: Rays, motion: Array, image: Image, columns: Array, rows: Array, cells: Floats
) -> Array:  # pragma: no cover (machine code)
    """Gradient (7,), by the motion, of the weighted sum of an image's values at the moved events, interpolated."""
    out = np.zeros(7)
    ux, uy, uz, wx, wy, wz = motion[0], motion[1], motion[2], motion[3], motion[4], motion[5]
    for i in range(rays.x.size):
        if columns[i] < 0:
            continue
        column, row = int(columns[i]), int(rows[i])
        u, v = columns[i] - column, rows[i] - row
        a, b = float(cells[row, column]), float(cells[row, column + 1])
        c, e = float(cells[row + 1, column]), float(cells[row + 1, column + 1])
        scale = image.focal * rays.weight[i]
        by_u, by_v = ((b - a) * (1 - v) + (e - c) * v) * scale, ((c - a) * (1 - u) + (e - b) * u) * scale
        x, y, d, t = rays.x[i], rays.y[i], rays.depth[i] + motion[6] * rays.tilt[i], rays.time[i]
        ax, ay, az = d * ux + wy - wz * y, d * uy + wz * x - wx, d * uz + wx * y - wy * x
        half = 0.5 * t * t
        z = 1 + t * az + half * (wx * ay - wy * ax)
        # the image point is (columns - centre) / focal
        gx, gy = by_u / z, by_v / z
        gz = -(gx * (columns[i] - image.centre_x) + gy * (rows[i] - image.centre_y)) / image.focal
        kx, ky, kz = gy * wz - gz * wy, gz * wx - gx * wz, gx * wy - gy * wx
        qx, qy, qz = gx + 0.5 * t * kx, gy + 0.5 * t * ky, gz + 0.5 * t * kz
        out[0] += t * d * qx
        out[1] += t * d * qy
        out[2] += t * d * qz
        out[3] += t * (y * qz - qy) + half * (ay * gz - az * gy)
        out[4] += t * (qx - x * qz) + half * (az * gx - ax * gz)
        out[5] += t * (x * qy - y * qx) + half * (ax * gy - ay * gx)
        out[6] += t * rays.tilt[i] * (ux * qx + uy * qy + uz * qz)
    return out


@compiled
def _blur(
    cells: Floats, kernel: Floats, scale: float, between: Floats, out: Floats
) -> None:  # pragma: no cover (machine code)
    """Add `scale` times the smoothed image to `out`; outside its borders the image is zero."""
    height, width = cells.shape
    reach = kernel.size // 2
    line = np.zeros(width + 2 * reach, np.float32)
    for y in range(height):
        source, into = cells[y], between[y]
        for x in range(width):
            line[x + reach] = source[x]
        weight = kernel[reach]
        for x in range(width):
            into[x] = weight * line[x + reach]
        for k in range(reach):  # the kernel is symmetric
            weight, other = kernel[k], 2 * reach - k
            for x in range(width):
                into[x] += weight * (line[x + k] + line[x + other])
    for y in range(height):
        into = out[y]
        for k in range(max(-reach, -y), min(reach + 1, height - y)):
            weight, source = np.float32(scale) * kernel[k + reach], between[y + k]
            for x in range(width):
                into[x] += weight * source[x]


@compiled
def _banded(cells: Floats, image: Image) -> Floats:  # pragma: no cover (machine code)
    """The image between its narrow and its wide smoothing."""
    band, between = np.zeros_like(cells), np.empty_like(cells)
    _blur(cells, image.narrow, 1.0, between, band)
    _blur(cells, image.wide, -1.0, between, band)
    return band


@compiled
def sharpness(rays: Rays, motion: Array, image: Image) -> tuple[float, Array]:  # pragma: no cover (machine code)
    """Logarithm of the sharpness of the image of moved events, and its gradient (7,) by the motion.

    The sharpness is the sum of the image times its band-passed self, a positive quadratic form. Slow changes of the
    density of events, such as the borders of the visible ground, do not count: with them, the plain sum of squares
    prefers slow motions.

    Args:
        rays: the events.
        motion: (7,) velocity over height [1/s] and angular velocity [rad/s] in the optical frame, and the correction
            of the pitch [rad].
        image: into which they are moved.
    """
    columns, rows = np.empty(rays.x.size), np.empty(rays.x.size)
    cells = np.zeros((image.height, image.width), np.float32)
    place(rays, motion, image, columns, rows, cells)
    band = _banded(cells, image)
    total = _FLAT
    for y in range(image.height):
        line = np.float32(0)
        for x in range(image.width):
            line += cells[y, x] * band[y, x]
        total += float(line)
    total = max(total, _FLAT)  # rounding may make the form negative where almost no event is in the image
    return np.log(total), slope(rays, motion, image, columns, rows, band) * (2 / total)


def sharpness_reference(rays: Rays, motion: Array, image: Image) -> float:
    """Reference implementation of the value of `sharpness`, in numpy."""
    ray = np.stack([rays.x, rays.y, np.ones_like(rays.x)], axis=1)
    depth = rays.depth + motion[6] * rays.tilt
    once = depth[:, None] * motion[:3] + np.cross(motion[3:6], ray)
    t = rays.time[:, None]
    x, y, z = (ray + t * once + t**2 / 2 * np.cross(motion[3:6], once)).T
    front = z >= _NEAREST
    u, v = (image.focal * side[front] / z[front] for side in (x, y))
    u, v, weight = u + image.centre_x, v + image.centre_y, rays.weight[front]
    inside = (u >= 0) & (u < image.width - 1) & (v >= 0) & (v < image.height - 1)
    u, v, weight = u[inside], v[inside], weight[inside]
    column, row = u.astype(int), v.astype(int)
    cells = np.zeros((image.height, image.width))
    for right in (0, 1):
        for below in (0, 1):
            share = np.abs(1 - right - (u - column)) * np.abs(1 - below - (v - row))
            np.add.at(cells, (row + below, column + right), share * weight)
    band = _blur_reference(cells, image.narrow) - _blur_reference(cells, image.wide)
    return float(np.log((cells * band).sum() + _FLAT))


def _blur_reference(cells: Array, kernel: Floats) -> Array:
    along = np.stack([np.convolve(row, kernel)[kernel.size // 2 :][: row.size] for row in cells])
    return np.stack([np.convolve(row, kernel)[kernel.size // 2 :][: row.size] for row in along.T]).T


@compiled
def crowding(x: Array, y: Array, image: Image, reach: int) -> Array:  # pragma: no cover (machine code)
    """The number of events (N,) within `reach` cells of each event, without motion."""
    counts, rows = np.zeros((image.height, image.width)), np.zeros((image.height, image.width))
    at, out = np.empty((x.size, 2), np.int64), np.empty(x.size)
    for i in range(x.size):
        at[i, 0] = min(max(int(image.focal * y[i] + image.centre_y), 0), image.height - 1)
        at[i, 1] = min(max(int(image.focal * x[i] + image.centre_x), 0), image.width - 1)
        counts[at[i, 0], at[i, 1]] += 1
    for r in range(image.height):
        for c in range(image.width):
            if counts[r, c]:
                for k in range(max(0, c - reach), min(image.width, c + reach + 1)):
                    rows[r, k] += counts[r, c]
    for i in range(x.size):
        total = 0.0
        for r in range(max(0, at[i, 0] - reach), min(image.height, at[i, 0] + reach + 1)):
            total += rows[r, at[i, 1]]
        out[i] = total
    return out


def crowding_reference(x: Array, y: Array, image: Image, reach: int) -> Array:
    """Reference implementation of `crowding`, in numpy."""
    row = np.clip((image.focal * y + image.centre_y).astype(int), 0, image.height - 1)
    column = np.clip((image.focal * x + image.centre_x).astype(int), 0, image.width - 1)
    near = (np.abs(row[:, None] - row) <= reach) & (np.abs(column[:, None] - column) <= reach)
    return np.asarray(near.sum(axis=1), np.float64)
