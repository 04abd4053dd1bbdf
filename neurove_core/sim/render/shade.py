"""Shading: sample the texture of a panel and the sky along the rays of a tile.

Textures are sampled trilinearly, with up to TAPS samples along the longer axis of the footprint of the pixel.
"""

import math
from typing import Final

import numpy as np
from numpy.typing import NDArray

from neurove_core.sim.render.compile import fast
from neurove_core.sim.render.tile_rows import BACK, FRONT, LANES, PANEL, SECOND, SHADE, STEP_X, STEP_Y, X, Y
from neurove_core.sim.world.panels import SKY_COLUMNS, SKY_ROWS, SKY_TOP
from neurove_core.sim.world.textures import CHAIN, LEVELS, SIZE

TAPS: Final = 3
"""Greatest number of samples along the longer axis of the footprint."""

_U: Final = SHADE
_V: Final = SHADE + 1 * LANES
_LONG_U: Final = SHADE + 2 * LANES
_LONG_V: Final = SHADE + 3 * LANES
_TAPS: Final = SHADE + 4 * LANES
_LEVEL: Final = SHADE + 5 * LANES
_BLEND: Final = SHADE + 6 * LANES
_SUM: Final = SHADE + 7 * LANES
_SCALE: Final = SHADE + 8 * LANES
_START: Final = SHADE + 9 * LANES
_FINE: Final = SHADE + 10 * LANES
_COARSE: Final = SHADE + 16 * LANES

_ZERO, _HALF, _ONE, _TWO, _THREE = np.float32(0), np.float32(0.5), np.float32(1), np.float32(2), np.float32(3)
_TWO_FROM, _THREE_FROM = np.float32(1.5**2), np.float32(2.001**2)  # squared ratio of the sides of the footprint
_MOST_LOD, _LAST = np.float32(LEVELS - 1 - 1e-6), np.float32(LEVELS - 2)
_EXPONENT, _BIAS = np.float32(0.5 / (1 << 23)), np.float32(63.5)
_SIZE = np.float32(SIZE)
_LARGER = np.float32(4 / 3)  # size of a level with all finer levels except the finest, relative to the level
_SKY_SCALE: Final = (SKY_ROWS - 1) / SKY_TOP


@fast
def texture_of(
    texels: NDArray[np.float32],
    view: NDArray[np.float64],
    panel: np.float32,
    x0: float,
    y0: float,
    work: NDArray[np.float32],
) -> None:  # pragma: no cover (machine code)
    """Fill the rows FRONT and BACK of the pixels that show this panel.

    Args:
        texels: see Textures.
        view: (VIEW,) of the panel.
        panel: its index, as in the rows PANEL and SECOND.
        x0: of the first ray of the tile.
        y0: of the first ray of the tile.
        work: of the tile.
    """
    most = _footprint(view, panel, x0, y0, work)
    base = np.float32(view[18] * CHAIN)
    for tap in range(most):
        _read(texels, base, np.float32(tap), work)
    gain = np.float32(view[19])
    for p in range(LANES):
        value = gain * work[_SUM + p]
        work[FRONT + p] = value if work[PANEL + p] == panel else work[FRONT + p]
        work[BACK + p] = value if work[SECOND + p] == panel else work[BACK + p]


@fast
def _footprint(
    view: NDArray[np.float64], panel: np.float32, x0: float, y0: float, work: NDArray[np.float32]
) -> int:  # pragma: no cover (machine code)
    """Footprint of each pixel on the texture [texels]: position, longer side, number of samples, and mip level.

    Pixels that do not show the panel get an arbitrary position.

    Returns:
        the greatest number of samples of a pixel.
    """
    f, ku, kv = np.float32, view[14], view[15]
    u1, u2, u0 = f(view[0] * ku), f(view[1] * ku), f((view[0] * x0 + view[1] * y0 + view[2]) * ku)
    v1, v2, v0 = f(view[3] * kv), f(view[4] * kv), f((view[3] * x0 + view[4] * y0 + view[5]) * kv)
    n1, n2, n0 = f(view[6]), f(view[7]), f(view[6] * x0 + view[7] * y0 + view[8])
    # the texture repeats; near its origin single precision is enough
    at_u, at_v = f((view[9] * ku + view[16]) % SIZE), f((view[10] * kv + view[17]) % SIZE)
    away = f(view[11])
    ints = work.view(np.int32)
    twos = threes = 0
    for p in range(LANES):
        x, y, sx, sy = work[X + p], work[Y + p], work[STEP_X + p], work[STEP_Y + p]
        shown = (work[PANEL + p] == panel) | (work[SECOND + p] == panel)
        inverse = _ONE / (n0 + n1 * x + n2 * y)
        ud, vd = u0 + u1 * x + u2 * y, v0 + v1 * x + v2 * y
        t = away * inverse
        gx, gy = sx * n1 * inverse, sy * n2 * inverse
        ux, vx = t * (sx * u1 - ud * gx), t * (sx * v1 - vd * gx)
        uy, vy = t * (sy * u2 - ud * gy), t * (sy * v2 - vd * gy)
        x2, y2 = ux * ux + vx * vx, uy * uy + vy * vy
        wide = x2 >= y2
        long2, short2 = (x2 if wide else y2), (y2 if wide else x2)
        two, three = (long2 > _TWO_FROM * short2) & shown, (long2 > _THREE_FROM * short2) & shown
        twos += two
        threes += three
        part = _THREE if three else (_TWO if two else _ONE)
        work[_TAPS + p] = part
        work[_LONG_U + p], work[_LONG_V + p] = (ux if wide else uy), (vx if wide else vy)
        work[_U + p], work[_V + p] = (t * ud + at_u if shown else _ZERO), (t * vd + at_v if shown else _ZERO)
        work[_LEVEL + p] = max(max(short2, long2 / (part * part)), _ONE)
        work[_SUM + p] = _ZERO
    for p in range(LANES):
        # the logarithm as straight lines between powers of two, from the bits of the number: continuous, with an error
        # of at most 0.05 of a level
        lod = min(np.float32(ints[_LEVEL + p]) * _EXPONENT - _BIAS, _MOST_LOD)
        level = np.floor(lod)
        # near a level only that level is read; the transition between two levels is steeper in return
        work[_BLEND + p] = min(max(_TWO * (lod - level) - _HALF, _ZERO), _ONE)
        exponent = np.int32(min(max(level, _ZERO), _LAST))
        ints[_SCALE + p] = np.int32((127 - exponent) << 23)  # the bits of 1 / 2^level
    for p in range(LANES):
        side = _SIZE * work[_SCALE + p]
        work[_START + p] = np.floor(_LARGER * (_SIZE * _SIZE - side * side) + _HALF)
    return 3 if threes else (2 if twos else 1)


@fast
def _read(
    texels: NDArray[np.float32], base: np.float32, tap: np.float32, work: NDArray[np.float32]
) -> None:  # pragma: no cover (machine code)
    """Add one sample of the texture to the sum of each pixel: bilinear in two levels, and linear between them."""
    ints = work.view(np.int32)
    for p in range(LANES):
        share, fine = (tap + _HALF) / work[_TAPS + p] - _HALF, work[_SCALE + p]
        side, start = _SIZE * fine, base + work[_START + p]
        u, v = (work[_U + p] + share * work[_LONG_U + p]) * fine, (work[_V + p] + share * work[_LONG_V + p]) * fine
        upper, lower, left, right, du, dv = _around(u, v, start, side)
        ints[_FINE + p], ints[_FINE + LANES + p] = np.int32(upper + left), np.int32(upper + right)
        ints[_FINE + 2 * LANES + p], ints[_FINE + 3 * LANES + p] = np.int32(lower + left), np.int32(lower + right)
        work[_FINE + 4 * LANES + p], work[_FINE + 5 * LANES + p] = du, dv
        upper, lower, left, right, du, dv = _around(_HALF * u, _HALF * v, start + side * side, _HALF * side)
        ints[_COARSE + p], ints[_COARSE + LANES + p] = np.int32(upper + left), np.int32(upper + right)
        ints[_COARSE + 2 * LANES + p], ints[_COARSE + 3 * LANES + p] = np.int32(lower + left), np.int32(lower + right)
        work[_COARSE + 4 * LANES + p], work[_COARSE + 5 * LANES + p] = du, dv
    # a separate loop, because the compiler cannot know that reads and writes do not overlap
    for p in range(_FINE, _FINE + 4 * LANES):
        work[p] = texels[np.uint32(ints[p])]
    for p in range(_COARSE, _COARSE + 4 * LANES):
        work[p] = texels[np.uint32(ints[p])]
    for p in range(LANES):
        a, b = work[_FINE + p], work[_FINE + LANES + p]
        c, d = work[_FINE + 2 * LANES + p], work[_FINE + 3 * LANES + p]
        value = _bilinear(a, b, c, d, work[_FINE + 4 * LANES + p], work[_FINE + 5 * LANES + p])
        a, b = work[_COARSE + p], work[_COARSE + LANES + p]
        c, d = work[_COARSE + 2 * LANES + p], work[_COARSE + 3 * LANES + p]
        coarser = _bilinear(a, b, c, d, work[_COARSE + 4 * LANES + p], work[_COARSE + 5 * LANES + p])
        value += work[_BLEND + p] * (coarser - value)
        taps = work[_TAPS + p]
        work[_SUM + p] += value / taps if tap < taps else _ZERO


@fast
def _around(
    u: np.float32, v: np.float32, start: np.float32, side: np.float32
) -> tuple[np.float32, np.float32, np.float32, np.float32, np.float32, np.float32]:  # pragma: no cover (machine code)
    """The texels around (u, v) of the level at `start`: two rows, two columns, and the fractions between them."""
    u -= _HALF
    v -= _HALF
    left, top = np.floor(u), np.floor(v)
    du, dv = u - left, v - top
    each = _ONE / side
    left -= side * np.floor(left * each)  # a level repeats; whole numbers below 2^24 are exact
    top -= side * np.floor(top * each)
    right, below = left + _ONE, top + _ONE
    right = right if right < side else _ZERO
    below = below if below < side else _ZERO
    return start + top * side, start + below * side, left, right, du, dv


@fast
def _bilinear(
    a: np.float32, b: np.float32, c: np.float32, d: np.float32, du: np.float32, dv: np.float32
) -> np.float32:  # pragma: no cover (machine code)
    upper, lower = a + du * (b - a), c + du * (d - c)
    return upper + dv * (lower - upper)


@fast
def sky_of(
    image: NDArray[np.float32], haze: float, rotation: NDArray[np.float64], x: float, y: float
) -> float:  # pragma: no cover (machine code)
    """Intensity of the sky in the direction of the ray (x, y, 1)."""
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
