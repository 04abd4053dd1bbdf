"""Release the memory that the start, a model change and the compiler leave behind."""

import contextlib
import ctypes
import gc
import mmap
import sys
from collections.abc import Iterable
from pathlib import Path
from typing import Final

from neurove_core.compiled import work

_SMAPS: Final = Path("/proc/self/smaps")
_COMPILER: Final = "libllvmlite"
_DONTNEED: Final = getattr(mmap, "MADV_DONTNEED", None)  # None where the system has no such call


def release_memory() -> None:
    """Collect reference cycles and return unused pages of the allocator to the system.

    Otherwise the second copy of a model and the memory of its warm-up stay with the allocator, which keeps freed memory
    in the pool of the thread that allocated it. With a C library other than glibc, only cycles are collected.
    """
    gc.collect()
    if sys.platform == "linux":
        with contextlib.suppress(OSError, AttributeError):
            ctypes.CDLL(None).malloc_trim(0)
    release_compiler()


def release_compiler(smaps: Path = _SMAPS) -> int:
    """Return the pages that hold the code of LLVM to the system; only a start or a new model runs this code.

    Only pages that equal the file are returned, so a later use reads them again and finds the same. Systems other than
    Linux keep them.

    Returns:
        size of the pages [KiB].
    """
    if sys.platform != "linux" or _DONTNEED is None:
        return 0
    with contextlib.suppress(OSError, AttributeError):
        madvise = ctypes.CDLL(None).madvise
        madvise.argtypes = [ctypes.c_size_t, ctypes.c_size_t, ctypes.c_int]
        with smaps.open() as lines:
            clean = [(start, end, kib) for start, end, kib in _clean(lines) if kib]
        return sum(kib for start, end, kib in clean if madvise(start, end - start, _DONTNEED) == 0)
    return 0


class CompilerPages:
    """Returns the pages of the compiler each time that this process compiled or loaded code."""

    def __init__(self) -> None:
        self._seen = 0

    def release(self) -> None:
        """Return them if code was compiled or loaded since the last call."""
        done = work()
        if done.compiled + done.loaded != self._seen:
            self._seen = done.compiled + done.loaded
            release_compiler()


def _clean(lines: Iterable[str]) -> list[tuple[int, int, int]]:
    """Start, end and resident size [KiB] of each part of the library of the compiler that was never written to."""
    found, begun, kib = [], None, 0
    for line in lines:
        name, *rest = line.split()
        if not name.endswith(":"):  # the head of a mapping: range, access, offset, device, inode, path
            ours = len(rest) > 4 and _COMPILER in rest[4] and "w" not in rest[0]
            begun, kib = (name if ours else None), 0
        elif begun and name == "Rss:":
            kib = int(rest[0])
        elif begun and name == "Anonymous:" and rest[0] == "0":
            start, end = (int(edge, 16) for edge in begun.split("-"))
            found.append((start, end, kib))
    return found
