"""count_events: the binning kernel, and its plain reference."""

import numba
import numpy as np
from numpy.typing import NDArray

from neurove_core.geometry import OUTSIDE
from protocol import Events


def count_events(events: Events, start_us: int, bin_us: int, lut: NDArray[np.int32], counts: NDArray[np.uint8]) -> int:
    """Add events to a window's counts, in place, saturating at 255.

    Args:
        events: all with start_us <= t < start_us + n * bin_us, on the sensor of `lut`.
        start_us: of the window.
        bin_us: length of one of its n bins.
        lut: (sensor.height, sensor.width) cell of each pixel, or OUTSIDE.
        counts: (2n, H, W), changed.

    Returns:
        how many of the events no cell sees.
    """
    cells = counts.shape[1] * counts.shape[2]
    return int(_count(events.t, events.x, events.y, events.p, start_us, bin_us, lut, cells, counts.reshape(-1)))


def count_events_reference(
    events: Events, start_us: int, bin_us: int, lut: NDArray[np.int32], counts: NDArray[np.uint8]
) -> int:
    """What count_events computes, in plain numpy."""
    cell = lut[events.y, events.x]
    seen = cell != OUTSIDE
    channel = 2 * ((events.t - start_us) // bin_us) + (events.p > 0)
    index = channel[seen] * (counts.shape[1] * counts.shape[2]) + cell[seen]
    added = np.bincount(index, minlength=counts.size).reshape(counts.shape)
    counts[:] = np.minimum(counts + added, 255).astype(np.uint8)
    return int((~seen).sum())


@numba.njit(nogil=True, cache=True)  # pragma: no cover  # compiled: tests hold it against the reference instead
def _count(t, x, y, p, start_us, bin_us, lut, cells, flat):  # type: ignore[no-untyped-def]  # compiled for its arguments
    outside = 0
    for i in range(t.size):
        cell = lut[y[i], x[i]]
        if cell < 0:
            outside += 1
            continue
        channel = 2 * ((t[i] - start_us) // bin_us) + (1 if p[i] > 0 else 0)
        index = channel * cells + cell
        if flat[index] < 255:
            flat[index] += 1
    return outside
