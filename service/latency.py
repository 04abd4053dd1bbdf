"""Percentiles of latencies; apart from health.py, for a client needs them without the service's own imports."""

import numpy as np

from neurove_protocol.control import Latency


def latency(latencies_ms: list[float]) -> Latency | None:
    """Percentiles of some latencies, or None where there are none.

    >>> latency([1.0, 2.0, 3.0]).p50
    2.0
    """
    if not latencies_ms:
        return None
    p50, p95, p99 = np.percentile(latencies_ms, [50, 95, 99]).tolist()
    return Latency(p50=p50, p95=p95, p99=p99)
