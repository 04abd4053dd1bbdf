"""Render images: log intensity and depth of each pixel of a camera."""

import numpy as np
from numpy.typing import NDArray

from neurove_core.sim.render.camera import Rays
from neurove_core.sim.render.compile import fast
from neurove_core.sim.render.cull import Candidates
from neurove_core.sim.render.tile import render_tile
from neurove_core.sim.render.tile_rows import DEPTH, LANES, LIGHT, ROWS, load_tile
from neurove_core.sim.render.views import Backdrop, World, views_of


@fast
def render_all(
    backdrop: Backdrop,
    rays: Rays,
    candidates: Candidates,
    views: NDArray[np.float64],
    rotation: NDArray[np.float64],
    light: NDArray[np.float32],
    depth: NDArray[np.float32],
) -> None:  # pragma: no cover (machine code)
    """Render log intensity (N,) and depth (N,) of all tiles from one pose, given by its views and rotation."""
    work = np.empty(ROWS * LANES, np.float32)
    for tile in range(rays.first.size - 1):
        a, b = candidates.first[tile], candidates.first[tile + 1]
        panel, nearest = candidates.panel[a:b], candidates.nearest[a:b]
        first, n = rays.first[tile], rays.first[tile + 1] - rays.first[tile]
        load_tile(rays, tile, work)
        render_tile(backdrop, views, rotation, panel, nearest, rays.x[first], rays.y[first], work)
        light[first : first + n], depth[first : first + n] = work[LIGHT : LIGHT + n], work[DEPTH : DEPTH + n]


def render(
    world: World, rays: Rays, position: NDArray[np.float64], rotation: NDArray[np.float64], eps: float
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Render one image, every ray against every panel.

    Args:
        world: panels, textures and sky.
        rays: of the camera.
        position: (3,) of the camera in the world [m].
        rotation: (3, 3) camera to world.
        eps: added to the linear intensity before its logarithm.

    Returns:
        log intensity (N,) and depth (N,) [m] of each ray; depth is along z, and infinite where there is no panel.
    """
    tiles, panels = rays.first.size - 1, np.arange(world.panels.n)
    light, depth = np.empty(rays.x.size, np.float32), np.empty(rays.x.size, np.float32)
    views = views_of(world.panels, position[None], rotation[None])[0]
    first = np.arange(tiles + 1) * panels.size
    every = Candidates(panels, first, np.tile(panels, tiles), np.zeros(tiles * panels.size))
    render_all(Backdrop.of(world, eps), rays, every, views, rotation, light, depth)
    return light, depth
