"""The file that HDF5 writes to: HDF5 never sees a write that fails.

After a failed write, as on a full disk, HDF5 prints tracebacks while it closes its objects and can end the process with
a segmentation fault at exit. Therefore it writes through `Sink`, which keeps the error and what could not be written,
and the writer raises the error between two pieces of data. The same happens if a signal raises an exception in a method
of `Sink`, so the writer works on a thread of its own: Python handles signals on the main thread only.
"""

import concurrent.futures
import os
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

from neurove_core.files import atomic_path
from neurove_core.io.formats.hdf5 import file as hdf5

T = TypeVar("T")


class Interrupted(Exception):
    """The thread that waits for the writer was interrupted."""


class Sink:
    """A file for h5py's driver of file objects. No method raises an OSError.

    Args:
        descriptor: of a file that is open for reading and writing.
    """

    def __init__(self, descriptor: int) -> None:
        self._descriptor = descriptor
        self._at = 0
        self._kept: list[tuple[int, bytes]] = []  # what was not written, for HDF5 to read until it has closed the file
        self.error: OSError | None = None
        self.interrupted = threading.Event()

    def check(self) -> None:
        """Raise the error of the first write that failed.

        Raises:
            OSError: a write failed. Interrupted: a signal ends the writer.
        """
        if self.interrupted.is_set():
            raise Interrupted
        if self.error is not None:
            raise self.error

    def seek(self, offset: int, whence: int = os.SEEK_SET) -> int:
        """Set the place of the next read or write, as that of a file."""
        start = {os.SEEK_SET: 0, os.SEEK_CUR: self._at, os.SEEK_END: self._end()}[whence]
        self._at = start + offset
        return self._at

    def tell(self) -> int:
        """The place of the next read or write."""
        return self._at

    def _end(self) -> int:
        return max([os.fstat(self._descriptor).st_size, *(at + len(data) for at, data in self._kept)])

    def write(self, data: Any) -> int:
        """Write all bytes, or keep them after an error."""
        view = memoryview(data).cast("B")
        if self.error is None:
            try:
                self._write(view)
            except OSError as error:
                self.error = error
        if self.error is not None:
            self._kept.append((self._at, bytes(view)))
        self._at += len(view)
        return len(view)

    def _write(self, view: memoryview) -> None:
        written = 0
        while written < len(view):
            written += os.pwrite(self._descriptor, view[written:], self._at + written)

    def read(self, size: int) -> bytes:
        """The next bytes, as many as asked for; h5py knows a file object by this method."""
        data = bytearray(size)
        self.readinto(data)
        return bytes(data)

    def readinto(self, buffer: Any) -> int:
        """Fill the buffer; what lies behind the end is zero."""
        view = memoryview(buffer).cast("B")
        found = os.pread(self._descriptor, len(view), self._at)
        view[: len(found)] = found
        view[len(found) :] = bytes(len(view) - len(found))
        for at, data in self._kept:
            first, last = max(at, self._at), min(at + len(data), self._at + len(view))
            if first < last:
                view[first - self._at : last - self._at] = data[first - at : last - at]
        self._at += len(view)
        return len(view)

    def truncate(self, size: int) -> int:
        """Set the size of the file."""
        if self.error is None:
            try:
                os.ftruncate(self._descriptor, size)
            except OSError as error:
                self.error = error
        return size

    def flush(self) -> None:
        """Nothing: no byte waits here."""


def write_file(path: Path, write: Callable[[Any, Sink], T]) -> T:
    """Write an HDF5 file atomically, and return what the writer returns.

    Args:
        path: the file.
        write: gets the HDF5 file and its sink, and calls `check` of the sink after each piece of data.

    Raises:
        OSError: the file cannot be written; nothing of it is left. MissingExtra: h5py is not installed.
    """
    h5py = hdf5.library()
    with atomic_path(path) as part, part.open("w+b", buffering=0) as raw:
        sink = Sink(raw.fileno())

        def work() -> T:
            with h5py.File(sink, "w") as file:
                return write(file, sink)

        with concurrent.futures.ThreadPoolExecutor(1, "hdf5") as thread:
            future = thread.submit(work)
            try:
                written = future.result()
            except BaseException:
                sink.interrupted.set()  # the pool waits for the thread
                raise
        sink.check()
        return written
