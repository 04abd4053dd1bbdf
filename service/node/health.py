"""One verdict per stream and for the node."""

import time
from collections.abc import Sequence

from neurove_protocol.control import StreamStatus, Verdict
from neurove_service.latency import latency
from neurove_service.streams.activity import IDLE_NS
from neurove_service.streams.stream import Stream

STALLED_S = 2.0
"""A stream with packets but without an estimate for this time is stalled."""

LOSSY_S = 5.0
"""A stream with a loss within this time is lossy."""


def stream_status(node: str, stream: Stream, now_ns: int | None = None) -> StreamStatus:
    """Status of one stream; safe to call from any thread."""
    now_ns = time.monotonic_ns() if now_ns is None else now_ns
    verdict, why = _verdict(stream, now_ns)
    latencies = list(stream.activity.latencies_ms)
    counters, sensor = stream.counters, stream.sensor
    return StreamStatus(
        node=node,
        stream=stream.name,
        verdict=verdict,
        why=why,
        width=sensor.width if sensor else 0,
        height=sensor.height if sensor else 0,
        calibrated=stream.calibration is not None,
        packets_received=counters.packets_received,
        events_received=counters.events_received,
        windows=counters.windows,
        estimates=counters.estimates,
        resets=counters.resets,
        outside_events=counters.outside_events,
        lost=counters.losses(),
        latency_ms=latency(latencies),
        last_packet_age_s=(now_ns - stream.activity.last_packet_ns) / 1e9,
    )


def _verdict(stream: Stream, now_ns: int) -> tuple[Verdict, str]:
    packet_age_ns = now_ns - stream.activity.last_packet_ns
    estimate_age_s = (now_ns - max(stream.activity.last_estimate_ns, stream.activity.flow_began_ns)) / 1e9
    if packet_age_ns > IDLE_NS:
        return "idle", f"no packet for {packet_age_ns / 1e9:.1f} s"
    if estimate_age_s > STALLED_S:
        return "stalled", f"packets arrive, but no estimate for {estimate_age_s:.1f} s"
    if stream.activity.last_loss_ns is not None and (now_ns - stream.activity.last_loss_ns) / 1e9 < LOSSY_S:
        lost = stream.counters.losses().nonzero()
        return "lossy", "lost since the stream began: " + ", ".join(f"{name} {count}" for name, count in lost.items())
    return "ok", f"nothing lost in the last {LOSSY_S:g} s"


def node_verdict(
    streams: list[StreamStatus], refused_streams: int = 0, model_faults: Sequence[str] = ()
) -> tuple[bool, str]:
    """Whether a node is healthy, and a sentence with the reason."""
    bad = list(model_faults)
    bad += [f"{status.stream} is {status.verdict}: {status.why}" for status in streams if status.verdict in _BAD]
    bad += [f"{refused_streams} streams refused: max_streams reached"] if refused_streams else []
    if bad:
        return False, "; ".join(bad)
    count = len(streams)
    return True, f"{count} stream{'s' * (count > 1)}" if count else "no stream yet"


_BAD = ("lossy", "stalled")
