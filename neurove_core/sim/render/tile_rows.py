"""The numbers of one tile of pixels, row by row in one array: what its kernels work in."""

from typing import Final

import numpy as np
from numpy.typing import NDArray

from neurove_core.sim.render.camera import TILE, Rays
from neurove_core.sim.render.compile import fast

LANES: Final = TILE * TILE
"""Pixels of a tile; one that has fewer repeats its last."""

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
"""Where each row of a tile's numbers begins in the one array that holds them all: so the compiler sees that they do not
overlap. X, Y: of the ray, from the tile's first; STEP_X, STEP_Y: see Rays; SLANT2: squared distance over squared depth;
DEPTH, BEHIND: of the two nearest panels, PANEL, SECOND: which (-1 none), COVER: which share the nearest covers; FRONT,
BACK, SKY: intensities of those two and of what is behind; LIGHT: log intensity; SHADE: rows that shade.py works in."""

ROWS: Final = 36
"""Rows in all."""


@fast
def load_tile(rays: Rays, tile: int, work: NDArray[np.float32]) -> None:  # pragma: no cover (machine code)
    """Put the rays of a tile into its rows."""
    first, stop = rays.first[tile], rays.first[tile + 1]
    for p in range(LANES):
        i = min(first + p, stop - 1)
        x, y = rays.x[i], rays.y[i]
        work[X + p], work[Y + p] = x - rays.x[first], y - rays.y[first]
        work[STEP_X + p], work[STEP_Y + p] = rays.step_x[i], rays.step_y[i]
        work[SLANT2 + p] = 1 + x * x + y * y
