"""Compilation of the simulator's loops: without the GIL, and either fast or exact to the last bit."""

from collections.abc import Callable
from typing import Any, ParamSpec, TypeVar, cast

import numba

P = ParamSpec("P")
R = TypeVar("R")

_HARMLESS = {"contract", "arcp", "nsz"}  # infinity marks an empty place, so ninf and nnan would be wrong


def fast(function: Callable[P, R]) -> Callable[P, R]:
    """Compile a function; x / 0 is infinite, and the last bit of a result may differ from numpy."""
    return _compiled(function, fastmath=_HARMLESS, error_model="numpy")


def exact(function: Callable[P, R]) -> Callable[P, R]:
    """Compile a function so that it computes what Python does, bit for bit.

    The flags are explicit, because a function without flags inherits those of the first `fast` function that calls it.
    """
    return _compiled(function, fastmath=False, error_model="python")


def _compiled(function: Callable[P, R], **how: Any) -> Callable[P, R]:
    try:
        return cast("Callable[P, R]", numba.njit(nogil=True, cache=True, **how)(function))
    except RuntimeError:  # no place for a cache, as in a read-only image: compile at each start
        return cast("Callable[P, R]", numba.njit(nogil=True, **how)(function))
