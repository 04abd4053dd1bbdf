"""Simulate one interval: render each tile at its own rate, and make the events of its pixels.

The image of a driving camera moves fast at its borders and slowly in the middle. Each tile therefore has its own step
between renders, from the greatest motion in and around it. This keeps the same bound for every pixel with about a fifth
of the renders that one rate for the whole sensor would need.
"""

import math
from typing import Final

import numpy as np
from numpy.typing import NDArray

from neurove_core.sim.render.camera import Rays
from neurove_core.sim.render.compile import fast
from neurove_core.sim.render.cull import Candidates
from neurove_core.sim.render.pixels import EventBuffer, Mismatch, PixelState, find_crossings
from neurove_core.sim.render.tile import render_tile
from neurove_core.sim.render.tile_rows import DEPTH, LANES, LIGHT, ROWS, load_tile
from neurove_core.sim.render.views import Backdrop

GRIDS: Final = (60, 240, 960)
"""Numbers of equal steps of an interval; a tile is rendered after all or some of them."""


@fast
def tile_speeds(
    rays: Rays, depth: NDArray[np.float32], twists: NDArray[np.float64], out: NDArray[np.float64]
) -> None:  # pragma: no cover (machine code)
    """Compute the greatest image motion in each tile [px/s].

    Source: the motion field of a rigid scene (Longuet-Higgins and Prazdny 1980), divided by the size of the pixel.

    Args:
        rays: of the camera.
        depth: (N,) of each ray [m].
        twists: (K, 6); the greatest motion of these counts.
        out: (M,) filled.
    """
    for tile in range(out.size):
        most = 0.0
        for i in range(rays.first[tile], rays.first[tile + 1]):
            x, y, near = rays.x[i], rays.y[i], 1.0 / depth[i]
            for k in range(twists.shape[0]):
                vx, vy, vz, wx, wy, wz = twists[k]
                dx = (x * vz - vx) * near + x * y * wx - (1 + x * x) * wy + y * wz
                dy = (y * vz - vy) * near + (1 + y * y) * wx - x * y * wy - x * wz
                dx /= rays.step_x[i]
                dy /= rays.step_y[i]
                most = max(most, dx * dx + dy * dy)
        out[tile] = math.sqrt(most)


@fast
def run_tiles(
    backdrop: Backdrop,
    rays: Rays,
    candidates: Candidates,
    views: NDArray[np.float64],
    rotations: NDArray[np.float64],
    parts: NDArray[np.int64],
    span_us: float,
    weights: NDArray[np.float64],
    mismatch: Mismatch,
    state: PixelState,
    depth: NDArray[np.float32],
) -> EventBuffer:  # pragma: no cover (machine code)
    """Render each tile in equal steps to the end of the interval; return the unsorted events.

    Args:
        backdrop: of the world.
        rays: of the camera.
        candidates: panels that each tile may see in the interval.
        views: (G + 1, candidates.kept, VIEW) at each step of the grid, including the start of the interval.
        rotations: (G + 1, 3, 3) at the same times.
        parts: (M,) number of steps of each tile; each divides G.
        span_us: duration of the interval.
        weights: (G + 1, 3) of low_pass; row k is for an interval of k steps.
        mismatch: of the pixels of the sensor, in the order of the rays.
        state: of the pixels; changed in place.
        depth: (N,) changed in place.
    """
    steps = views.shape[0] - 1
    t, pixel, p, n = np.empty(4096, np.int32), np.empty(4096, np.int32), np.empty(4096, np.uint8), 0
    work = np.empty(ROWS * LANES, np.float32)
    for tile in range(parts.size):
        a, b = candidates.first[tile], candidates.first[tile + 1]
        panel, nearest = candidates.panel[a:b], candidates.nearest[a:b]
        first, stop, count = rays.first[tile], rays.first[tile + 1], parts[tile]
        light = work[LIGHT : LIGHT + stop - first]
        load_tile(rays, tile, work)
        weight = (weights[count, 0], weights[count, 1], weights[count, 2])
        for k in range(1, count + 1):
            j = k * (steps // count)
            render_tile(backdrop, views[j], rotations[j], panel, nearest, rays.x[first], rays.y[first], work)
            start_us, stop_us, done = (k - 1) * span_us / count, k * span_us / count, 0
            while True:
                done, n = find_crossings(
                    mismatch, state, light, first, done, weight, start_us, stop_us, EventBuffer(t, pixel, p, n)
                )
                if done == light.size:
                    break
                t = np.concatenate((t, np.empty_like(t)))
                pixel = np.concatenate((pixel, np.empty_like(pixel)))
                p = np.concatenate((p, np.empty_like(p)))
        depth[first:stop] = work[DEPTH : DEPTH + stop - first]
    return EventBuffer(t, pixel, p, n)
