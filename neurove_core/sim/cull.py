"""Which panels a tile may see during an interval, so that its pixels ask no others."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from neurove_core.sim.compile import fast
from neurove_core.sim.panels import Panels
from neurove_core.sim.render import NEAR_M


class Candidates(NamedTuple):
    """Panels by tile, M tiles: tile m may see panel[first[m]] up to but without panel[first[m + 1]], nearest first."""

    first: NDArray[np.int64]  # (M + 1,)
    panel: NDArray[np.int64]  # (K,) place among the panels
    nearest: NDArray[np.float64]  # (K,) least depth of any of its points, or less [m]


@fast
def _box_of(
    panels: Panels, i: int, views: NDArray[np.float64], box: NDArray[np.float64]
) -> float:  # pragma: no cover (machine code)
    """Where a panel lies in the picture: least x, least y, greatest x, greatest y of its part before the camera.

    Returns:
        its least depth, infinite if it lies behind.
    """
    box[0], box[1], box[2], box[3] = np.inf, np.inf, -np.inf, -np.inf
    nearest = np.inf
    corner = np.empty((4, 3))
    for c in range(4):
        # from the camera's place in the panel's coordinates, the corner in the camera's
        du = (panels.half[i, 0] if c in (0, 3) else -panels.half[i, 0]) - views[i, 9]
        dv = (panels.half[i, 1] if c < 2 else -panels.half[i, 1]) - views[i, 10]
        for k in range(3):
            corner[c, k] = views[i, k] * du + views[i, 3 + k] * dv + views[i, 6 + k] * views[i, 11]
    for c in range(4):
        z, other = corner[c, 2], corner[(c + 1) % 4, 2]
        if z >= NEAR_M:
            _widen(box, corner[c, 0] / z, corner[c, 1] / z)
            nearest = min(nearest, z)
        if (z >= NEAR_M) != (other >= NEAR_M):
            part = (NEAR_M - z) / (other - z)
            x = corner[c, 0] + part * (corner[(c + 1) % 4, 0] - corner[c, 0])
            y = corner[c, 1] + part * (corner[(c + 1) % 4, 1] - corner[c, 1])
            _widen(box, x / NEAR_M, y / NEAR_M)
            nearest = NEAR_M
    return nearest


@fast
def _widen(box: NDArray[np.float64], x: float, y: float) -> None:  # pragma: no cover (machine code)
    box[0], box[1] = min(box[0], x), min(box[1], y)
    box[2], box[3] = max(box[2], x), max(box[3], y)


@fast
def candidates_of(
    panels: Panels, views: NDArray[np.float64], tiles: NDArray[np.float64], far_m: float, margin: float
) -> Candidates:  # pragma: no cover (machine code)
    """The panels that each tile may see.

    Args:
        panels: N of them.
        views: (P, N, VIEW) from some places along the interval, its two ends among them.
        tiles: (M, 4) what each tile looks at; see Rays.box.
        far_m: what is further away is not seen.
        margin: added around each tile, in the units of a ray's x and y.
    """
    n, m = panels.gain.size, tiles.shape[0]
    boxes, nearest = np.empty((n, 4)), np.full(n, np.inf)
    box = np.empty(4)
    for i in range(n):
        boxes[i] = (np.inf, np.inf, -np.inf, -np.inf)
        moved = 0.0
        for j in range(views.shape[0]):
            z = _box_of(panels, i, views[j], box)
            nearest[i] = min(nearest[i], z)
            if not np.isfinite(z):
                continue
            for k in range(4):
                if j and np.isfinite(boxes[i, k]):
                    moved = max(moved, min(abs(box[k] - boxes[i, k]), 1.0))
            boxes[i, 0], boxes[i, 1] = min(boxes[i, 0], box[0]), min(boxes[i, 1], box[1])
            boxes[i, 2], boxes[i, 3] = max(boxes[i, 2], box[2]), max(boxes[i, 3], box[3])
        around = margin + 0.3 * moved  # the panel does not go quite straight from place to place
        boxes[i, 0] -= around
        boxes[i, 1] -= around
        boxes[i, 2] += around
        boxes[i, 3] += around
        nearest[i] = max(0.98 * nearest[i] - 0.1, 0.0)
    order = np.argsort(nearest)
    while n and not nearest[order[n - 1]] < far_m:
        n -= 1
    first = np.zeros(m + 1, np.int64)
    for tile in range(m):
        first[tile + 1] = first[tile]
        for i in order[:n]:
            first[tile + 1] += _touch(boxes, i, tiles, tile)
    panel, depth = np.empty(first[m], np.int64), np.empty(first[m])
    k = 0
    for tile in range(m):
        for i in order[:n]:
            if _touch(boxes, i, tiles, tile):
                panel[k], depth[k] = i, nearest[i]
                k += 1
    return Candidates(first, panel, depth)


@fast
def _touch(
    boxes: NDArray[np.float64], i: int, tiles: NDArray[np.float64], tile: int
) -> bool:  # pragma: no cover (machine code)
    return (
        boxes[i, 0] <= tiles[tile, 2]
        and boxes[i, 2] >= tiles[tile, 0]
        and boxes[i, 1] <= tiles[tile, 3]
        and boxes[i, 3] >= tiles[tile, 1]
    )
