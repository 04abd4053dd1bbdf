"""What a compiled function takes from other modules, so that a change there makes its machine code be compiled again.

numba compares the time and size of the one file that a function is in. But its machine code also has the code of every
function that it calls, and the values of every constant that it uses, from other files.
"""

import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from types import CodeType, ModuleType
from typing import Any, Final

_OURS: Final = ("neurove_core", "neurove_protocol")
"""Packages whose functions are followed although numba did not make them, such as instructions of the processor."""


def dependencies(function: Callable[..., Any]) -> tuple[tuple[str, str], ...]:
    """Names of what a function takes from other modules, each with what changes when it changes, in one order.

    A function counts with the time and size of its file, a constant with its value. Functions that are called by those
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
    elif hasattr(value, "tobytes"):  # an array, or a number of numpy
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
    except OSError:  # as in an archive, which numba does not cache either
        return ""
    return f"{status.st_mtime} {status.st_size}" if status else ""
