"""Ray casting of panels: linear intensity and depth of each pixel.

A panel is carried into the camera's frame, where a ray is the fixed (x, y, 1) of its pixel: so a hit costs three inner
products, and its parameter is the depth z itself. Texture is read trilinearly with up to TAPS taps along the longer
axis of the pixel's footprint; where a pixel lies across a panel's edge, what is behind shows through by its share, so
that an edge moves smoothly between two renders and not a pixel at a time.
"""

import math
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from neurove_core.sim.camera import Rays
from neurove_core.sim.compile import fast
from neurove_core.sim.panels import CLEAR2, SKY_COLUMNS, SKY_ROWS, SKY_TOP, Panels, Sky
from neurove_core.sim.textures import CHAIN, LEVEL_START, LEVELS, SIZE, Textures

TAPS: Final = 3
"""Most texture reads along the footprint's longer axis."""

VIEW: Final = 20
"""Numbers of a panel in a camera's frame, in one row that a kernel reads: u, v, normal (3 each); the camera's place
along u, along v, and from it; half of each side; density (2), offset (2), texture, gain."""

NEAR_M: Final = 0.02
"""What is nearer than this is not seen."""

_SKY_SCALE: Final = (SKY_ROWS - 1) / SKY_TOP
_LAST: Final = LEVELS - 1


class World(NamedTuple):
    """What can be seen."""

    panels: Panels
    textures: Textures
    sky: Sky


class Backdrop(NamedTuple):
    """What the kernels need of a world beside its panels' views."""

    texels: NDArray[np.float32]  # see Textures
    sky: NDArray[np.float32]  # see Sky.image
    haze: float
    far_m: float
    eps: float  # added to the linear intensity before its logarithm

    @classmethod
    def of(cls, world: World, eps: float) -> "Backdrop":
        """That of a world."""
        return cls(world.textures.texels, world.sky.image, world.sky.haze, world.sky.far_m, eps)


@fast
def views_of(
    panels: Panels, position: NDArray[np.float64], rotation: NDArray[np.float64]
) -> NDArray[np.float64]:  # pragma: no cover (machine code)
    """The panels as a camera sees them from each of some places.

    Args:
        panels: N of them, in the world.
        position: (G, 3) of the camera.
        rotation: (G, 3, 3) camera to world.

    Returns:
        (G, N, VIEW).
    """
    out = np.empty((position.shape[0], panels.gain.size, VIEW))
    us, vs, centres = panels.u, panels.v, panels.centre
    for j in range(position.shape[0]):
        for i in range(panels.gain.size):
            u0, u1, u2, v0, v1, v2 = us[i, 0], us[i, 1], us[i, 2], vs[i, 0], vs[i, 1], vs[i, 2]
            n0, n1, n2 = u1 * v2 - u2 * v1, u2 * v0 - u0 * v2, u0 * v1 - u1 * v0
            x = centres[i, 0] - position[j, 0]
            y = centres[i, 1] - position[j, 1]
            z = centres[i, 2] - position[j, 2]
            row = out[j, i]
            for k in range(3):
                a, b, c = rotation[j, 0, k], rotation[j, 1, k], rotation[j, 2, k]
                row[k] = u0 * a + u1 * b + u2 * c
                row[3 + k] = v0 * a + v1 * b + v2 * c
                row[6 + k] = n0 * a + n1 * b + n2 * c
            row[9] = -(u0 * x + u1 * y + u2 * z)
            row[10] = -(v0 * x + v1 * y + v2 * z)
            row[11] = n0 * x + n1 * y + n2 * z
            for k in range(2):
                row[12 + k], row[14 + k], row[16 + k] = panels.half[i, k], panels.density[i, k], panels.offset[i, k]
            row[18], row[19] = panels.texture[i], panels.gain[i]
    return out


@fast
def _bilinear(texels: NDArray[np.float32], start: int, side: int, u: float, v: float) -> float:  # pragma: no cover
    u -= 0.5
    v -= 0.5
    left, top = math.floor(u), math.floor(v)
    du, dv = u - left, v - top
    mask = np.uint64(side - 1)  # unsigned, for an index that may be negative is asked each time whether it is
    i0, i1 = np.uint64(np.int64(left)) & mask, np.uint64(np.int64(left) + 1) & mask
    j0 = np.uint64(start) + (np.uint64(np.int64(top)) & mask) * np.uint64(side)
    j1 = np.uint64(start) + (np.uint64(np.int64(top) + 1) & mask) * np.uint64(side)
    a, b, c, d = texels[j0 + i0], texels[j0 + i1], texels[j1 + i0], texels[j1 + i1]
    upper, lower = a + du * (b - a), c + du * (d - c)
    value: float = upper + dv * (lower - upper)
    return value


@fast
def _sample(
    texels: NDArray[np.float32], base: int, u: float, v: float, ux: float, vx: float, uy: float, vy: float
) -> float:  # pragma: no cover (machine code)
    """Intensity at (u, v) [texels] of a footprint whose sides are (ux, vx) and (uy, vy) [texels]."""
    long_u, long_v, long2, short2 = ux, vx, ux * ux + vx * vx, uy * uy + vy * vy
    if long2 < short2:
        long_u, long_v, long2, short2 = uy, vy, short2, long2
    taps = 1
    if long2 > 2.25 * short2:
        taps = min(int(math.sqrt(long2 / max(short2, 1e-12)) + 0.999), TAPS)
    width2 = max(short2, long2 / (taps * taps))
    # the logarithm as straight lines between powers of two: continuous, and at most 0.05 of a level off
    mantissa, exponent = math.frexp(max(width2, 1.0))
    lod = min(0.5 * exponent + mantissa - 1.0, _LAST - 1e-6)
    level = int(lod)
    # near a level that level alone is read, and the passage from one to the next is the steeper for it
    blend = min(max(2 * (lod - level) - 0.5, 0.0), 1.0)
    if blend >= 1 and level + 2 < LEVELS:
        level, blend = level + 1, 0.0
    start, coarser = base + LEVEL_START[level], base + LEVEL_START[level + 1]
    side = SIZE >> level
    fine = 1.0 / (1 << level)
    total = 0.0
    for tap in range(taps):
        share = (tap + 0.5) / taps - 0.5
        tu, tv = (u + share * long_u) * fine, (v + share * long_v) * fine
        value = _bilinear(texels, start, side, tu, tv)
        if blend > 0:
            value += blend * (_bilinear(texels, coarser, side >> 1, 0.5 * tu, 0.5 * tv) - value)
        total += value
    return total / taps


@fast
def _sky(
    image: NDArray[np.float32], haze: float, rotation: NDArray[np.float64], x: float, y: float
) -> float:  # pragma: no cover (machine code)
    """Intensity of the sky where the ray (x, y, 1) looks."""
    wx = rotation[0, 0] * x + rotation[0, 1] * y + rotation[0, 2]
    wy = rotation[1, 0] * x + rotation[1, 1] * y + rotation[1, 2]
    wz = rotation[2, 0] * x + rotation[2, 1] * y + rotation[2, 2]
    slope = -wy / math.sqrt(wx * wx + wz * wz + 1e-12)
    if slope <= 0:
        return haze
    row = min(slope * _SKY_SCALE, SKY_ROWS - 1.001)
    column = (math.atan2(wx, wz) / (2 * math.pi) + 1.0) * SKY_COLUMNS
    top, left = int(row), int(column)
    dv, du = row - top, column - left
    i0, i1 = left % SKY_COLUMNS, (left + 1) % SKY_COLUMNS
    upper = image[top, i0] + du * (image[top, i1] - image[top, i0])
    lower = image[top + 1, i0] + du * (image[top + 1, i1] - image[top + 1, i0])
    value: float = upper + dv * (lower - upper)
    return value


@fast
def _cover(
    views: NDArray[np.float64], i: int, t: float, x: float, y: float, sx: float, sy: float
) -> float:  # pragma: no cover (machine code)
    """Which share of a pixel panel i covers where its ray meets the panel's plane at depth t."""
    ud = views[i, 0] * x + views[i, 1] * y + views[i, 2]
    vd = views[i, 3] * x + views[i, 4] * y + views[i, 5]
    in_u, in_v = views[i, 12] - abs(t * ud + views[i, 9]), views[i, 13] - abs(t * vd + views[i, 10])
    reach = 6 * t * (sx + sy)
    if in_u < -reach or in_v < -reach:
        return 0.0
    if in_u > reach and in_v > reach:
        return 1.0
    nd = views[i, 6] * x + views[i, 7] * y + views[i, 8]
    gx, gy = sx * views[i, 6] / nd, sy * views[i, 7] / nd
    wide_u = min(t * (abs(sx * views[i, 0] - ud * gx) + abs(sy * views[i, 1] - ud * gy)), reach)
    wide_v = min(t * (abs(sx * views[i, 3] - vd * gx) + abs(sy * views[i, 4] - vd * gy)), reach)
    share_u = min(max(in_u / max(wide_u, 1e-12) + 0.5, 0.0), 1.0)
    share_v = min(max(in_v / max(wide_v, 1e-12) + 0.5, 0.0), 1.0)
    share: float = share_u * share_v
    return share


@fast
def _shade(
    texels: NDArray[np.float32], views: NDArray[np.float64], i: int, t: float, x: float, y: float, sx: float, sy: float
) -> float:  # pragma: no cover (machine code)
    """Intensity of panel i where a ray meets it at depth t, before any haze."""
    ud = views[i, 0] * x + views[i, 1] * y + views[i, 2]
    vd = views[i, 3] * x + views[i, 4] * y + views[i, 5]
    nd = views[i, 6] * x + views[i, 7] * y + views[i, 8]
    gx, gy = sx * views[i, 6] / nd, sy * views[i, 7] / nd
    ku, kv = views[i, 14], views[i, 15]
    value: float = views[i, 19] * _sample(
        texels,
        int(views[i, 18]) * CHAIN,
        (t * ud + views[i, 9]) * ku + views[i, 16],
        (t * vd + views[i, 10]) * kv + views[i, 17],
        t * (sx * views[i, 0] - ud * gx) * ku,
        t * (sx * views[i, 3] - vd * gx) * kv,
        t * (sy * views[i, 1] - ud * gy) * ku,
        t * (sy * views[i, 4] - vd * gy) * kv,
    )
    return value


@fast
def render_span(
    backdrop: Backdrop,
    views: NDArray[np.float64],
    rotation: NDArray[np.float64],
    candidates: NDArray[np.int64],
    nearest: NDArray[np.float64],
    rays: Rays,
    first: int,
    stop: int,
    light: NDArray[np.float32],
    depth: NDArray[np.float32],
) -> None:  # pragma: no cover (machine code)
    """Log intensity and depth that some rays find.

    Args:
        backdrop: of the world.
        views: (N, VIEW) of all panels, from here.
        rotation: (3, 3) camera to world.
        candidates: the panels that may lie in their way, by the least depth of any of their points.
        nearest: those depths, or less [m].
        rays: of the camera.
        first: ray to begin with.
        stop: ray to end before.
        light: filled from its beginning.
        depth: (all rays,) of which these are filled: depth along z [m], infinite where no panel is.
    """
    texels, sky, haze, eps = backdrop.texels, backdrop.sky, backdrop.haze, backdrop.eps
    far2 = backdrop.far_m * backdrop.far_m
    xs, ys, step_x, step_y = rays.x, rays.y, rays.step_x, rays.step_y
    for p in range(first, stop):
        x, y, sx, sy = xs[p], ys[p], step_x[p], step_y[p]
        slant2 = 1 + x * x + y * y  # squared distance over squared depth
        t1, t2, i1, i2, cover1 = np.inf, np.inf, -1, -1, 0.0
        for k in range(candidates.size):
            if nearest[k] > t2 or (nearest[k] > t1 and cover1 >= 1):
                break
            i = candidates[k]
            t = views[i, 11] / (views[i, 6] * x + views[i, 7] * y + views[i, 8])
            if not (NEAR_M < t < t2 and t * t * slant2 < far2):
                continue
            cover = _cover(views, i, t, x, y, sx, sy)
            if cover <= 0:
                continue
            if t < t1:
                t1, t2, i1, i2, cover1 = t, t1, i, i1, cover
            else:
                t2, i2 = t, i
        far = t1 * t1 * slant2 / far2
        value, back = 0.0, 0.0
        if cover1 < 1 or far > CLEAR2:
            back = value = _sky(sky, haze, rotation, x, y)
        if cover1 < 1 and i2 >= 0:
            value = _faded(_shade(texels, views, i2, t2, x, y, sx, sy), back, t2 * t2 * slant2 / far2)
        if i1 >= 0:
            front = _faded(_shade(texels, views, i1, t1, x, y, sx, sy), back, far)
            value += cover1 * (front - value)
        light[p - first] = math.log(np.float32(value + eps))  # in single precision: twice as fast, and kept so
        depth[p] = t1


@fast
def _faded(value: float, back: float, far: float) -> float:  # pragma: no cover (machine code)
    """What is seen of an intensity at a squared distance `far`, of that where nothing is to be seen of it."""
    if far <= CLEAR2:
        return value
    clear = (1 - far) / (1 - CLEAR2)
    return back + clear * clear * (value - back)


def render(
    world: World, rays: Rays, position: NDArray[np.float64], rotation: NDArray[np.float64], eps: float
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """One picture, every ray against every panel.

    Args:
        world: what can be seen.
        rays: of the camera.
        position: (3,) of the camera in the world [m].
        rotation: (3, 3) camera to world.
        eps: added to the linear intensity before its logarithm.

    Returns:
        log intensity (N,) and depth (N,) [m] of each ray; depth is along z, infinite where no panel is.
    """
    n = rays.x.size
    light, depth = np.empty(n, np.float32), np.empty(n, np.float32)
    views = views_of(world.panels, position[None], rotation[None])[0]
    every, nearest = np.arange(world.panels.n), np.zeros(world.panels.n)
    render_span(Backdrop.of(world, eps), views, rotation, every, nearest, rays, 0, n, light, depth)
    return light, depth
