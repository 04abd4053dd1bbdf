"""How the simulator's loops are compiled: without the GIL, and either fast or exact to the last bit."""

from collections.abc import Callable
from typing import Any, ParamSpec, TypeVar, cast

import numba

P = ParamSpec("P")
R = TypeVar("R")

_HARMLESS = {"contract", "arcp", "nsz"}  # infinity means "nothing there", so ninf and nnan would be wrong


def fast(function: Callable[P, R]) -> Callable[P, R]:
    """The function as machine code; x / 0 is infinite, and the last bit of a result may differ from numpy's."""
    return _compiled(function, fastmath=_HARMLESS, error_model="numpy")


def exact(function: Callable[P, R]) -> Callable[P, R]:
    """The function as machine code that computes what Python does, bit for bit.

    Said aloud, for what is left unsaid a function takes from whichever fast one happens to call it first.
    """
    return _compiled(function, fastmath=False, error_model="python")


def _compiled(function: Callable[P, R], **how: Any) -> Callable[P, R]:
    try:
        return cast("Callable[P, R]", numba.njit(nogil=True, cache=True, **how)(function))
    except RuntimeError:  # nowhere to write a cache, as in a read-only image: compiled anew at each start
        return cast("Callable[P, R]", numba.njit(nogil=True, **how)(function))
