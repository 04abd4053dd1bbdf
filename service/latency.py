"""Percentiles of latencies, in a module of its own: clients need them without the imports of the node."""

import numpy as np

from neurove_protocol.control import Latency


def latency(latencies_ms: list[float]) -> Latency | None:
    """Percentiles of latencies [ms]; None without latencies.

    >>> latency([1.0, 2.0, 3.0]).p50
    2.0
    """
    if not latencies_ms:
        return None
    p50, p95, p99 = np.percentile(latencies_ms, [50, 95, 99]).tolist()
    return Latency(p50=p50, p95=p95, p99=p99)
