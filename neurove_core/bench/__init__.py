"""Benchmarks as ratios: our code and a peer in one process, interleaved, on the same inputs, with compared results."""

import random
import statistics
import time
from collections.abc import Callable
from typing import NamedTuple


class Row(NamedTuple):
    """One comparison. Times are medians of the CPU time of one thread [ms]."""

    name: str
    ours_ms: float
    peer: str
    peer_ms: float
    ratio: float  # the peer's time over ours
    share_of_limit: (
        float | None
    )  # the limit of this machine, measured in the same run, over our time; None without a limit
    equal: bool | None  # whether the results agree; None if the peer computes another result by design
    deviation: float | None = None  # of a peer that rounds otherwise: its result over ours, minus 1


def rows(name: str, times: dict[str, float], equal: dict[str, bool | None], limit_ms: float | None = None) -> list[Row]:
    """One row per peer, the fastest peer first.

    Args:
        name: of the benchmark.
        times: result of `interleaved` [ms], with `ours`, the peers and perhaps others.
        equal: by peer, see Row.
        limit_ms: time at the limit of this machine, measured in the same run [ms].
    """
    ours = times["ours"]
    share = limit_ms / ours if limit_ms else None
    peers = sorted(equal, key=lambda peer: times[peer])
    return [Row(name, ours, peer, times[peer], times[peer] / ours, share, equal[peer]) for peer in peers]


def interleaved(
    runs: dict[str, Callable[[], object]],
    rounds: int,
    warm_up: int = 2,
    clock: Callable[[], float] = time.thread_time,
) -> dict[str, float]:
    """Median time [ms] of each function, by default the CPU time of this thread.

    Every round runs all in turn, so that a busy machine slows all alike. Each round has another order, the
    same in every run, because a function that fills the caches slows the next one.

    Args:
        runs: the functions to time, by name.
        rounds: number of timed rounds.
        warm_up: number of rounds before them, not timed.
        clock: the time [s]; work on a GPU takes no CPU time.
    """
    times: dict[str, list[float]] = {name: [] for name in runs}
    order, shuffle = list(runs), random.Random(0).shuffle
    for turn in range(warm_up + rounds):
        shuffle(order)
        for name in order:
            run = runs[name]
            began = clock()
            run()
            if turn >= warm_up:
                times[name].append(1e3 * (clock() - began))
    return {name: statistics.median(values) for name, values in times.items()}
