"""The decorator that compiles hot loops to machine code by numba."""

from collections.abc import Callable
from typing import ParamSpec, TypeVar, cast

import numba

P = ParamSpec("P")
R = TypeVar("R")


def compiled(function: Callable[P, R]) -> Callable[P, R]:
    """Compile a function and keep its signature for type checkers; numba itself is untyped.

    The code runs without the GIL and is cached on disk.
    """
    try:
        return cast("Callable[P, R]", numba.njit(nogil=True, cache=True)(function))
    except RuntimeError:  # no writable cache folder, as in a read-only image: compiled at each start
        return cast("Callable[P, R]", numba.njit(nogil=True)(function))
