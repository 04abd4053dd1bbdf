"""Check of the global heaps of an HDF5 file, which hold its texts: on a damaged one the HDF5 library never returns.

Source: HDF5 File Format Specification 3.0, III.E, disk format: global heap.
"""

import functools
import mmap
import struct
from pathlib import Path
from typing import Final

MAX_FILE_BYTES: Final = 512 << 20
"""A larger file is not checked, because the check reads all of it."""

_HEAD: Final = b"GCOL\x01\x00\x00\x00"
_OBJECT: Final = struct.Struct("<HHIQ")  # index, references, reserved, size; then the data, padded to 8 bytes


def heap_fault(path: Path) -> tuple[int, str] | None:
    """The byte and the fault of the first damaged global heap, or None."""
    stat = path.stat()
    return _heap_fault(path, stat.st_size, stat.st_mtime_ns)


@functools.lru_cache(maxsize=64)
def _heap_fault(path: Path, size: int, _: int) -> tuple[int, str] | None:
    if not 0 < size <= MAX_FILE_BYTES:
        return None
    with path.open("rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data:
        at = data.find(_HEAD)
        while at >= 0:
            why = _fault_of(data, at)
            if why:
                return at, why
            at = data.find(_HEAD, at + len(_HEAD))
    return None


def _fault_of(data: mmap.mmap, at: int) -> str:
    """What is wrong with the heap at this byte; empty if nothing is."""
    (size,) = struct.unpack("<Q", data[at + 8 : at + 16].ljust(8, b"\0"))
    stop, place = at + size, at + 16
    if stop > len(data):  # the file is truncated, which the HDF5 library reports
        return ""
    while place + _OBJECT.size <= stop:
        index, _, _, length = _OBJECT.unpack(data[place : place + _OBJECT.size])
        if index == 0:  # the free space, with its own header
            return "" if length == stop - place else f"its free space has {length} bytes instead of {stop - place}"
        place += _OBJECT.size + -(-length // 8) * 8
    return "" if place <= stop else "an object extends past the end of its heap"
