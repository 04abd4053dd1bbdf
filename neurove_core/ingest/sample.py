"""A bounded sample of the events of a window, at full resolution: every k-th event by its number in the window.

Which events are kept does not depend on the packets. When the sample is full, every second one of its events stays, and
k doubles. A full sample so holds between half of its capacity and all of it.
"""

from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from neurove_core.compiled import compiled
from neurove_protocol import Events
from neurove_protocol.events import WireEvents

CAPACITY: Final = 24_576
"""Events of a sample; 8 bytes each."""

_ROW_MASK: Final = 0x7FFF  # the polarity is in the highest bit of y in a packet


class Sample(NamedTuple):
    """Events of one window (N,), ordered by time."""

    t_us: NDArray[np.int32]  # since the start of the window
    x: NDArray[np.uint16]
    y: NDArray[np.uint16]

    @property
    def n(self) -> int:
        """Number of events."""
        return self.t_us.size


class Sampler:
    """The sample of an open window.

    Args:
        start_us: start of the window [us].
        capacity: maximum number of events, an even number.
    """

    def __init__(self, start_us: int, capacity: int = CAPACITY) -> None:
        self._start_us = start_us
        self._seen = self._kept = 0
        self._stride = 1
        column = np.empty(capacity, np.uint16)
        self._columns = Sample(np.empty(capacity, np.int32), column, column.copy())

    def add(self, events: Events | WireEvents) -> None:
        """Add the next events of the window; with equal results for columns and for the layout of a packet."""
        state = self._seen, self._kept, self._stride
        if isinstance(events, WireEvents):
            t0_us, blob, wide, first, stop = events
            kept = _keep_wire(blob, wide, first, stop, t0_us - self._start_us, *state, self._columns)
        else:
            kept = _keep(events.t, events.x, events.y, -self._start_us, *state, self._columns)
        self._seen += events.n
        self._kept, self._stride = kept

    def sample(self) -> Sample:
        """The sample of the events so far."""
        t_us, x, y = self._columns
        return Sample(t_us[: self._kept].copy(), x[: self._kept].copy(), y[: self._kept].copy())


def sample_reference(events: Events, start_us: int, capacity: int = CAPACITY) -> Sample:
    """Reference implementation of a Sampler that gets all events of a window, in numpy."""
    stride = 1
    while -(-events.n // stride) > capacity:
        stride *= 2
    return Sample((events.t[::stride] - start_us).astype(np.int32), events.x[::stride], events.y[::stride])


@compiled
def _keep_wire(
    blob: NDArray[np.uint8],
    wide: bool,
    first: int,
    stop: int,
    begin: int,
    seen: int,
    kept: int,
    stride: int,
    out: Sample,
) -> tuple[int, int]:  # pragma: no cover (machine code)
    if wide:
        n = blob.size // 8
        offset, xy = blob[: 4 * n].view(np.uint32)[first:stop], blob[4 * n :].view(np.uint16)
        return _keep(offset, xy[first:stop], xy[n + first : n + stop], begin, seen, kept, stride, out)
    n = blob.size // 6
    short, xy = blob[: 2 * n].view(np.uint16)[first:stop], blob[2 * n :].view(np.uint16)
    return _keep(short, xy[first:stop], xy[n + first : n + stop], begin, seen, kept, stride, out)


@compiled
def _keep(
    t: NDArray[Any],
    x: NDArray[np.uint16],
    y: NDArray[np.uint16],
    begin: int,
    seen: int,
    kept: int,
    stride: int,
    out: Sample,
) -> tuple[int, int]:  # pragma: no cover (machine code)
    """Keep the events whose number in the window is a multiple of the stride; returns their number, and the stride.

    Args:
        t: times [us], with `begin` added relative to the start of the window.
        x: columns [px].
        y: rows [px], with or without the polarity.
        begin: see t.
        seen: number of events of the window before these.
        kept: number of events in `out`.
        stride: k.
        out: changed.
    """
    i = (stride - seen % stride) % stride
    while i < t.size:
        if kept == out.t_us.size:
            kept //= 2
            for j in range(kept):
                out.t_us[j], out.x[j], out.y[j] = out.t_us[2 * j], out.x[2 * j], out.y[2 * j]
            stride *= 2
            if (seen + i) % stride:
                i += stride // 2
                continue
        out.t_us[kept] = np.int64(t[i]) + begin
        out.x[kept] = x[i]
        out.y[kept] = y[i] & np.uint16(_ROW_MASK)
        kept += 1
        i += stride
    return kept, stride
