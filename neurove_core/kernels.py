"""The hot loops, each compiled, beside its plain reference.

A kernel is a pure function: state goes in and comes out as a named tuple, arrays are read or filled, nothing is kept.
It is compiled by numba on first use, cached on disk, and runs without the GIL. Its reference (`*_reference`) does the
same in plain Python or numpy, written for reading; tests hold the two together bit for bit.

Here is the binning; the decoders of Prophesee words live in `evt.py`, and are named here too.
"""

import numpy as np
from numpy.typing import NDArray

from neurove_core.compiled import compiled
from neurove_core.evt import (
    ILLEGAL,
    OK,
    OUTSIDE,
    STEP_BACK,
    VECTOR_EVENTS,
    Evt2State,
    Evt3State,
    TriggerState,
    evt2_decode,
    evt2_reference,
    evt2_triggers,
    evt3_decode,
    evt3_reference,
    evt3_triggers,
)
from neurove_core.geometry import OUTSIDE as NO_CELL
from protocol.events import Events

__all__ = [
    "ILLEGAL",
    "OK",
    "OUTSIDE",
    "STEP_BACK",
    "VECTOR_EVENTS",
    "Evt2State",
    "Evt3State",
    "TriggerState",
    "compiled",
    "count_events",
    "count_events_reference",
    "evt2_decode",
    "evt2_reference",
    "evt2_triggers",
    "evt3_decode",
    "evt3_reference",
    "evt3_triggers",
]


def count_events(events: Events, start_us: int, bin_us: int, lut: NDArray[np.int32], counts: NDArray[np.uint8]) -> int:
    """Add events to a window's counts, in place, saturating at 255.

    Args:
        events: all with start_us <= t < start_us + n * bin_us, on the sensor of `lut`.
        start_us: of the window.
        bin_us: length of one of its n bins.
        lut: (sensor.height, sensor.width) cell of each pixel, or geometry.OUTSIDE.
        counts: (2n, H, W), changed.

    Returns:
        how many of the events no cell sees.
    """
    cells = counts.shape[1] * counts.shape[2]
    return _count(events, start_us, bin_us, lut, cells, counts.reshape(-1))


def count_events_reference(
    events: Events, start_us: int, bin_us: int, lut: NDArray[np.int32], counts: NDArray[np.uint8]
) -> int:
    """What count_events computes, in plain numpy."""
    cell = lut[events.y, events.x]
    seen = cell != NO_CELL
    channel = 2 * ((events.t - start_us) // bin_us) + (events.p > 0)
    index = channel[seen] * (counts.shape[1] * counts.shape[2]) + cell[seen]
    added = np.bincount(index, minlength=counts.size).reshape(counts.shape)
    counts[:] = np.minimum(counts + added, 255).astype(np.uint8)
    return int((~seen).sum())


@compiled
def _count(
    events: Events, start_us: int, bin_us: int, lut: NDArray[np.int32], cells: int, flat: NDArray[np.uint8]
) -> int:  # pragma: no cover (machine code)
    outside = 0
    for i in range(events.t.size):
        cell = lut[events.y[i], events.x[i]]
        if cell < 0:
            outside += 1
            continue
        channel = 2 * ((events.t[i] - start_us) // bin_us) + (1 if events.p[i] > 0 else 0)
        index = channel * cells + cell
        if flat[index] < 255:
            flat[index] += 1
    return outside
