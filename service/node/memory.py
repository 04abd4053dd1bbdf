"""Release the memory that a model change leaves behind."""

import contextlib
import ctypes
import gc
import sys


def release_memory() -> None:
    """Collect reference cycles and return unused pages of the allocator to the system.

    Otherwise the second copy of a model and the memory of its warm-up stay with the allocator, which keeps freed memory
    in the pool of the thread that allocated it. With a C library other than glibc, only cycles are collected.
    """
    gc.collect()
    if sys.platform == "linux":
        with contextlib.suppress(OSError, AttributeError):
            ctypes.CDLL(None).malloc_trim(0)
