"""/diagnostics: one status for each stream, with the verdict of the service and the counts of the bridge."""

from typing import Final, NamedTuple

from neurove_core.io.formats.ros.types import DiagnosticsMessage, Header, KeyValue, Status
from neurove_protocol.control import StreamStatus
from neurove_service.ros2.feed import Feed
from neurove_service.ros2.velocity import WHY, Velocity

OK, WARN, ERROR, STALE = range(4)
"""Levels of a diagnostic_msgs/DiagnosticStatus."""

SILENT_NS: Final = 2_000_000_000
"""Without a message for this time a topic, or the service, is silent."""

_LOSSES: Final = ("lost_messages", "dropped_messages", "refused_messages", "other_type", "foreign_messages")
_VERDICTS: Final = {"ok": OK, "idle": STALE}


class Seen(NamedTuple):
    """What the bridge knows about one stream."""

    stream: str
    topic: str  # of the events
    feed: Feed
    velocity: Velocity
    status: StreamStatus | None  # newest status of the service
    status_ns: int  # when it arrived, monotonic clock


class Reporter:
    """Makes the messages, and knows which losses are new in each.

    Args:
        hardware_id: of every status.
    """

    def __init__(self, hardware_id: str) -> None:
        self._hardware_id = hardware_id
        self._before: dict[str, dict[str, int]] = {}

    def message(self, streams: list[Seen], fault: str, now_ns: int, unix_ns: int) -> DiagnosticsMessage:
        """The message of now.

        Args:
            streams: all of the bridge.
            fault: why the link does not work; empty if it does.
            now_ns: monotonic clock [ns].
            unix_ns: unix time [ns].
        """
        return DiagnosticsMessage(Header.at(unix_ns, ""), tuple(self._status(one, fault, now_ns) for one in streams))

    def _status(self, seen: Seen, fault: str, now_ns: int) -> Status:
        counts = seen.feed.as_json()
        before = self._before.get(seen.stream, dict.fromkeys(counts, 0))
        self._before[seen.stream] = counts
        lost = {name: counts[name] - before[name] for name in _LOSSES if counts[name] > before[name]}
        level, message = self._verdict(seen, lost, fault, now_ns)
        values = {name: str(count) for name, count in counts.items()}
        values |= {f"velocity_{name}": str(getattr(seen.velocity, name)) for name in ("sent", "withheld", "unstamped")}
        values |= {f"doubtful_{name}": str(count) for name, count in sorted(seen.velocity.doubted.items())}
        values |= {"refusal": seen.feed.refusal[:512]} if seen.feed.refusal else {}
        if seen.status is not None:
            values |= {"service": f"{seen.status.verdict}: {seen.status.why}", "service_node": seen.status.node}
            values |= {f"service_{name}": str(count) for name, count in seen.status.lost.nonzero().items()}
        pairs = tuple(KeyValue(name, value) for name, value in values.items())
        return Status(level, f"neurove: {seen.stream}", message[:512], self._hardware_id, pairs)

    def _verdict(self, seen: Seen, lost: dict[str, int], fault: str, now_ns: int) -> tuple[int, str]:
        """Level and sentence: the first reason that holds."""
        if fault:
            return ERROR, fault
        newest_ns = seen.feed.newest_ns
        if newest_ns is None or now_ns - newest_ns > SILENT_NS:
            since = "yet" if newest_ns is None else f"for {(now_ns - newest_ns) / 1e9:.0f} s"
            why = f"; {seen.feed.refusal}" if seen.feed.refusal else ""
            return (ERROR if why else STALE), f"no events on {seen.topic} {since}{why}"
        if seen.status is None or now_ns - seen.status_ns > 2 * SILENT_NS:
            return ERROR, "the service does not answer for this stream"
        if lost:
            return WARN, "in the last second: " + ", ".join(f"{count} {name}" for name, count in lost.items())
        if seen.status.verdict != "ok":
            return _VERDICTS.get(seen.status.verdict, WARN), f"service: {seen.status.why or seen.status.verdict}"
        if seen.velocity.newest.linear:
            reasons = "; ".join(WHY[doubt] for doubt in seen.velocity.newest.linear)
            return WARN, f"the linear velocity is not reliable: {reasons}"
        return OK, "estimates are published"
