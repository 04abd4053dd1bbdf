"""Ray casting of one tile of pixels: find the panels that its rays hit, and their light.

Panels are transformed into the frame of the camera, where a ray is the fixed (x, y, 1) of its pixel. A hit then costs
three inner products, and its parameter is the depth z itself. A pixel on the edge of a panel mixes the panel with the
background by their shares, so that an edge moves smoothly between two renders.

All loops run over the LANES pixels of a tile, in single precision and without branches, so that the compiler handles 8
or 16 pixels at once. Values that are common to all pixels are computed once, in double precision. Rays are relative to
the first ray of the tile, which keeps the plane of a panel exact to 1e-7 of its depth where it is seen edge-on.
"""

import numpy as np
from numpy.typing import NDArray

from neurove_core.sim.render.compile import fast
from neurove_core.sim.render.shade import sky_of, texture_of
from neurove_core.sim.render.tile_rows import (
    BACK,
    BEHIND,
    COVER,
    DEPTH,
    FRONT,
    LANES,
    LIGHT,
    PANEL,
    SECOND,
    SHADE,
    SKY,
    SLANT2,
    STEP_X,
    STEP_Y,
    X,
    Y,
)
from neurove_core.sim.render.views import NEAR_M, Backdrop
from neurove_core.sim.world.panels import CLEAR2

_ZERO, _HALF, _ONE = np.float32(0), np.float32(0.5), np.float32(1)
_NEAR, _CLEAR2, _FADING = np.float32(NEAR_M), np.float32(CLEAR2), np.float32(1 / (1 - CLEAR2))
_REACH, _TINY, _INF, _NONE = np.float32(6), np.float32(1e-12), np.float32(np.inf), np.float32(-1)


@fast
def render_tile(
    backdrop: Backdrop,
    views: NDArray[np.float64],
    rotation: NDArray[np.float64],
    candidates: NDArray[np.int64],
    nearest: NDArray[np.float64],
    x0: float,
    y0: float,
    work: NDArray[np.float32],
) -> None:  # pragma: no cover (machine code)
    """Render a tile: fill the rows LIGHT and DEPTH.

    Args:
        backdrop: of the world.
        views: (N, VIEW) of all panels from this pose.
        rotation: (3, 3) camera to world.
        candidates: panels that the rays may hit, sorted by their least depth.
        nearest: lower bounds of those depths [m].
        x0: of the first ray of the tile.
        y0: of the first ray of the tile.
        work: (ROWS * LANES,) filled by load_tile.
    """
    for p in range(LANES):
        work[DEPTH + p] = work[BEHIND + p] = _INF
        work[PANEL + p] = work[SECOND + p] = _NONE
        work[COVER + p] = work[FRONT + p] = work[BACK + p] = work[SKY + p] = _ZERO
    met, far2 = candidates.size, np.float32(backdrop.far_m * backdrop.far_m)
    for k in range(candidates.size):
        if _all_nearer(work, np.float32(nearest[k])):
            met = k
            break
        _meet(views[candidates[k]], candidates[k], x0, y0, far2, work)
    for k in range(met):
        panel = np.float32(candidates[k])
        if _seen(work, panel):
            texture_of(backdrop.texels, views[candidates[k]], panel, x0, y0, work)
    _look_behind(backdrop, rotation, x0, y0, far2, work)
    _mix(np.float32(backdrop.eps), far2, work)


@fast
def _all_nearer(work: NDArray[np.float32], depth: np.float32) -> bool:  # pragma: no cover (machine code)
    """Whether every pixel hides everything from this depth on."""
    open_ = 0
    for p in range(LANES):
        last = work[DEPTH + p] if work[COVER + p] >= _ONE else work[BEHIND + p]
        open_ += last >= depth
    return open_ == 0


@fast
def _meet(
    view: NDArray[np.float64], i: int, x0: float, y0: float, far2: np.float32, work: NDArray[np.float32]
) -> None:  # pragma: no cover (machine code)
    """Intersect the rays with a panel: depth and covered share of each pixel; the two nearest panels are kept."""
    f = np.float32
    u1, u2, u0 = f(view[0]), f(view[1]), f(view[0] * x0 + view[1] * y0 + view[2])
    v1, v2, v0 = f(view[3]), f(view[4]), f(view[3] * x0 + view[4] * y0 + view[5])
    n1, n2, n0 = f(view[6]), f(view[7]), f(view[6] * x0 + view[7] * y0 + view[8])
    at_u, at_v, away, half_u, half_v = f(view[9]), f(view[10]), f(view[11]), f(view[12]), f(view[13])
    panel = f(i)
    for p in range(LANES):
        x, y, sx, sy = work[X + p], work[Y + p], work[STEP_X + p], work[STEP_Y + p]
        inverse = _ONE / (n0 + n1 * x + n2 * y)
        ud, vd = u0 + u1 * x + u2 * y, v0 + v1 * x + v2 * y
        t = away * inverse
        reach = _REACH * t * (sx + sy)
        gx, gy = sx * n1 * inverse, sy * n2 * inverse
        wide_u = min(t * (abs(sx * u1 - ud * gx) + abs(sy * u2 - ud * gy)), reach)
        wide_v = min(t * (abs(sx * v1 - vd * gx) + abs(sy * v2 - vd * gy)), reach)
        share_u = min(max((half_u - abs(t * ud + at_u)) / max(wide_u, _TINY) + _HALF, _ZERO), _ONE)
        share_v = min(max((half_v - abs(t * vd + at_v)) / max(wide_v, _TINY) + _HALF, _ZERO), _ONE)
        share = share_u * share_v
        first, second = work[DEPTH + p], work[BEHIND + p]
        panel1, panel2, cover = work[PANEL + p], work[SECOND + p], work[COVER + p]
        # of two panels in one plane, the same one is always in front; otherwise they would flicker
        before = (t < first) | ((t == first) & (panel < panel1))
        between = (t < second) | ((t == second) & (panel < panel2))
        hit = between & (t > _NEAR) & (t * t * work[SLANT2 + p] < far2) & (share > _ZERO)
        before &= hit
        work[BEHIND + p] = first if before else (t if hit else second)
        work[SECOND + p] = panel1 if before else (panel if hit else panel2)
        work[DEPTH + p] = t if before else first
        work[PANEL + p] = panel if before else panel1
        work[COVER + p] = share if before else cover


@fast
def _seen(work: NDArray[np.float32], panel: np.float32) -> bool:  # pragma: no cover (machine code)
    """Whether any pixel shows this panel."""
    count = 0
    for p in range(LANES):
        through = (work[SECOND + p] == panel) & (work[COVER + p] < _ONE)
        count += (work[PANEL + p] == panel) | through
    return count > 0


@fast
def _look_behind(
    backdrop: Backdrop, rotation: NDArray[np.float64], x0: float, y0: float, far2: np.float32, work: NDArray[np.float32]
) -> None:  # pragma: no cover (machine code)
    """Fill the row SKY where the sky is visible: next to panels, and through distant panels that fade."""
    for p in range(LANES):
        t1, t2 = work[DEPTH + p], work[BEHIND + p]
        t = t2 if work[COVER + p] < _ONE else t1
        if t * t * work[SLANT2 + p] > _CLEAR2 * far2:
            work[SKY + p] = sky_of(backdrop.sky, backdrop.haze, rotation, x0 + work[X + p], y0 + work[Y + p])


@fast
def _mix(eps: np.float32, far2: np.float32, work: NDArray[np.float32]) -> None:  # pragma: no cover (machine code)
    """Fill the row LIGHT: mix the two nearest panels and the sky."""
    ints = work.view(np.int32)
    for p in range(LANES):
        sky, slant2 = work[SKY + p], work[SLANT2 + p] / far2
        back = sky + _clear(work[BEHIND + p] * work[BEHIND + p] * slant2) * (work[BACK + p] - sky)
        front = sky + _clear(work[DEPTH + p] * work[DEPTH + p] * slant2) * (work[FRONT + p] - sky)
        cover = work[COVER + p]
        work[LIGHT + p] = eps + (front if cover >= _ONE else back + cover * (front - back))
    for p in range(LANES):
        bits = ints[LIGHT + p]
        exponent = np.int32((bits >> 23) - 127)
        ints[SHADE + p] = np.int32((bits & 0x7FFFFF) | 0x3F800000)  # the mantissa, from 1 to 2
        work[LIGHT + p] = np.float32(exponent)
    for p in range(LANES):
        m = work[SHADE + p]
        large = m >= _MIDDLE
        e = work[LIGHT + p] + (_ONE if large else _ZERO)
        m = m * (_HALF if large else _ONE)
        s = (m - _ONE) / (m + _ONE)  # ln m = 2 artanh s, |s| <= 1/5: four terms are exact to 1e-7
        s2 = s * s
        work[LIGHT + p] = e * _LN2 + s * (_TWO + s2 * (_THIRDS + s2 * (_FIFTHS + s2 * _SEVENTHS)))


_MIDDLE, _LN2, _TWO = np.float32(1.5), np.float32(np.log(2)), np.float32(2)
_THIRDS, _FIFTHS, _SEVENTHS = np.float32(2 / 3), np.float32(2 / 5), np.float32(2 / 7)


@fast
def _clear(far: np.float32) -> np.float32:  # pragma: no cover (machine code)
    """Visibility of a point at this squared ratio of its distance to the greatest visible distance."""
    clear = min(max((_ONE - far) * _FADING, _ZERO), _ONE)
    return clear * clear
