"""Admission: whether this node has the memory and the speed for a model, before any stream uses it."""

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
"""A model needs memory for its weights twice: as read, and in the layout of the engine."""

TIMED_WINDOWS = 128
_MAX_SLOW = TIMED_WINDOWS // 100 + 1
"""If more windows than this exceed a bound, the 99th percentile exceeds it whatever the other windows take."""

_MEMINFO = Path("/proc/meminfo")
_CGROUP = Path("/sys/fs/cgroup")


def free_bytes(meminfo: Path = _MEMINFO, cgroup: Path = _CGROUP) -> int | None:
    """Memory that this process may still use: of the machine, or of its control group if that is less [bytes].

    Returns:
        None if the system does not report it.
    """
    found = []
    with contextlib.suppress(OSError, ValueError, IndexError):
        lines = [line.split() for line in meminfo.read_text().splitlines()]
        found += [int(line[1]) << 10 for line in lines if line[0] == "MemAvailable:"]
    with contextlib.suppress(OSError, ValueError):  # "max" is not a number: no bound
        bound, used = (int((cgroup / name).read_text()) for name in ("memory.max", "memory.current"))
        found.append(max(0, bound - used))
    return min(found, default=None)


def weight_bytes(model: Bundle) -> int:
    """Size of a model's weights [bytes]."""
    return sum(tensor.numel() * tensor.element_size() for tensor in model.network.state_dict().values())


def check_memory(name: str, model_bytes: int, free: int | None) -> None:
    """Refuse a model that might not fit into memory.

    Args:
        name: of the model.
        model_bytes: size of its weights, or of its file [bytes].
        free: free memory [bytes]; None passes.

    Raises:
        NoMemory: less than twice the size of the model is free.
    """
    if free is not None and free < COPIES * model_bytes:
        raise NoMemory(name, free, COPIES * model_bytes)


def window_times_ms(
    estimator: Estimator, windows: int = TIMED_WINDOWS, bound_ms: float = math.inf, max_slow: int = 0
) -> list[float]:
    """Processor times of consecutive busy windows, from the zero state [ms].

    Time spent waiting for other work of the machine does not count: it depends on the load of the node, not on the
    model.

    Args:
        estimator: the model, warmed up.
        windows: number of windows; fewer if the model is too slow.
        bound_ms: a window that takes longer is slow [ms].
        max_slow: maximum number of slow windows; the measurement ends when it is exceeded.
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
        if sum(took > bound_ms for took in times) > max_slow:  # the streams need the processor
            break
    return times


def check_speed(estimator: Estimator, share: float = 1.0) -> float:
    """Refuse a model that this node cannot run in time.

    Args:
        estimator: the model, warmed up.
        share: bound of the time for a window, as a share of the window's duration.

    Returns:
        99th percentile of the times for a window [ms].

    Raises:
        TooSlow: it exceeds the bound.
    """
    bound_ms = share * estimator.config.window.duration_us / 1e3
    p99_ms = float(np.percentile(window_times_ms(estimator, TIMED_WINDOWS, bound_ms, _MAX_SLOW), 99))
    if p99_ms > bound_ms:
        raise TooSlow(estimator.bundle.name, p99_ms, bound_ms)
    return p99_ms
