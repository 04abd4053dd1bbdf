"""Speed, told as ratios: ours and a peer in one process, interleaved, with the same inputs and compared answers."""

import statistics
import time
from collections.abc import Callable
from typing import NamedTuple


class Row(NamedTuple):
    """One comparison; times are medians of CPU time of one thread [ms]."""

    name: str
    ours_ms: float
    peer: str
    peer_ms: float
    ratio: float  # the peer's time over ours
    share_of_limit: float | None  # of what the same run measured as this machine's limit, where there is one
    equal: bool | None  # whether the answers agree; None where the peer computes something else by design


def rows(name: str, times: dict[str, float], equal: dict[str, bool | None], limit_ms: float | None = None) -> list[Row]:
    """One row for each peer, the fastest peer first.

    Args:
        name: of the benchmark.
        times: as `interleaved` gives them: `ours`, the peers, and what else was measured.
        equal: of each peer.
        limit_ms: what the limit of this machine would take, measured in the same run.
    """
    ours = times["ours"]
    share = limit_ms / ours if limit_ms else None
    peers = sorted(equal, key=lambda peer: times[peer])
    return [Row(name, ours, peer, times[peer], times[peer] / ours, share, equal[peer]) for peer in peers]


def interleaved(runs: dict[str, Callable[[], object]], rounds: int, warm_up: int = 2) -> dict[str, float]:
    """Median CPU time [ms] of each, one after the other in every round, so that a busy machine slows all alike.

    Args:
        runs: what to time, by name.
        rounds: how often.
        warm_up: rounds before, not counted.
    """
    times: dict[str, list[float]] = {name: [] for name in runs}
    for turn in range(warm_up + rounds):
        for name, run in runs.items():
            began = time.thread_time()
            run()
            if turn >= warm_up:
                times[name].append(1e3 * (time.thread_time() - began))
    return {name: statistics.median(values) for name, values in times.items()}
