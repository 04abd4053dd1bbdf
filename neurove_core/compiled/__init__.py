"""The decorators that compile hot loops to machine code by numba, and what happens where it cannot be cached."""

import contextlib
import functools
import hashlib
import logging
import pickle
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from types import CodeType, ModuleType
from typing import Any, Final, NamedTuple, ParamSpec, TypeVar, cast

import numba
import numpy as np

from neurove_core.compiled import ahead

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
        _compare_dependencies(dispatcher)
    ahead.look_up(dispatcher, functools.partial(_sources, dispatcher))
    _dispatchers.append(dispatcher)
    return cast("Callable[P, R]", dispatcher)


class Work(NamedTuple):
    """What this process has compiled so far, of all functions that `compile_with` made."""

    compiled: int  # versions of functions, one for each set of argument types, that were compiled
    loaded: int  # versions that were read from the cache
    folders: tuple[Path, ...]  # where the cache lies; empty where there is none


def work() -> Work:
    """Count the compiled versions of all functions that were called or imported in this process."""
    compiled = loaded = 0
    folders = set()
    for dispatcher in _dispatchers:
        stats = dispatcher.stats
        hits, misses = (sum(counts.values()) for counts in (stats.cache_hits, stats.cache_misses))
        compiled, loaded = compiled + misses, loaded + hits
        if stats.cache_path:
            folders.add(Path(stats.cache_path))
    return Work(compiled, loaded, tuple(sorted(folders)))


def folder_of(function: Callable[..., Any]) -> Path | None:
    """Where numba keeps the code of a compiled function; None where it cannot be kept."""
    path = function.stats.cache_path  # type: ignore[attr-defined]  # of numba's dispatchers
    return Path(path) if path else None


def write_ahead(name: str, complete_for: str, folder: Path = ahead.FOLDER) -> int:
    """Copy the code that this process has compiled or loaded into the package, for all users; see `ahead`.

    Args:
        name: of the processor that the code is for.
        complete_for: what this is all code of.
        folder: of the code of all processors.

    Returns:
        Number of files.

    Raises:
        OSError: the folder cannot be written.
    """
    functions = [(one, _sources(one)) for one in _dispatchers if one.overloads and one.stats.cache_path]
    return ahead.write(functions, name, complete_for, folder)


_dispatchers: list[Any] = []


def _compare_dependencies(dispatcher: Any) -> None:
    """Let a function be compiled again after a change of what it takes from other modules.

    numba compares only the file that the function is in. Without the attributes that are named here, which are private,
    it does so still.
    """
    with contextlib.suppress(AttributeError):
        file = dispatcher._cache._cache_file
        file._source_stamp = (file._source_stamp, _dependencies(dispatcher))


def _sources(dispatcher: Any) -> str:
    """The digest of a function and of all that it takes from other modules."""
    python = dispatcher.py_func
    own = python.__module__, python.__qualname__, _stamp(python.__module__)
    return hashlib.sha256(repr((own, _dependencies(dispatcher))).encode()).hexdigest()


_OURS: Final = ("neurove_core", "neurove_protocol")
"""Packages whose functions are followed although numba did not make them, such as instructions of the processor."""


def _dependencies(function: Callable[..., Any]) -> tuple[tuple[str, str], ...]:
    """Names of what a function takes from other modules, each with what changes when it changes, in one order.

    Its machine code has the code of every function that it calls, and the values of every constant that it uses.

    A function counts with the content of its file, a constant with its value. Functions that are called by those
    that it calls count too.
    """
    found: dict[str, str] = {}
    _collect(function, found, set())
    return tuple(sorted(found.items()))


def _collect(function: Callable[..., Any], found: dict[str, str], seen: set[int]) -> None:
    python: Any = getattr(function, "py_func", function)  # of what numba compiles
    code = getattr(python, "__code__", None)
    if code is None or id(code) in seen:
        return
    seen.add(id(code))
    names = set(_names(code))
    for name in names & python.__globals__.keys():
        value = python.__globals__[name]
        if isinstance(value, ModuleType):
            parts = {f"{value.__name__}.{part}": getattr(value, part) for part in names if hasattr(value, part)}
        else:
            parts = {f"{python.__module__}.{name}": value}
        for full_name, part in parts.items():
            _add(full_name, part, found, seen)


def _add(name: str, value: Any, found: dict[str, str], seen: set[int]) -> None:
    if isinstance(value, bool | int | float | complex | str | bytes | tuple):
        found[name] = repr(value)
    elif isinstance(value, np.ndarray | np.generic):
        found[name] = f"{value.dtype} {value.shape} {value.tobytes().hex()}"
    elif callable(value):
        module = getattr(value, "__module__", None) or ""
        if hasattr(value, "py_func") or module.split(".")[0] in _OURS:
            found[name] = _stamp(module)
            _collect(value, found, seen)


def _names(code: CodeType) -> Iterator[str]:
    yield from code.co_names
    for constant in code.co_consts:
        if isinstance(constant, CodeType):
            yield from _names(constant)


def _stamp(module: str) -> str:
    file = getattr(sys.modules.get(module), "__file__", None)
    try:
        status = Path(file).stat() if file else None
        return _digest(Path(str(file)), status.st_mtime_ns, status.st_size) if status else ""
    except OSError:  # as in an archive, which numba does not cache either
        return ""


@functools.cache
def _digest(file: Path, mtime_ns: int, size: int) -> str:  # time and size: a file that changes is read again
    return hashlib.sha256(file.read_bytes()).hexdigest()


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
