"""Memory that a change of model leaves behind, given back to the system."""

import contextlib
import ctypes
import gc
import sys


def release_memory() -> None:
    """Collect what refers to itself, and have the allocator return the pages that nobody uses.

    Without it a model's second copy, and what its warm-up took, stay with the allocator, which keeps freed memory in
    the pool of the thread that asked for it. Where the C library is not glibc, only the first.
    """
    gc.collect()
    if sys.platform == "linux":
        with contextlib.suppress(OSError, AttributeError):
            ctypes.CDLL(None).malloc_trim(0)
