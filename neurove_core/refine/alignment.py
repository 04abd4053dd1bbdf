"""Alignment: how well the events of a window fall on each other when they are moved back along a motion.

Each event is moved to the middle of its window. The moved events are drawn into an image, which is smoothed. The
alignment is the sum of this image at the moved events, without the share of each event itself. Up to a constant it is
the sum of squares of an image with less smoothing, so its maximum is that of contrast maximisation. The second-order
model of the smoothed image around each event gives the gradient and the Hessian by the motion of the event.

Both are summed in tiles, by the motion of the image (u, v). The derivatives by the parameters of any motion follow from
these few numbers, see `motion`; the compiled loops do not depend on the parameters.

Source: Gallego and Scaramuzza 2017 (contrast maximisation for the angular velocity).
"""

from collections.abc import Callable
from typing import Final, NamedTuple, ParamSpec, TypeVar

import numpy as np
from numpy.typing import NDArray

from neurove_core.compiled import compile_with, compiled

Floats = NDArray[np.float32]
Array = NDArray[np.float64]
P = ParamSpec("P")
R = TypeVar("R")

COLUMNS: Final = 12
ROWS: Final = 9
"""Tiles of an image; both are multiples of 3."""

_RADIUS: Final = 3  # of the smoothing [cells]
_SIGMA: Final = 1.2  # of the smoothing [cells]: an image that is smoothed by one cell, and once more
_VARIANCE: Final = _SIGMA**2 + 1 / 6  # with the mean variance of drawing an event into four cells
_SELF: Final = 1 / (2 * np.pi * _VARIANCE)  # the value of an event's own image at its place
_SELF_CURVATURE: Final = -_SELF / _VARIANCE
_BELL: Final = np.exp(-0.5 * (np.arange(-_RADIUS, _RADIUS + 1) / _SIGMA) ** 2)
_TAPS: Final = (_BELL / _BELL.sum()).astype(np.float32)


class Rays(NamedTuple):
    """The events of a window as rays (N,)."""

    x: Floats  # x/z
    y: Floats  # y/z
    time: Floats  # from the middle of the window, in units of its length
    near: Floats  # the depth that translation is over, over the depth at the event; 1 for a scene of one depth


class Grid(NamedTuple):
    """An image of moved events."""

    focal: float  # [cells]
    left: float  # ray x/z of the first column
    top: float  # ray y/z of the first row
    width: int
    height: int


class Tiles(NamedTuple):
    """Sums over the moved events of each of K tiles, by their motion over the window (u, v) [cells]."""

    events: Array  # (K,)
    x: Array  # (K,) mean ray x/z; 0 in an empty tile
    y: Array
    value: Array  # (K,) alignment
    gradient: Array  # (K, 2)
    hessian: Array  # (K, 2, 2)
    square: Array  # (K, 2, 2) of the gradient of each event


def image(rays: Rays, motion: Array, grid: Grid) -> Floats:
    """The smoothed image (height, width) of the moved events.

    Args:
        rays: the events.
        motion: of the camera over the window (6,): rotation vector [rad], and translation over depth.
        grid: size and place of the image.
    """
    drawn = np.zeros((grid.height, grid.width), np.float32)
    _draw(*rays, motion.astype(np.float32), grid, drawn)
    return _smoothed(drawn, _TAPS)


def image_reference(rays: Rays, motion: Array, grid: Grid) -> Floats:
    """Reference implementation of `image`, in numpy."""
    u, v = _cells_reference(_moved_reference(rays, motion), grid)
    inside = (u >= 0) & (u < grid.width - 1) & (v >= 0) & (v < grid.height - 1)
    u, v = u[inside], v[inside]
    column, row = u.astype(int), v.astype(int)
    drawn = np.zeros((grid.height, grid.width))
    for right in (0, 1):
        for below in (0, 1):
            weight = np.abs(1 - right - (u - column)) * np.abs(1 - below - (v - row))
            np.add.at(drawn, (row + below, column + right), weight)
    padded = np.pad(drawn, _RADIUS)
    rows = sum(_TAPS[k] * padded[:, k : k + grid.width] for k in range(_TAPS.size))
    return np.asarray(sum(_TAPS[k] * rows[k : k + grid.height] for k in range(_TAPS.size)), np.float32)


def tiles(rays: Rays, motion: Array, grid: Grid, smooth: Floats) -> Tiles:
    """The alignment of the events, and its derivatives by the motion of the image, in COLUMNS x ROWS tiles.

    Pairs of events move apart by the difference of their times. The Hessian leaves out the product of both times, whose
    mean over pairs is zero. Gradient and Hessian are those of half the alignment.

    Args:
        rays: the events.
        motion: as `image`.
        grid: of the image.
        smooth: the image of these events at this motion.
    """
    found = _sums(*rays, motion.astype(np.float32), grid, smooth)
    return _as_tiles(found)


def tiles_reference(rays: Rays, motion: Array, grid: Grid, smooth: Floats) -> Tiles:
    """Reference implementation of `tiles`, in numpy."""
    ray = _moved_reference(rays, motion)
    u, v = _cells_reference(ray, grid)
    inside = (u >= 1) & (u < grid.width - 2) & (v >= 1) & (v < grid.height - 2)
    u, v, time = u[inside], v[inside], rays.time[inside].astype(np.float64)
    c, r = (u + 0.5).astype(int), (v + 0.5).astype(int)
    du, dv = u - c, v - r
    near = {(i, j): smooth[r + i, c + j].astype(np.float64) for i in (-1, 0, 1) for j in (-1, 0, 1)}
    gu, gv = (near[0, 1] - near[0, -1]) / 2, (near[1, 0] - near[-1, 0]) / 2
    huu, hvv = near[0, 1] - 2 * near[0, 0] + near[0, -1], near[1, 0] - 2 * near[0, 0] + near[-1, 0]
    huv = (near[1, 1] - near[1, -1] - near[-1, 1] + near[-1, -1]) / 4
    value = near[0, 0] + gu * du + gv * dv + (huu * du * du + 2 * huv * du * dv + hvv * dv * dv) / 2 - _SELF
    gu, gv = time * (gu + huu * du + huv * dv), time * (gv + huv * du + hvv * dv)
    huu, huv, hvv = time**2 * (huu - _SELF_CURVATURE), time**2 * huv, time**2 * (hvv - _SELF_CURVATURE)
    tile = (v * ROWS / grid.height).astype(int) * COLUMNS + (u * COLUMNS / grid.width).astype(int)
    columns = np.ones_like(u), *ray[inside].T, value, gu, gv, huu, huv, hvv, gu * gu, gu * gv, gv * gv
    return _as_tiles(np.stack([np.bincount(tile, column, ROWS * COLUMNS) for column in columns], 1))


def _as_tiles(found: Array) -> Tiles:
    n = np.maximum(found[:, 0], 1)
    hessian, square = found[:, [6, 7, 7, 8]].reshape(-1, 2, 2), found[:, [9, 10, 10, 11]].reshape(-1, 2, 2)
    return Tiles(found[:, 0], found[:, 1] / n, found[:, 2] / n, found[:, 3], found[:, 4:6], hessian, square)


def _moved_reference(rays: Rays, motion: Array) -> Array:
    """Rays (N, 2) of the moved events."""
    time = rays.time[:, None].astype(np.float64)
    phi = time * motion[:3]
    ray = np.stack([rays.x, rays.y, np.ones_like(rays.x)], 1).astype(np.float64)
    once = np.cross(phi, ray)
    moved = ray + once + np.cross(phi, once) / 2 + time * rays.near[:, None] * motion[3:]
    return np.asarray(moved[:, :2] / moved[:, 2:])


def _cells_reference(ray: Array, grid: Grid) -> tuple[Array, Array]:
    return grid.focal * (ray[:, 0] - grid.left), grid.focal * (ray[:, 1] - grid.top)


def _compiled_fast(function: Callable[P, R]) -> Callable[P, R]:
    return compile_with(function, fastmath={"contract", "reassoc", "nsz", "arcp"})


@compiled
def _moved(
    x: np.float32, y: np.float32, t: np.float32, near: np.float32, motion: Floats
) -> tuple[np.float32, np.float32]:  # pragma: no cover (machine code)
    """The ray (x, y, 1), turned to the second order, and shifted."""
    a, b, c = motion[0] * t, motion[1] * t, motion[2] * t
    px, py, pz = b - c * y, c * x - a, a * y - b * x
    half, shift = np.float32(0.5), t * near
    z = np.float32(1) / (np.float32(1) + pz + half * (a * py - b * px) + motion[5] * shift)
    return (
        (x + px + half * (b * pz - c * py) + motion[3] * shift) * z,
        (y + py + half * (c * px - a * pz) + motion[4] * shift) * z,
    )


@_compiled_fast
def _draw(
    xs: Floats, ys: Floats, times: Floats, nears: Floats, motion: Floats, grid: Grid, drawn: Floats
) -> None:  # pragma: no cover (machine code)
    focal, left, top = np.float32(grid.focal), np.float32(grid.left), np.float32(grid.top)
    most_u, most_v = np.float32(grid.width - 1), np.float32(grid.height - 1)
    one, zero = np.float32(1), np.float32(0)
    for i in range(xs.size):
        x, y = _moved(xs[i], ys[i], times[i], nears[i], motion)
        u, v = focal * (x - left), focal * (y - top)
        if not (zero <= u < most_u and zero <= v < most_v):
            continue
        column, row = np.int32(u), np.int32(v)
        u, v = u - np.float32(column), v - np.float32(row)
        drawn[row, column] += (one - u) * (one - v)
        drawn[row, column + 1] += u * (one - v)
        drawn[row + 1, column] += (one - u) * v
        drawn[row + 1, column + 1] += u * v


@_compiled_fast
def _smoothed(drawn: Floats, taps: Floats) -> Floats:  # pragma: no cover (machine code)
    """Smooth along rows and columns, with zeros outside the borders."""
    height, width = drawn.shape
    rows, out = np.zeros_like(drawn), np.zeros_like(drawn)
    for y in range(height):
        for k in range(-_RADIUS, _RADIUS + 1):
            weight = taps[k + _RADIUS]
            for x in range(max(0, -k), min(width, width - k)):
                rows[y, x] += weight * drawn[y, x + k]
    for y in range(height):
        for k in range(max(-_RADIUS, -y), min(_RADIUS + 1, height - y)):
            weight = taps[k + _RADIUS]
            for x in range(width):
                out[y, x] += weight * rows[y + k, x]
    return out


@_compiled_fast
def _sums(
    xs: Floats, ys: Floats, times: Floats, nears: Floats, motion: Floats, grid: Grid, smooth: Floats
) -> Array:  # pragma: no cover (machine code)
    """(K, 12): events, x, y, value, gradient u v, Hessian uu uv vv, square of the gradient uu uv vv."""
    found = np.zeros((ROWS * COLUMNS, 12))
    focal, left, top = np.float32(grid.focal), np.float32(grid.left), np.float32(grid.top)
    most_u, most_v = np.float32(grid.width - 2), np.float32(grid.height - 2)
    per_column, per_row = np.float32(COLUMNS / grid.width), np.float32(ROWS / grid.height)
    one, half, quarter, two = np.float32(1), np.float32(0.5), np.float32(0.25), np.float32(2)
    own, own_curvature = np.float32(_SELF), np.float32(_SELF_CURVATURE)
    for i in range(xs.size):
        t = times[i]
        x, y = _moved(xs[i], ys[i], t, nears[i], motion)
        u, v = focal * (x - left), focal * (y - top)
        if not (one <= u < most_u and one <= v < most_v):
            continue
        column, row = np.int32(u + half), np.int32(v + half)
        du, dv = u - np.float32(column), v - np.float32(row)
        middle = smooth[row, column]
        before, after = smooth[row, column - 1], smooth[row, column + 1]
        above, below = smooth[row - 1, column], smooth[row + 1, column]
        huv = quarter * (
            smooth[row + 1, column + 1]
            - smooth[row + 1, column - 1]
            - smooth[row - 1, column + 1]
            + smooth[row - 1, column - 1]
        )
        gu, gv = half * (after - before), half * (below - above)
        huu, hvv = after - two * middle + before, below - two * middle + above
        value = middle + gu * du + gv * dv + half * (huu * du * du + hvv * dv * dv) + huv * du * dv - own
        gu, gv = t * (gu + huu * du + huv * dv), t * (gv + huv * du + hvv * dv)
        huu, huv, hvv = t * t * (huu - own_curvature), t * t * huv, t * t * (hvv - own_curvature)
        tile = found[np.int32(v * per_row) * COLUMNS + np.int32(u * per_column)]
        tile[0] += one
        tile[1] += x
        tile[2] += y
        tile[3] += value
        tile[4] += gu
        tile[5] += gv
        tile[6] += huu
        tile[7] += huv
        tile[8] += hvv
        tile[9] += gu * gu
        tile[10] += gu * gv
        tile[11] += gv * gv
    return found
