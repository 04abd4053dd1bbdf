"""One verdict per stream and for the node."""

import time

from neurove_protocol.control import StreamStatus, Verdict
from neurove_service.latency import latency
from neurove_service.streams.stream import IDLE_NS, Stream

STALLED_S = 2.0
"""A stream whose packets flow, but without an estimate for so long, is stalled."""

LOSSY_S = 5.0
"""A loss so recent makes a stream lossy."""


def stream_status(node: str, stream: Stream, now_ns: int | None = None) -> StreamStatus:
    """What a node says about one of its streams; safe to call from any thread."""
    now_ns = time.monotonic_ns() if now_ns is None else now_ns
    verdict, why = _verdict(stream, now_ns)
    latencies = list(stream.latencies_ms)
    counters, sensor = stream.counters, stream.sensor
    return StreamStatus(
        node=node,
        stream=stream.name,
        verdict=verdict,
        why=why,
        width=sensor.width if sensor else 0,
        height=sensor.height if sensor else 0,
        calibrated=stream.calibrated,
        packets_received=counters.packets_received,
        events_received=counters.events_received,
        windows=counters.windows,
        estimates=counters.estimates,
        resets=counters.resets,
        outside_events=counters.outside_events,
        lost=counters.losses(),
        latency_ms=latency(latencies),
        last_packet_age_s=(now_ns - stream.last_packet_ns) / 1e9,
    )


def _verdict(stream: Stream, now_ns: int) -> tuple[Verdict, str]:
    packet_age_ns = now_ns - stream.last_packet_ns
    estimate_age_s = (now_ns - max(stream.last_estimate_ns, stream.flow_began_ns)) / 1e9
    if packet_age_ns > IDLE_NS:
        return "idle", f"no packet for {packet_age_ns / 1e9:.1f} s"
    if estimate_age_s > STALLED_S:
        return "stalled", f"packets come, but no estimate for {estimate_age_s:.1f} s"
    if stream.last_loss_ns is not None and (now_ns - stream.last_loss_ns) / 1e9 < LOSSY_S:
        lost = stream.counters.losses().nonzero()
        return "lossy", "lost since the start: " + ", ".join(f"{name} {count}" for name, count in lost.items())
    return "ok", "every packet became part of an estimate"


def node_verdict(streams: list[StreamStatus], refused_streams: int = 0) -> tuple[bool, str]:
    """Whether a node is fine, and the sentence that says why not."""
    bad = [f"{status.stream} is {status.verdict}: {status.why}" for status in streams if status.verdict in _BAD]
    bad += [f"{refused_streams} streams refused, for it serves as many as it may"] if refused_streams else []
    if bad:
        return False, "; ".join(bad)
    count = len(streams)
    return True, f"{count} stream{'s' * (count > 1)}" if count else "no stream yet"


_BAD = ("lossy", "stalled")
