"""Binning: events to a window's counts, compiled, and its reference implementation.

numba compiles the kernel at first use, caches it on disk, and runs it without the GIL. `count_events_reference`
computes the same in numpy; tests compare both bit for bit.
"""

from typing import Final

import numpy as np
from numpy.typing import NDArray

from neurove_core.compiled import compiled
from neurove_core.geometry.camera import OUTSIDE as NO_CELL
from neurove_core.ingest.products import scaled_cell
from neurove_core.ingest.scaling import Scale, scale_of
from neurove_protocol.events import Events


def count_events(events: Events, start_us: int, bin_us: int, lut: NDArray[np.int32], counts: NDArray[np.uint8]) -> int:
    """Add events to a window's counts, in place, saturating at 255.

    Args:
        events: all with start_us <= t < start_us + n * bin_us, ordered by time, on the sensor of `lut`.
        start_us: start of the window [us].
        bin_us: length of one of its n bins [us].
        lut: (sensor.height, sensor.width) cell of each pixel, or geometry.camera.OUTSIDE.
        counts: (2n, H, W), changed.

    Returns:
        number of events whose pixel has no cell.
    """
    cells = counts.shape[1] * counts.shape[2]
    scale = scale_of(lut, counts.shape[2])
    return _count(events, start_us, bin_us, lut, scale, cells, counts.reshape(-1))


def count_events_reference(
    events: Events, start_us: int, bin_us: int, lut: NDArray[np.int32], counts: NDArray[np.uint8]
) -> int:
    """The reference implementation of count_events, in numpy."""
    cell = lut[events.y, events.x]
    seen = cell != NO_CELL
    channel = 2 * ((events.t - start_us) // bin_us) + (events.p > 0)
    index = channel[seen] * (counts.shape[1] * counts.shape[2]) + cell[seen]
    added = np.bincount(index, minlength=counts.size).reshape(counts.shape)
    counts[:] = np.minimum(counts + added, 255).astype(np.uint8)
    return int((~seen).sum())


_BLOCK: Final = 512  # events whose pixel indices are computed together, in a loop that the compiler vectorises


@compiled
def _count(
    events: Events,
    start_us: int,
    bin_us: int,
    lut: NDArray[np.int32],
    scale: Scale,
    cells: int,
    flat: NDArray[np.uint8],
) -> int:  # pragma: no cover (machine code)
    """Count bin by bin: bisection finds a bin's last event, which saves a division per event; then block by block.

    Where the table has factors, cells are computed by vectors of products. Else they are looked up one by one while
    they are incremented; vector gathers were slower.
    """
    t, x, y, p = events.t, events.x, events.y, events.p
    pixels, columns = lut.reshape(-1), np.uint32(lut.shape[1])
    on = np.uint32(cells)
    by_row, by_column, width = np.uint32(scale.rows), np.uint32(scale.columns), np.uint32(scale.width)
    found, plane = np.empty(_BLOCK, np.uint32), np.empty(_BLOCK, np.uint32)
    outside, first = 0, 0
    for bin_ in range(flat.size // (2 * cells)):
        last = first + int(np.searchsorted(t[first:], np.int64(start_us + (bin_ + 1) * bin_us)))
        pair = flat[2 * bin_ * cells : (2 * bin_ + 2) * cells]
        for i in range(first, last, _BLOCK):
            m = min(_BLOCK, last - i)
            xs, ys, ps = x[i : i + m], y[i : i + m], p[i : i + m]
            if width:
                for j in range(m):
                    found[j] = scaled_cell(ys[j], xs[j], ps[j], by_row, by_column, width, on)
                add_events(found, m, pair)
                continue
            for j in range(m):
                found[j] = np.uint32(ys[j]) * columns + np.uint32(xs[j])
                plane[j] = on * np.uint32(ps[j] != 0)
            for j in range(m):
                cell = pixels[found[j]]
                if cell < 0:
                    outside += 1
                    continue
                k = np.uint32(cell) + plane[j]
                pair[k] += np.uint8(pair[k] < 255)
        first = last
    return outside


@compiled
def add_events(where: NDArray[np.uint32], n: int, counts: NDArray[np.uint8]) -> None:  # pragma: no cover (machine code)
    """Add one to counts[where[i]] for the first n, saturating at 255; four at a time, so that their reads overlap."""
    whole = n - n % 4
    for i in range(0, whole, 4):
        a, b, c, d = where[i], where[i + 1], where[i + 2], where[i + 3]
        counts[a] += np.uint8(counts[a] < 255)
        counts[b] += np.uint8(counts[b] < 255)
        counts[c] += np.uint8(counts[c] < 255)
        counts[d] += np.uint8(counts[d] < 255)
    for i in range(whole, n):
        counts[where[i]] += np.uint8(counts[where[i]] < 255)
