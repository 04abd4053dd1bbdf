"""Compilation of the simulator's loops: without the GIL, and either fast or exact to the last bit."""

from collections.abc import Callable
from typing import ParamSpec, TypeVar

from neurove_core.compiled import compile_with

P = ParamSpec("P")
R = TypeVar("R")

_HARMLESS = {"contract", "arcp", "nsz"}  # infinity marks an empty place, so ninf and nnan would be wrong


def fast(function: Callable[P, R]) -> Callable[P, R]:
    """Compile a function; x / 0 is infinite, and the last bit of a result may differ from numpy."""
    return compile_with(function, fastmath=_HARMLESS, error_model="numpy")


def exact(function: Callable[P, R]) -> Callable[P, R]:
    """Compile a function so that it computes what Python does, bit for bit.

    The flags are explicit, because a function without flags inherits those of the first `fast` function that calls it.
    """
    return compile_with(function, fastmath=False, error_model="python")
