"""Admission: whether this node has the memory and the speed for a model, before any stream uses it."""

import contextlib
import math
import time
from pathlib import Path
from typing import NamedTuple

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

_BUSY = 0.25
"""Share of the cells of a busy window that have events."""

_FASTEST_PER_S = 12e9
"""Additions of a weight per second that are believed possible: four times those measured on a core with AVX2, 2.8e9."""

_UPDATE = 4  # additions that the update of a neuron amounts to
_COPIES_OF_STATE = 6  # currents, membranes and spikes of all layers during a window, and the state of a stream
_HOPELESS = 3.0
"""A model whose first windows take this many times the bound is refused without more of them."""

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
    return model.weight_bytes


class Cost(NamedTuple):
    """What a window of a model costs at least, from the shapes of its network."""

    additions: float
    working_bytes: int


def cost(model: Bundle) -> Cost:
    """What a busy window costs at least, whatever the weights: events reach the first layer, neurons are updated."""
    channels, rows, columns = model.config.input_shape
    first, neurons = 0.0, channels * rows * columns
    if model.config.kind == "neurove":
        for outputs in model.config.network.channels:
            rows, columns = -(-rows // 2), -(-columns // 2)
            neurons += outputs * rows * columns
            first = first or _BUSY * 9 * channels * outputs * rows * columns
        return Cost(first + _UPDATE * neurons, 4 * _COPIES_OF_STATE * neurons)
    from torch import nn

    for layer in model.network.modules():
        if isinstance(layer, nn.Conv2d):
            rows, columns = -(-rows // layer.stride[0]), -(-columns // layer.stride[1])
            neurons += layer.out_channels * rows * columns
            first = first or _BUSY * layer.weight[0].numel() * layer.out_channels * rows * columns
    return Cost(first + _UPDATE * neurons, 4 * _COPIES_OF_STATE * neurons)


def check_cost(model: Bundle, free: int | None, share: float = 1.0) -> None:
    """Refuse a model by its configuration alone, before anything of it runs.

    Args:
        model: not yet loaded into an engine.
        free: free memory [bytes]; None passes.
        share: bound of the time for a window, as a share of the window's duration.

    Raises:
        NoMemory: its weights and the state of a window might not fit into memory.
        TooSlow: it would need a core four times as fast as the one that was measured; `p99_ms` is then an estimate.
    """
    least = cost(model)
    check_memory(model.name, weight_bytes(model) + least.working_bytes // COPIES, free)
    least_ms, bound_ms = 1e3 * least.additions / _FASTEST_PER_S, share * model.config.window.duration_us / 1e3
    if least_ms > bound_ms:
        raise TooSlow(model.name, least_ms, bound_ms)


def check_first_windows(estimator: Estimator, share: float = 1.0) -> None:
    """Refuse a model whose first windows take a multiple of the bound, before it is warmed up.

    Raises:
        TooSlow: the quicker one of two windows does.
    """
    bound_ms = share * estimator.config.window.duration_us / 1e3
    least_ms = min(window_times_ms(estimator, windows=2))
    if least_ms > _HOPELESS * bound_ms:
        raise TooSlow(estimator.bundle.name, least_ms, bound_ms)


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
    window, grid, shape = estimator.config.window, estimator.config.canonical, estimator.config.window_shape
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
