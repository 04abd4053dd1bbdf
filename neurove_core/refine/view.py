"""View: how the refinement sees the events of one camera: the ray of each pixel, and the size of its image."""

from typing import Final, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from neurove_core.geometry.tables import TABLES
from neurove_core.ingest.sample import Sample
from neurove_core.refine.alignment import Grid, Rays
from neurove_protocol import CameraInfo
from neurove_protocol.errors import NoTable

MAX_PIXELS: Final = 1 << 20
"""The estimates of a larger sensor are not refined: its table would take too long to build."""

CELL_PX: Final = 1.25
"""Least width of a cell of the image [px]. Cells of one pixel lock the moved events to the pixels of the sensor."""

MAX_CELLS: Final = 1 << 16
"""Cells of the image; a larger sensor has wider cells."""

_MARGIN: Final = 0.12  # of the image around the sensor [rad]
_MAX_RAY: Final = 2.0  # |x/z| and |y/z|; events outside are left out


class View(NamedTuple):
    """The rays of a camera and the image that its events are drawn into."""

    rays: NDArray[np.float32]  # (2, height, width), see geometry.camera.ray_table
    grid: Grid

    @classmethod
    def of(cls, camera: CameraInfo) -> Self | None:
        """The view of a camera; None if the sensor is too large, or no memory is left for its rays."""
        if camera.width * camera.height > MAX_PIXELS:
            return None
        try:
            rays = TABLES.rays(camera)
        except NoTable:
            return None
        low, high = np.full(2, -_MAX_RAY), np.full(2, _MAX_RAY)
        for axis in (0, 1):
            seen = rays[axis][np.abs(rays[axis]) <= _MAX_RAY]
            if not seen.size:
                return None
            low[axis], high[axis] = seen.min() - _MARGIN, seen.max() + _MARGIN
        width, height = high - low
        focal = min(camera.fx / CELL_PX, float(np.sqrt(MAX_CELLS / (width * height))))
        return cls(rays, Grid(focal, float(low[0]), float(low[1]), int(width * focal), int(height * focal)))

    def rays_of(self, sample: Sample, window_us: int) -> Rays:
        """The events of a window of this length [us] as rays, without those outside the lens model."""
        x, y = self.rays[:, sample.y, sample.x]
        seen = (np.abs(x) <= _MAX_RAY) & (np.abs(y) <= _MAX_RAY)  # nan is not seen
        time = ((sample.t_us + np.float32(0.5)) / np.float32(window_us) - np.float32(0.5)).astype(np.float32)
        return Rays(x[seen], y[seen], time[seen], np.ones(np.count_nonzero(seen), np.float32))
