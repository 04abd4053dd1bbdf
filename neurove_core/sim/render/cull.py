"""Culling: the panels that a tile may see during an interval."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from neurove_core.sim.render.compile import fast
from neurove_core.sim.render.views import NEAR_M


class Candidates(NamedTuple):
    """Panels by tile, M tiles: tile m may see panel[first[m]] to panel[first[m + 1] - 1], nearest first."""

    kept: NDArray[np.int64]  # indices of the panels that any tile may see
    first: NDArray[np.int64]  # (M + 1,)
    panel: NDArray[np.int64]  # (K,) index into `kept`
    nearest: NDArray[np.float64]  # (K,) lower bound of the depth of the panel [m]


@fast
def _corners_of(view: NDArray[np.float64], corner: NDArray[np.float64]) -> None:  # pragma: no cover (machine code)
    """Fill in the corners (4, 3) of a panel in the frame of the camera."""
    for c in range(4):
        # from the camera, in the coordinates of the panel, to the corner
        du = (view[12] if c in (0, 3) else -view[12]) - view[9]
        dv = (view[13] if c < 2 else -view[13]) - view[10]
        for k in range(3):
            corner[c, k] = view[k] * du + view[3 + k] * dv + view[6 + k] * view[11]


@fast
def _edges_of(
    views: NDArray[np.float64], corner: NDArray[np.float64], edges: NDArray[np.float64]
) -> None:  # pragma: no cover (machine code)
    """Planes through the camera and the edges of a panel; a ray (x, y, 1) hits it only inside all four planes.

    Args:
        views: (P, VIEW) of the panel from P poses.
        corner: (4, 3) work space.
        edges: (P, 4, 3) filled with the unit normals, which point inwards.
    """
    for j in range(views.shape[0]):
        _corners_of(views[j], corner)
        for c in range(4):
            a, b, across = corner[c], corner[(c + 1) % 4], corner[(c + 2) % 4]
            x = a[1] * b[2] - a[2] * b[1]
            y = a[2] * b[0] - a[0] * b[2]
            z = a[0] * b[1] - a[1] * b[0]
            inner = x * across[0] + y * across[1] + z * across[2]
            scale = np.sqrt(x * x + y * y + z * z)
            if abs(inner) <= 1e-9 * scale * (abs(across[0]) + abs(across[1]) + abs(across[2])):
                scale = np.inf  # seen edge-on: no information
            scale = scale if inner > 0 else -scale
            edges[j, c, 0], edges[j, c, 1], edges[j, c, 2] = x / scale, y / scale, z / scale


@fast
def _may_hit(edges: NDArray[np.float64], tile: NDArray[np.float64], around: float) -> bool:  # pragma: no cover
    """Whether the tile, widened by `around`, is not completely outside an edge, for any pose."""
    for j in range(edges.shape[0]):
        outside = False
        for c in range(4):
            x, y, z = edges[j, c]
            most = max(x * tile[0], x * tile[2]) + max(y * tile[1], y * tile[3]) + z
            outside |= most < -around * (abs(x) + abs(y)) - 1e-12
        if not outside:
            return True
    return False


@fast
def _box_of(
    view: NDArray[np.float64], box: NDArray[np.float64], corner: NDArray[np.float64]
) -> float:  # pragma: no cover (machine code)
    """Bounding box of a panel in the image: least x, least y, greatest x, greatest y of its part in front.

    Args:
        view: (VIEW,) of the panel.
        box: (4,) filled.
        corner: (4, 3) filled with its corners in the frame of the camera.

    Returns:
        its least depth; infinite if it lies behind the camera.
    """
    box[0], box[1], box[2], box[3] = np.inf, np.inf, -np.inf, -np.inf
    nearest = np.inf
    _corners_of(view, corner)
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
    views: NDArray[np.float64], tiles: NDArray[np.float64], far_m: float, margin: float
) -> Candidates:  # pragma: no cover (machine code)
    """Find the panels that each tile may see.

    Args:
        views: (P, N, VIEW) from some poses in the interval, including its ends.
        tiles: (M, 4) box of the rays of each tile; see Rays.box.
        far_m: greatest visible distance.
        margin: added around each tile, in the units of x and y of a ray.
    """
    n, m = views.shape[1], tiles.shape[0]
    boxes, nearest = np.empty((n, 4)), np.full(n, np.inf)
    box, corner, around = np.empty(4), np.empty((4, 3)), np.empty(n)
    for i in range(n):
        boxes[i] = (np.inf, np.inf, -np.inf, -np.inf)
        moved = 0.0
        for j in range(views.shape[0]):
            z = _box_of(views[j, i], box, corner)
            nearest[i] = min(nearest[i], z)
            if not np.isfinite(z):
                continue
            for k in range(4):
                if j and np.isfinite(boxes[i, k]):
                    moved = max(moved, min(abs(box[k] - boxes[i, k]), 1.0))
            boxes[i, 0], boxes[i, 1] = min(boxes[i, 0], box[0]), min(boxes[i, 1], box[1])
            boxes[i, 2], boxes[i, 3] = max(boxes[i, 2], box[2]), max(boxes[i, 3], box[3])
        around[i] = margin + 0.3 * moved  # the panel does not move in an exact straight line between the poses
        boxes[i, 0] -= around[i]
        boxes[i, 1] -= around[i]
        boxes[i, 2] += around[i]
        boxes[i, 3] += around[i]
        nearest[i] = max(0.98 * nearest[i] - 0.1, 0.0)
    order = np.argsort(nearest)
    low_x, low_y = np.ascontiguousarray(tiles[:, 0]), np.ascontiguousarray(tiles[:, 1])
    high_x, high_y = np.ascontiguousarray(tiles[:, 2]), np.ascontiguousarray(tiles[:, 3])
    edge = (low_x.min(), low_y.min(), high_x.max(), high_y.max())
    wanted = np.zeros(n, np.bool_)
    for i in range(n):
        inside = boxes[i, 0] <= edge[2] and boxes[i, 2] >= edge[0] and boxes[i, 1] <= edge[3] and boxes[i, 3] >= edge[1]
        wanted[i] = inside and nearest[i] < far_m
    kept, place = (
        np.flatnonzero(wanted),
        np.cumsum(wanted) - 1,
    )  # in their own order, which decides between equal depths
    order = order[wanted[order]]
    count = kept.size
    seen = np.empty((count, m), np.bool_)
    first = np.zeros(m + 1, np.int64)
    edges = np.empty((views.shape[0], 4, 3))
    for k in range(count):
        x0, y0, x1, y1 = boxes[order[k]]
        _edges_of(views[:, order[k]], corner, edges)
        for tile in range(m):  # `&`, not `and`: without branches this handles a few tiles per cycle
            touch = (x0 <= high_x[tile]) & (x1 >= low_x[tile]) & (y0 <= high_y[tile]) & (y1 >= low_y[tile])
            seen[k, tile] = touch
        for tile in range(m):
            if seen[k, tile]:
                seen[k, tile] = _may_hit(edges, tiles[tile], around[order[k]])
                first[tile + 1] += seen[k, tile]
    first = first.cumsum()
    panel, depth = np.empty(first[m], np.int64), np.empty(first[m])
    put = first[:m].copy()
    for k in range(count):
        for tile in range(m):
            if seen[k, tile]:
                panel[put[tile]], depth[put[tile]] = place[order[k]], nearest[order[k]]
                put[tile] += 1
    return Candidates(kept, first, panel, depth)
