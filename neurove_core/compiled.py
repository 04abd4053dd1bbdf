"""The decorators that compile hot loops to machine code by numba, and what happens where it cannot be cached."""

import contextlib
import functools
import logging
import pickle
from collections.abc import Callable
from typing import Any, ParamSpec, TypeVar, cast

import numba

P = ParamSpec("P")
R = TypeVar("R")

log = logging.getLogger(__name__)


def compiled(function: Callable[P, R]) -> Callable[P, R]:
    """Compile a function and keep its signature for type checkers; numba itself is untyped.

    The code runs without the GIL and is cached on disk.
    """
    return compile_with(function)


def compile_with(function: Callable[P, R], **how: Any) -> Callable[P, R]:
    """Compile a function as `compiled`, with options of `numba.njit`.

    Without a place for the cache, as in a read-only image without NUMBA_CACHE_DIR, or where the cache cannot be read or
    written, the function is compiled at each start, and the log says so once.
    """
    try:
        dispatcher = numba.njit(nogil=True, cache=True, **how)(function)
    except (RuntimeError, OSError) as error:
        _warn_once(str(error))
        dispatcher = numba.njit(nogil=True, **how)(function)
    else:
        _tolerate_io_errors(dispatcher)
    return cast("Callable[P, R]", dispatcher)


def _tolerate_io_errors(dispatcher: Any) -> None:
    """Let a function run although its cache cannot be used, such as on a full disk or with the files of another user.

    numba has no option for this: it lets the error through from the first call. Without the attributes that are named
    here, which are private, it does so still.
    """
    cache = getattr(dispatcher, "_cache", None)
    for name in ("load_overload", "save_overload"):
        method = getattr(cache, name, None)
        if method is not None:
            with contextlib.suppress(AttributeError):
                setattr(cache, name, _tolerant(method))


def _tolerant(method: Callable[..., Any]) -> Callable[..., Any]:
    @functools.wraps(method)
    def call(*arguments: Any) -> Any:
        try:
            return method(*arguments)
        except (OSError, EOFError, pickle.UnpicklingError) as error:
            _warn_once(str(error))
            return None

    return call


_warned: list[str] = []


def _warn_once(why: str) -> None:
    if not _warned:
        _warned.append(why)
        log.warning("compiled code is not cached, so each start compiles it again: set NUMBA_CACHE_DIR (%s)", why)
