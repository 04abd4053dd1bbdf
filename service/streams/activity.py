"""Activity of one stream: counters, times of the newest packet, estimate and loss, and latencies."""

from bisect import bisect_left
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass

from neurove_protocol import Flag, TwistEstimate
from neurove_protocol.control import LATENCY_BOUNDS_MS, LatencyHistogram, Losses

IDLE_NS = 1_000_000_000
"""A stream is idle after this time without a packet."""

MAX_COUNT = (1 << 63) - 1
"""A counter stops here, because it could not be sent otherwise."""

_LATENCIES = 512
_RESETS = 64
_UNSURE = frozenset((Flag.UNCERTAIN, Flag.SETTLING, Flag.FROZEN))


@dataclass
class Counters:
    """Counts since the stream began; only the worker of the stream writes them."""

    packets_received: int = 0
    events_received: int = 0
    windows: int = 0
    estimates: int = 0
    resets: int = 0
    outside_events: int = 0
    gap_packets: int = 0
    overload_packets: int = 0
    duplicate_packets: int = 0
    out_of_order_packets: int = 0
    foreign_packets: int = 0
    stale_packets: int = 0
    malformed_packets: int = 0
    failed_packets: int = 0
    late_events: int = 0
    skipped_windows: int = 0
    shed_windows: int = 0
    restart_windows: int = 0
    recovered_packets: int = 0
    uncounted_packets: int = 0
    refused_cameras: int = 0
    unrefined_windows: int = 0

    def losses(self) -> Losses:
        """The counters of data that is not part of an estimate."""
        return Losses(**{name: getattr(self, name) for name in Losses.model_fields})


class Activity:
    """Counters and times of one stream; the worker writes them, any thread may read them.

    Args:
        now_ns: monotonic clock of this node [ns].
    """

    def __init__(self, now_ns: Callable[[], int]) -> None:
        self.counters = Counters()
        self.latencies_ms: deque[float] = deque(maxlen=_LATENCIES)
        self.flag_counts = {flag.value: 0 for flag in Flag}  # estimates by flag
        self.newest: TwistEstimate | None = None  # the estimate that was published last
        self._buckets = [0] * (len(LATENCY_BOUNDS_MS) + 1)
        self._latency_sum_ms = 0.0
        self.last_packet_ns = self.last_estimate_ns = self.flow_began_ns = now_ns()
        self.last_loss_ns: int | None = None
        self.arrived_ns = 0  # when the newest packet arrived, which may still wait; written by Zenoh's thread
        self.waited_ns = 0  # how long the newest packet waited in the queue
        self.taken_ns = 0  # when the newest packet was taken out of the queue
        self.reset_ns: deque[int] = deque(maxlen=_RESETS)  # times of the newest resets
        self.newest_ns: dict[str, int] = {}  # counter or flag -> when it last grew
        self.certain_ns = self.last_estimate_ns  # newest estimate that was neither uncertain nor settling
        self.unit_hint = ""  # why the clock of the stream does not seem to count microseconds
        self.refusal = ""  # why the newest packet or CameraInfo was refused
        self._now_ns = now_ns

    @property
    def flowing(self) -> bool:
        """Whether packets are processed, however late."""
        return self._now_ns() - self.taken_ns < IDLE_NS

    @property
    def newest_packet_ns(self) -> int:
        """When the newest packet arrived, processed or not."""
        return max(self.last_packet_ns, self.arrived_ns)

    def count(self, estimate: TwistEstimate) -> None:
        """Count the latency and the flags of an estimate that was recorded, for metrics."""
        latency_ms = self.latencies_ms[-1]
        self._buckets[bisect_left(LATENCY_BOUNDS_MS, latency_ms)] += 1
        self._latency_sum_ms += latency_ms
        for flag in estimate.flags:
            self.flag_counts[flag] += 1
        self.newest = estimate

    def latency_histogram(self) -> LatencyHistogram:
        """Latencies of all estimates."""
        return LatencyHistogram(counts=tuple(self._buckets), sum_ms=max(0.0, self._latency_sum_ms))

    def heard(self, received_ns: int) -> None:
        """Record when a packet arrived."""
        if received_ns - self.last_packet_ns > IDLE_NS:
            self.flow_began_ns = self.certain_ns = received_ns
        self.last_packet_ns = received_ns

    def add(self, name: str, number: int) -> None:
        """Increase a counter, by its name."""
        setattr(self.counters, name, min(MAX_COUNT, getattr(self.counters, name) + number))
        self.newest_ns[name] = self._now_ns()

    def lost(self, name: str, number: int) -> None:
        """Count a loss, by the name of its counter; `number` is above 0."""
        self.add(name, number)
        self.last_loss_ns = self._now_ns()

    def grew_within(self, name: str, seconds: float, now_ns: int) -> bool:
        """Whether a counter grew in the last seconds."""
        return name in self.newest_ns and now_ns - self.newest_ns[name] < seconds * 1e9

    def tell_unit(self, hint: str) -> None:
        """Record that the clock of the stream does not count microseconds."""
        self.unit_hint = hint
        self.newest_ns["unit_hint"] = self._now_ns()

    def was_reset(self) -> None:
        """Count a reset of the recurrent state."""
        self.add("resets", 1)
        self.reset_ns.append(self._now_ns())

    def published(self, estimate: TwistEstimate) -> None:
        """Record and count an estimate that was published."""
        self.record(estimate)
        self.count(estimate)

    def record(self, estimate: TwistEstimate) -> None:
        """Record the latency of an estimate and its time, for the verdict."""
        self.latencies_ms.append(estimate.trace.latency_ms)
        self.last_estimate_ns = estimate.trace.published_ns
        if Flag.FROZEN in estimate.flags:
            self.newest_ns["frozen"] = self.last_estimate_ns
        if not _UNSURE.intersection(estimate.flags):
            self.certain_ns = estimate.trace.published_ns
