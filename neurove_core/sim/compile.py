"""How the simulator's loops are compiled: without the GIL, and with divisions that need no check."""

from collections.abc import Callable
from typing import Any, ParamSpec, TypeVar, cast

import numba

P = ParamSpec("P")
R = TypeVar("R")

_HARMLESS = {"contract", "arcp", "nsz"}  # infinity means "nothing there", so ninf and nnan would be wrong


def fast(function: Callable[P, R]) -> Callable[P, R]:
    """The function as machine code; x / 0 is infinite, and the last bit of a result may differ from numpy's."""
    options: dict[str, Any] = {"nogil": True, "error_model": "numpy", "fastmath": _HARMLESS}
    try:
        return cast("Callable[P, R]", numba.njit(cache=True, **options)(function))
    except RuntimeError:  # nowhere to write a cache, as in a read-only image: compiled anew at each start
        return cast("Callable[P, R]", numba.njit(**options)(function))
