"""Functions as machine code: what the hot loops are compiled by."""

from collections.abc import Callable
from typing import ParamSpec, TypeVar, cast

import numba

P = ParamSpec("P")
R = TypeVar("R")


def compiled(function: Callable[P, R]) -> Callable[P, R]:
    """The function as machine code with the same signature; numba itself is untyped."""
    try:
        return cast("Callable[P, R]", numba.njit(nogil=True, cache=True)(function))
    except RuntimeError:  # nowhere to write a cache, as in a read-only image: compiled anew at each start
        return cast("Callable[P, R]", numba.njit(nogil=True)(function))
