"""Compiled loops of the refinement by the ground: the image of moved events of a plane, and its sharpness."""

from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from neurove_core.compiled import compiled

Array = NDArray[np.float64]
Floats = NDArray[np.float32]


_NEAREST: Final = 0.15  # a moved event whose ray has a smaller z is dropped
_FLAT: Final = 1e-12
_OWN: Final = (1 / 1.1667**2 - 1 / 4.1667**2) / (2 * np.pi)  # curvature of the band of one event, at its place


class Rays(NamedTuple):
    """Events as undistorted rays (x, y, 1), one row per event."""

    x: Array  # (N,)
    y: Array  # (N,)
    depth: Array  # (N,) height over the depth of the plane along the ray
    tilt: Array  # (N,) derivative of `depth` by the pitch [1/rad]
    side: Array  # (N,) x of an event on a wall, else 0
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
        x, y, t = rays.x[i], rays.y[i], rays.time[i]
        d = (
            rays.depth[i]
            + motion[6] * rays.tilt[i]
            + max(rays.side[i], 0.0) * motion[7]
            - min(rays.side[i], 0.0) * motion[8]
        )
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
    """Gradient (9,), by the motion, of the weighted sum of an image's values at the moved events, interpolated."""
    out = np.zeros(9)
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
        x, y, t = rays.x[i], rays.y[i], rays.time[i]
        d = (
            rays.depth[i]
            + motion[6] * rays.tilt[i]
            + max(rays.side[i], 0.0) * motion[7]
            - min(rays.side[i], 0.0) * motion[8]
        )
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
        by_depth = t * (ux * qx + uy * qy + uz * qz)
        out[6] += rays.tilt[i] * by_depth
        out[7] += max(rays.side[i], 0.0) * by_depth
        out[8] -= min(rays.side[i], 0.0) * by_depth
    return out


@compiled
def bend(
    rays: Rays, motion: Array, image: Image, columns: Array, rows: Array, band: Floats
) -> Array:  # pragma: no cover (machine code)
    """Second derivatives (9, 9), by the motion, of half the sharpness; see `sharpness_and_bend`."""
    out, across, along = np.zeros((9, 9)), np.zeros(9), np.zeros(9)
    height, width = band.shape
    for i in range(rays.x.size):
        column, row = int(columns[i] + 0.5), int(rows[i] + 0.5)
        if not (1 <= column < width - 1 and 1 <= row < height - 1):
            continue
        x, y, t, weight = rays.x[i], rays.y[i], rays.time[i], rays.weight[i]
        right, left = max(rays.side[i], 0.0), -min(rays.side[i], 0.0)
        d = rays.depth[i] + motion[6] * rays.tilt[i] + right * motion[7] + left * motion[8]
        z = 1 + t * (d * motion[2] + motion[3] * y - motion[4] * x)
        u, v = (columns[i] - image.centre_x) / image.focal, (rows[i] - image.centre_y) / image.focal
        middle = float(band[row, column])
        corners = float(band[row + 1, column + 1]) - float(band[row + 1, column - 1])
        corners += float(band[row - 1, column - 1]) - float(band[row - 1, column + 1])
        by_uu = float(band[row, column + 1]) - 2 * middle + float(band[row, column - 1]) + _OWN * weight
        by_vv = float(band[row + 1, column]) - 2 * middle + float(band[row - 1, column]) + _OWN * weight
        by_uv = corners / 4
        scale = image.focal * t / z
        across[0], across[2] = scale * d, -scale * d * u
        across[3], across[4], across[5] = -scale * y * u, scale * (1 + x * u), -scale * y
        along[1], along[2] = scale * d, -scale * d * v
        along[3], along[4], along[5] = -scale * (1 + y * v), scale * x * v, scale * x
        for k in range(3):
            change = rays.tilt[i] if k == 0 else right if k == 1 else left
            across[6 + k] = scale * (motion[0] - motion[2] * u) * change
            along[6 + k] = scale * (motion[1] - motion[2] * v) * change
        for a in range(9):
            by_a, by_b = by_uu * across[a] + by_uv * along[a], by_uv * across[a] + by_vv * along[a]
            by_a, by_b = by_a * weight, by_b * weight
            for b in range(a + 1):
                out[a, b] += by_a * across[b] + by_b * along[b]
    for a in range(9):
        for b in range(a):
            out[b, a] = out[a, b]
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
def _drawn(
    rays: Rays, motion: Array, image: Image, columns: Array, rows: Array
) -> tuple[float, Floats]:  # pragma: no cover (machine code)
    """The sharpness, and the band-passed image; places the events, see `place`."""
    cells = np.zeros((image.height, image.width), np.float32)
    place(rays, motion, image, columns, rows, cells)
    band = _banded(cells, image)
    total = _FLAT
    for y in range(image.height):
        line = np.float32(0)
        for x in range(image.width):
            line += cells[y, x] * band[y, x]
        total += float(line)
    # rounding may make the form negative where almost no event is in the image
    return max(total, _FLAT), band


@compiled
def sharpness(rays: Rays, motion: Array, image: Image) -> tuple[float, Array]:  # pragma: no cover (machine code)
    """Logarithm of the sharpness of the image of moved events, and its gradient (9,) by the motion.

    The sharpness is the sum of the image times its band-passed self, a positive quadratic form. Slow changes of the
    density of events, such as the borders of the visible ground, do not count: with them, the plain sum of squares
    prefers slow motions.

    Args:
        rays: the events.
        motion: (9,) velocity over height [1/s] and angular velocity [rad/s] in the optical frame, and the corrections
            of the pitch [rad] and of the height over the distance of the walls to the right and to the left.
        image: into which they are moved.
    """
    columns, rows = np.empty(rays.x.size), np.empty(rays.x.size)
    total, band = _drawn(rays, motion, image, columns, rows)
    return np.log(total), slope(rays, motion, image, columns, rows, band) * (2 / total)


@compiled
def sharpness_and_bend(
    rays: Rays, motion: Array, image: Image
) -> tuple[float, Array, Array]:  # pragma: no cover (machine code)
    """The same with the second derivatives (9, 9) of the sharpness over the sharpness.

    They are those of a Gauss-Newton step: the place of an event is linear in the motion, and the product of the times
    of two events that fall on each other, whose mean is about zero, is left out.
    """
    columns, rows = np.empty(rays.x.size), np.empty(rays.x.size)
    total, band = _drawn(rays, motion, image, columns, rows)
    by_motion = slope(rays, motion, image, columns, rows, band) * (2 / total)
    return np.log(total), by_motion, bend(rays, motion, image, columns, rows, band) * (2 / total)


def sharpness_reference(rays: Rays, motion: Array, image: Image) -> float:
    """Reference implementation of the value of `sharpness`, in numpy."""
    cells, band = _banded_reference(rays, motion, image)
    return float(np.log((cells * band).sum() + _FLAT))


def bend_reference(rays: Rays, motion: Array, image: Image) -> Array:
    """Reference implementation of the second derivatives (9, 9) of `sharpness_and_bend`, in numpy."""
    cells, band = _banded_reference(rays, motion, image)
    u, v, there = _placed_reference(rays, motion, image)
    column, row = (u + 0.5).astype(int), (v + 0.5).astype(int)
    inner = there & (column >= 1) & (column < image.width - 1) & (row >= 1) & (row < image.height - 1)
    column, row, weight = column[inner], row[inner], rays.weight[inner]
    near = {(i, j): band[row + i, column + j] for i in (-1, 0, 1) for j in (-1, 0, 1)}
    by_uu = near[0, 1] - 2 * near[0, 0] + near[0, -1] + _OWN * weight
    by_vv = near[1, 0] - 2 * near[0, 0] + near[-1, 0] + _OWN * weight
    by_uv = (near[1, 1] - near[1, -1] - near[-1, 1] + near[-1, -1]) / 4
    moved = []
    for step in 1e-5 * np.eye(9):
        before, after = (_placed_reference(rays, motion + sign * step, image) for sign in (-1, 1))
        moved.append([(after[axis] - before[axis])[inner] / 2e-5 for axis in (0, 1)])
    across, along = np.array(moved).transpose(1, 0, 2)
    second = (across * by_uu * weight) @ across.T + (along * by_vv * weight) @ along.T
    mixed = (across * by_uv * weight) @ along.T
    return np.asarray((second + mixed + mixed.T) * (2 / ((cells * band).sum() + _FLAT)))


def _placed_reference(rays: Rays, motion: Array, image: Image) -> tuple[Array, Array, NDArray[np.bool_]]:
    """Column and row of each moved event, and whether it is in the image."""
    ray = np.stack([rays.x, rays.y, np.ones_like(rays.x)], axis=1)
    depth = rays.depth + motion[6] * rays.tilt
    depth = depth + np.maximum(rays.side, 0) * motion[7] - np.minimum(rays.side, 0) * motion[8]
    once = depth[:, None] * motion[:3] + np.cross(motion[3:6], ray)
    t = rays.time[:, None]
    x, y, z = (ray + t * once + t**2 / 2 * np.cross(motion[3:6], once)).T
    front = z >= _NEAREST
    z = np.where(front, z, 1.0)
    u, v = image.focal * x / z + image.centre_x, image.focal * y / z + image.centre_y
    return u, v, front & (u >= 0) & (u < image.width - 1) & (v >= 0) & (v < image.height - 1)


def _banded_reference(rays: Rays, motion: Array, image: Image) -> tuple[Array, Array]:
    """The image of moved events, and its band."""
    u, v, inside = _placed_reference(rays, motion, image)
    u, v, weight = u[inside], v[inside], rays.weight[inside]
    column, row = u.astype(int), v.astype(int)
    cells = np.zeros((image.height, image.width))
    for right in (0, 1):
        for below in (0, 1):
            share = np.abs(1 - right - (u - column)) * np.abs(1 - below - (v - row))
            np.add.at(cells, (row + below, column + right), share * weight)
    return cells, _blur_reference(cells, image.narrow) - _blur_reference(cells, image.wide)


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
