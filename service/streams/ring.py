"""Ring: the newest windows of one stream, packed, so that another model can be primed with them."""

from collections import deque
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from neurove_core.ingest.windows import Window

_BYTES_PER_ENTRY = 256  # overhead of an entry besides its counts


class PackedWindow(NamedTuple):
    """A window in little memory: most cells of most windows are empty."""

    start_us: int
    events: int
    outside: int
    shape: tuple[int, ...]
    cells: NDArray[np.uint16] | NDArray[np.uint32] | None  # flat indices of nonzero cells; None: values has all cells
    values: NDArray[np.uint8]
    bridged: bool = False  # as in Window

    @property
    def size(self) -> int:
        """Memory of the window [bytes]."""
        return _BYTES_PER_ENTRY + self.values.nbytes + (self.cells.nbytes if self.cells is not None else 0)

    def window(self) -> Window:
        """The window, bit for bit."""
        if self.cells is None:
            return Window(self.start_us, self.values.reshape(self.shape), self.events, self.outside, self.bridged)
        counts = np.zeros(self.shape, np.uint8)
        counts.reshape(-1)[self.cells] = self.values
        return Window(self.start_us, counts, self.events, self.outside, self.bridged)


def pack(window: Window) -> PackedWindow:
    """Pack a window in the smaller of two forms: the nonzero cells and their counts, or the counts of all cells."""
    flat = window.counts.reshape(-1)
    found = np.flatnonzero(flat)
    cells = found.astype(np.uint16) if flat.size <= 1 << 16 else found.astype(np.uint32)
    sparse = cells.nbytes + cells.size < flat.size
    about = window.start_us, window.events, window.outside, window.counts.shape
    if sparse:
        return PackedWindow(*about, cells, flat[cells], window.bridged)
    return PackedWindow(*about, None, flat, window.bridged)


class Ring:
    """The newest windows of one sensor, camera and clock, bounded in number and bytes.

    Only the worker of the stream appends; any thread may call `newest` and `after`.

    Args:
        windows: maximum number of windows.
        max_bytes: maximum memory of all windows [bytes].
    """

    def __init__(self, windows: int, max_bytes: int) -> None:
        self._entries: deque[PackedWindow] = deque()
        self._windows, self._max_bytes = windows, max_bytes
        self.bytes = 0

    def append(self, entry: PackedWindow) -> None:
        """Append a window; drop the oldest ones that exceed a bound."""
        self._entries.append(entry)
        self.bytes += entry.size
        while len(self._entries) > self._windows or self.bytes > self._max_bytes:
            self.bytes -= self._entries.popleft().size

    def newest(self, windows: int) -> list[PackedWindow]:
        """At most this many of the newest windows, oldest first."""
        entries = list(self._entries)  # atomic in CPython: the worker may append at the same time
        return entries[max(0, len(entries) - windows) :]

    def after(self, end_us: int | None) -> list[PackedWindow]:
        """The windows that begin at `end_us` or later; all windows if it is None."""
        return [entry for entry in list(self._entries) if end_us is None or entry.start_us >= end_us]
