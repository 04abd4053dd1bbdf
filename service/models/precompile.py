"""Compile a network's code in other processes: the streams do not wait, and the node does not keep the memory.

numba compiles for seconds in Python code. In the process of the node each step of a stream would wait for its turn in
between. The child compiles into the cache on disk, at low priority; the node then reads the cache. Networks of a known
shape need none of this. At a start with a cache that is empty or stale, children compile the parts of all code at the
same time.

`python -m neurove_service.models.precompile CONFIG [PART...]` takes the configuration of the model as JSON. It lowers
its priority where it names no part.
"""

import math
import os
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Sequence
from typing import Final

from neurove_core.config import ModelConfig
from neurove_core.warming import PARTS, compile_part, lacks_code, note_complete
from neurove_service import logs

log = logs.get(__name__)

TIMEOUT_S = 60.0
CHILD_BYTES = 512 << 20
"""Memory of the child [bytes]; with less free memory the node compiles by itself."""

_POLL_S = 0.05
_START_S = 300.0  # most for an empty cache, on a slow machine
_NICE = 5
_WIDE_CELLS = 1 << 16  # indices of more cells need another type


class Shapes:
    """The shapes of networks for which this process has compiled code."""

    def __init__(self) -> None:
        self._known: set[tuple[object, ...]] = set()

    def add(self, config: ModelConfig) -> None:
        """Note that a network of this configuration has run here."""
        self._known.add(_shape(config))

    def need_child(self, config: ModelConfig, free_bytes: int | None) -> bool:
        """Whether code for this configuration is to be compiled by a child."""
        fits = free_bytes is None or free_bytes > CHILD_BYTES
        return fits and config.kind == "neurove" and _shape(config) not in self._known


def in_child(config: ModelConfig, stop: threading.Event, timeout_s: float = TIMEOUT_S) -> bool:
    """Compile the code of a configuration in a child process.

    Args:
        config: of the model.
        stop: ends the child.
        timeout_s: maximum time [s].

    Returns:
        Whether the child has compiled it; if not, the log has the reason, and the first use compiles it.
    """
    return _finish([_start(config, ())], stop, timeout_s)


def at_start(config: ModelConfig, free_bytes: Callable[[], int | None]) -> None:
    """Compile all code for the first model of a node in children, where the cache lacks a part of it.

    It is empty, or its code was made of other sources, as after an update. What they do not compile, the node compiles
    by itself.

    Args:
        config: of the model.
        free_bytes: says the free memory [bytes], if it is known; it limits the number of children.
    """
    if config.kind != "neurove" or not lacks_code(config):
        return
    free = free_bytes()
    most = len(_GROUPS) if free is None else free // CHILD_BYTES
    if most and (os.cpu_count() or 1) > 1:
        groups = _GROUPS[min(most, len(_GROUPS)) - 1]
        if _finish([_start(config, parts) for parts in groups], threading.Event(), _START_S):
            note_complete()


_GROUPS: Final = ((PARTS,), (PARTS[:1], PARTS[1:]), tuple((part,) for part in PARTS))
"""The parts that one, two or three children compile. Three keep two cores busy to the end."""


def _start(config: ModelConfig, parts: Sequence[str]) -> subprocess.Popen[bytes] | None:
    """A child that compiles; None, with the reason in the log, where it cannot start."""
    command = [sys.executable, "-P", "-m", "neurove_service.models.precompile", config.model_dump_json(), *parts]
    # with the same paths of modules: the cache is by path
    try:
        return subprocess.Popen(
            command,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            env=os.environ | {"OMP_NUM_THREADS": "1", "PYTHONPATH": os.pathsep.join(filter(None, sys.path))},
        )
    except OSError as error:
        log.warning("code is compiled by the node itself", why=error.strerror or str(error))
        return None


def _finish(children: Sequence[subprocess.Popen[bytes] | None], stop: threading.Event, timeout_s: float) -> bool:
    """Wait for children, and end them at the stop or after the timeout; whether all of them have compiled."""
    deadline, good = time.monotonic() + timeout_s, True
    for child in children:
        if child is None:
            good = False
            continue
        while child.poll() is None and time.monotonic() < deadline and not stop.wait(_POLL_S):
            pass
        if child.poll() is None:
            child.kill()
        _, errors = child.communicate()
        if child.returncode != 0:
            last = errors.decode(errors="replace").strip().splitlines()[-1:] or [f"exit code {child.returncode}"]
            log.warning("code is compiled by the node itself", why=last[0][:200])
            good = False
    return good


def _shape(config: ModelConfig) -> tuple[object, ...]:
    """What the types and constants of compiled code depend on."""
    cells = math.prod(config.window_shape)
    net = config.network
    widths = net.encoding, net.precision, net.channels, net.features, net.hidden, net.cells
    return config.kind, widths, config.window.bins, cells > _WIDE_CELLS, bool(net.history)


def main() -> None:
    """Compile the code of the configuration in the first argument: of the parts that follow, or of a new network."""
    config, *parts = sys.argv[1:]
    if not parts:
        os.nice(_NICE)
    for part in parts or PARTS[:2]:
        compile_part(part, ModelConfig.model_validate_json(config))


if __name__ == "__main__":
    main()
