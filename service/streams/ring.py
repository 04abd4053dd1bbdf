"""Ring: the newest windows of one stream, packed, to bring another model to where it would be had it always served."""

from collections import deque
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from neurove_core.ingest.windows import Window

_BYTES_PER_ENTRY = 256  # what an entry takes beside its counts


class Packed(NamedTuple):
    """A window whose counts take little room: most cells of most windows are empty."""

    start_us: int
    events: int
    outside: int
    shape: tuple[int, ...]
    cells: (
        NDArray[np.uint16] | NDArray[np.uint32] | None
    )  # flat numbers of the cells that counted; None: values has all cells
    values: NDArray[np.uint8]

    @property
    def size(self) -> int:
        """Bytes that it takes."""
        return _BYTES_PER_ENTRY + self.values.nbytes + (self.cells.nbytes if self.cells is not None else 0)

    def window(self) -> Window:
        """The window, bit for bit."""
        if self.cells is None:
            return Window(self.start_us, self.values.reshape(self.shape), self.events, self.outside)
        counts = np.zeros(self.shape, np.uint8)
        counts.reshape(-1)[self.cells] = self.values
        return Window(self.start_us, counts, self.events, self.outside)


def packed(window: Window) -> Packed:
    """A window in the smaller of two forms: the cells that counted and their counts, or the counts of all cells."""
    flat = window.counts.reshape(-1)
    found = np.flatnonzero(flat)
    cells = found.astype(np.uint16) if flat.size <= 1 << 16 else found.astype(np.uint32)
    sparse = cells.nbytes + cells.size < flat.size
    about = window.start_us, window.events, window.outside, window.counts.shape
    return Packed(*about, cells, flat[cells]) if sparse else Packed(*about, None, flat)


class Ring:
    """The newest windows of one sensor, camera and clock, bounded in number and bytes.

    Its stream's worker alone appends; `newest` may be called from any thread.

    Args:
        windows: most that it keeps.
        max_bytes: most that they take together.
    """

    def __init__(self, windows: int, max_bytes: int) -> None:
        self._entries: deque[Packed] = deque()
        self._windows, self._max_bytes = windows, max_bytes
        self.bytes = 0

    def append(self, entry: Packed) -> None:
        """Keep a window; the oldest ones make room for it."""
        self._entries.append(entry)
        self.bytes += entry.size
        while len(self._entries) > self._windows or self.bytes > self._max_bytes:
            self.bytes -= self._entries.popleft().size

    def newest(self, windows: int) -> list[Packed]:
        """So many of the newest windows, or all where there are fewer; oldest first."""
        entries = list(self._entries)  # one step of the interpreter: the worker may append meanwhile
        return entries[max(0, len(entries) - windows) :]

    def after(self, end_us: int | None) -> list[Packed]:
        """The windows that begin at `end_us` or later; all of them where that is None."""
        return [entry for entry in list(self._entries) if end_us is None or entry.start_us >= end_us]
