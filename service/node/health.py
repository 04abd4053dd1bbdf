"""One verdict per stream and for the node."""

import time
from collections.abc import Sequence

from neurove_protocol.control import StandbyStatus, StreamStatus
from neurove_service.latency import latency
from neurove_service.streams.stream import Stream


def stream_status(
    node: str, stream: Stream, now_ns: int | None = None, standby: StandbyStatus | None = None
) -> StreamStatus:
    """Status of one stream; safe to call from any thread."""
    now_ns = time.monotonic_ns() if now_ns is None else now_ns
    verdict, why = stream.verdicts.at(now_ns)
    latencies = list(stream.activity.latencies_ms)
    counters, sensor, newest = stream.counters, stream.sensor, stream.activity.newest
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
        last_packet_age_s=(now_ns - stream.activity.newest_packet_ns) / 1e9,
        recovered_packets=counters.recovered_packets,
        uncounted_packets=counters.uncounted_packets,
        refused_cameras=counters.refused_cameras,
        refusal=stream.activity.refusal,
        unrefined_windows=counters.unrefined_windows,
        imu=stream.inertial.status(),
        latency_histogram=stream.activity.latency_histogram(),
        flag_counts={name: count for name, count in stream.activity.flag_counts.items() if count},
        sigma=newest.sigma if newest is not None else None,
        standby=standby,
    )


def node_verdict(streams: list[StreamStatus], faults: Sequence[str] = ()) -> tuple[bool, str]:
    """Whether a node is healthy, and a sentence with the reason.

    Args:
        streams: status of every stream.
        faults: what else is wrong with the node, each as the part of a sentence.
    """
    bad = list(faults)
    bad += [f"{status.stream} is {status.verdict}: {status.why}" for status in streams if status.verdict in _BAD]
    if bad:
        return False, "; ".join(bad)
    count = len(streams)
    return True, f"{count} stream{'s' * (count > 1)}" if count else "no stream yet"


_BAD = ("lossy", "stalled", "unstable")
