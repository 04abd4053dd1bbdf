"""Compiled code that an installation brings: a second place where a function looks before it is compiled.

`neurove warm-up --ahead` writes the folder `neurove_core/ahead`: for a wheel, an image, or all users of a machine.
A file of code is found by the digest of all that it was made of, so code of other sources or of other versions of
Python, numba or llvmlite is never found. It needs no path, time or owner to be the same.

The files are pickles, as those of numba's cache. They are read from the package alone, where they are trusted as much
as its Python files: who can write there can change these too.
"""

import contextlib
import functools
import hashlib
import json
import logging
import os
import pickle
import platform
import sys
from collections.abc import Callable, Iterable
from importlib import metadata
from pathlib import Path
from typing import Any, Final, NamedTuple

import numba
import numpy as np

log = logging.getLogger(__name__)

FOLDER: Final = Path(__file__).parents[1] / "ahead"
"""Where the code lies: one folder for each processor, with the file `processor.json`."""

SWITCH: Final = "NEUROVE_AHEAD"
"""Environment variable; `off` ignores the folder."""

_OF_ENGINE: Final = frozenset({"avx512f", "avx512vnni", "avx512vbmi"})
"""Features by which kernels choose their instructions (engine/vectors.py): they must be the same ones."""

_ABOUT: Final = "processor.json"


def write(functions: Iterable[tuple[Any, str]], name: str, complete_for: str, folder: Path = FOLDER) -> int:
    """Copy the code of functions from numba's cache into the folder, for the processor that numba compiles for.

    Args:
        functions: those that numba compiled or loaded in this process, each with the digest of its sources.
        name: of the processor.
        complete_for: what these functions are all code of; see `complete_for`.
        folder: of all processors; code of this one is replaced.

    Returns:
        Number of files of code.

    Raises:
        OSError: the folder cannot be written.
    """
    own = folder / name
    own.mkdir(parents=True, exist_ok=True)
    for old in own.iterdir():
        old.unlink()
    written = 0
    for function, sources in functions:
        file, cache = function._cache._cache_file, function._cache
        names = file._load_index()
        for sig in function.overloads:
            data = names.get(cache._index_key(sig, function.targetctx.codegen()))
            if data is not None:
                code = Path(file._data_path(data)).read_bytes()
                (own / _name(function, sources, sig)).write_bytes(code)
                written += 1
    about = {"features": sorted(_features(_target())), "complete_for": complete_for}
    (own / _ABOUT).write_text(json.dumps(about) + "\n")
    return written


def look_up(function: Any, sources: Callable[[], str]) -> None:
    """Let a function of numba look into the folder where its own cache has no code for its arguments.

    Without the attributes that are named here, which are private, it compiles as before.

    Args:
        function: what `numba.njit` made.
        sources: gives the digest of all sources and constants that its code is made of.
    """
    cache: Any = getattr(function, "_cache", None)
    first = getattr(cache, "load_overload", None)
    if first is None or function.py_func.__closure__ is not None or not _processors():
        return

    def load(sig: Any, target: Any) -> Any:
        found = first(sig, target)
        return _load(function, sources(), sig, target) if found is None else found

    with contextlib.suppress(AttributeError):
        cache.load_overload = load


def complete_for() -> str:
    """What the folder has all code of, as it was given to `write`; empty where it has none for this processor."""
    found = _brought_for(_target())
    return found.complete_for if found else ""


def _target() -> Any:
    return numba.core.registry.cpu_target.target_context


def _load(function: Any, sources: str, sig: Any, target: Any) -> Any:
    brought = _brought_for(target)
    if brought is None:
        return None
    try:
        data = (brought.folder / _name(function, sources, sig)).read_bytes()
        target.refresh()
        rebuild: Any = numba.core.compiler.CompileResult._rebuild
        return rebuild(target, *pickle.loads(data))  # noqa: S301  # of the package
    except FileNotFoundError:
        log.debug("no compiled code in the package: function=%s", function.py_func.__qualname__)
    except Exception as error:  # noqa: BLE001  # a damaged file may raise anything; the function is compiled instead
        log.warning(
            "compiled code in the package is not used: function=%s why=%s", function.py_func.__qualname__, error
        )
    return None


def _name(function: Any, sources: str, sig: Any) -> str:
    python = function.py_func
    made_of = (sources, str(sig), *_VERSIONS)
    return f"{python.__name__}-{hashlib.sha256(repr(made_of).encode()).hexdigest()[:32]}.code"


_VERSIONS: Final = (
    sys.implementation.cache_tag,
    platform.system(),
    platform.machine(),
    numba.__version__,
    metadata.version("llvmlite"),  # not imported: only the vector code may need it
    np.__version__,
)


class _Brought(NamedTuple):
    """The code for one processor."""

    folder: Path
    features: frozenset[str]
    complete_for: str


def _brought_for(target: Any) -> _Brought | None:
    """The code for a processor that runs on this one and uses all of what the engine asks for."""
    features = _features(target)
    for one in _processors():
        if one.features <= features and one.features & _OF_ENGINE == features & _OF_ENGINE:
            return one
    return None


def _features(target: Any) -> frozenset[str]:
    listed = target.codegen().magic_tuple()[2].split(",")
    return frozenset(one[1:] for one in listed if one.startswith("+"))


@functools.cache
def _processors() -> tuple[_Brought, ...]:
    """All code in the folder, the one with the most features first."""
    found = []
    if os.environ.get(SWITCH) != "off" and FOLDER.is_dir():
        for file in FOLDER.glob(f"*/{_ABOUT}"):
            with contextlib.suppress(OSError, ValueError, KeyError, TypeError):
                about = json.loads(file.read_text())
                found.append(_Brought(file.parent, frozenset(about["features"]), str(about["complete_for"])))
    return tuple(sorted(found, key=lambda one: (-len(one.features), one.folder)))
