"""Admission: whether this node has the memory and the speed for a model, before any stream meets it."""

import contextlib
import math
import time
from pathlib import Path

import numpy as np

from neurove_core.estimator import Estimator
from neurove_core.ingest.windows import Window
from neurove_core.models.bundle import Bundle
from neurove_protocol import Sensor
from neurove_protocol.errors import NoMemory, TooSlow

COPIES = 2
"""A model takes its weights twice: as they were read, and laid out for the engine."""

TIMED_WINDOWS = 128
_MOST_ABOVE = TIMED_WINDOWS // 100 + 1
"""More windows above a bound than this, and their 99th percentile is above it, whatever the others take."""

_MEMINFO = Path("/proc/meminfo")
_CGROUP = Path("/sys/fs/cgroup")


def free_bytes(meminfo: Path = _MEMINFO, cgroup: Path = _CGROUP) -> int | None:
    """Memory that this process may still take: the machine's, or its control group's where that is less.

    Returns:
        None where the system does not tell.
    """
    found = []
    with contextlib.suppress(OSError, ValueError, IndexError):
        lines = [line.split() for line in meminfo.read_text().splitlines()]
        found += [int(line[1]) << 10 for line in lines if line[0] == "MemAvailable:"]
    with contextlib.suppress(OSError, ValueError):  # "max" is no number: no bound
        bound, used = (int((cgroup / name).read_text()) for name in ("memory.max", "memory.current"))
        found.append(max(0, bound - used))
    return min(found, default=None)


def weight_bytes(model: Bundle) -> int:
    """What a model's weights take once [bytes]."""
    return sum(tensor.numel() * tensor.element_size() for tensor in model.network.state_dict().values())


def check_memory(name: str, model_bytes: int, free: int | None) -> None:
    """Refuse a model that might not fit.

    Args:
        name: of the model.
        model_bytes: of its weights, as weight_bytes or as its file says.
        free: as free_bytes; None passes.

    Raises:
        NoMemory: less is free than twice the model.
    """
    if free is not None and free < COPIES * model_bytes:
        raise NoMemory(name, free, COPIES * model_bytes)


def window_times_ms(
    estimator: Estimator, windows: int = TIMED_WINDOWS, bound_ms: float = math.inf, most_above: int = 0
) -> list[float]:
    """Processor times for one busy window after the other, from rest [ms]; the estimator is warm.

    Waiting for other work of the machine does not count: it says how busy the node is, and not how slow the model.

    Args:
        estimator: the model.
        windows: so many, but not beyond the one that tells that it is too slow:
        bound_ms: which ones are slow.
        most_above: so many may be.
    """
    window, grid = estimator.config.window, estimator.config.canonical
    shape = (2 * window.bins, grid.height, grid.width)
    rng, times = np.random.default_rng(0), []
    state = estimator.initial_state(Sensor(grid.width, grid.height))
    busy = [rng.poisson(0.3, shape).astype(np.uint8) for _ in range(8)]
    for i in range(windows):
        one = Window(i * window.duration_us, busy[i % len(busy)], 1000, 0)
        began = time.thread_time()
        _, state = estimator.follow((one,), state)
        times.append(1e3 * (time.thread_time() - began))
        if sum(took > bound_ms for took in times) > most_above:  # the streams can use the processor better
            break
    return times


def check_speed(estimator: Estimator, share: float = 1.0) -> float:
    """Refuse a model that this node can not run in time.

    Args:
        estimator: warm.
        share: of a window's duration that a window may take.

    Returns:
        99th percentile of the times for a window [ms].

    Raises:
        TooSlow: it is over the bound.
    """
    bound_ms = share * estimator.config.window.duration_us / 1e3
    p99_ms = float(np.percentile(window_times_ms(estimator, TIMED_WINDOWS, bound_ms, _MOST_ABOVE), 99))
    if p99_ms > bound_ms:
        raise TooSlow(estimator.bundle.name, p99_ms, bound_ms)
    return p99_ms
