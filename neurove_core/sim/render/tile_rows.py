"""Work space of the kernels for one tile of pixels: rows in one array."""

from typing import Final

import numpy as np
from numpy.typing import NDArray

from neurove_core.sim.render.camera import TILE, Rays
from neurove_core.sim.render.compile import fast

LANES: Final = TILE * TILE
"""Pixels of a tile; a tile with fewer pixels repeats its last one."""

X: Final = 0 * LANES
Y: Final = 1 * LANES
STEP_X: Final = 2 * LANES
STEP_Y: Final = 3 * LANES
SLANT2: Final = 4 * LANES
DEPTH: Final = 5 * LANES
BEHIND: Final = 6 * LANES
PANEL: Final = 7 * LANES
SECOND: Final = 8 * LANES
COVER: Final = 9 * LANES
FRONT: Final = 10 * LANES
BACK: Final = 11 * LANES
SKY: Final = 12 * LANES
LIGHT: Final = 13 * LANES
SHADE: Final = 14 * LANES
"""Start of each row in the array. The rows share one array so that the compiler sees that they do not overlap.

X, Y: ray, relative to the first ray of the tile; STEP_X, STEP_Y: see Rays; SLANT2: squared distance over squared depth;
DEPTH, BEHIND: depths of the two nearest panels; PANEL, SECOND: their indices (-1: none); COVER: share of the pixel that
the nearest panel covers; FRONT, BACK, SKY: intensities of the two panels and of the sky; LIGHT: log intensity; SHADE:
work space of shade.py."""

ROWS: Final = 36
"""Number of rows."""


@fast
def load_tile(rays: Rays, tile: int, work: NDArray[np.float32]) -> None:  # pragma: no cover (machine code)
    """Load the rays of a tile into its rows."""
    first, stop = rays.first[tile], rays.first[tile + 1]
    for p in range(LANES):
        i = min(first + p, stop - 1)
        x, y = rays.x[i], rays.y[i]
        work[X + p], work[Y + p] = x - rays.x[first], y - rays.y[first]
        work[STEP_X + p], work[STEP_Y + p] = rays.step_x[i], rays.step_y[i]
        work[SLANT2 + p] = 1 + x * x + y * y
