"""Activity of one stream: counters, times of the newest packet, estimate and loss, and latencies."""

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass

from neurove_protocol import TwistEstimate
from neurove_protocol.control import Losses

IDLE_NS = 1_000_000_000
"""A stream is idle after this time without a packet."""

_LATENCIES = 512


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
    malformed_packets: int = 0
    failed_packets: int = 0
    late_events: int = 0
    skipped_windows: int = 0

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
        self.last_packet_ns = self.last_estimate_ns = self.flow_began_ns = now_ns()
        self.last_loss_ns: int | None = None
        self.taken_ns = 0  # when the newest packet was taken out of the queue
        self._now_ns = now_ns

    @property
    def flowing(self) -> bool:
        """Whether packets are processed, however late."""
        return self._now_ns() - self.taken_ns < IDLE_NS

    def heard(self, received_ns: int) -> None:
        """Record when a packet arrived."""
        if received_ns - self.last_packet_ns > IDLE_NS:
            self.flow_began_ns = received_ns
        self.last_packet_ns = received_ns

    def lost(self, name: str, number: int) -> None:
        """Count a loss, by the name of its counter; `number` is above 0."""
        setattr(self.counters, name, getattr(self.counters, name) + number)
        self.last_loss_ns = self._now_ns()

    def published(self, estimate: TwistEstimate) -> None:
        """Record the latency of an estimate."""
        self.latencies_ms.append(estimate.trace.latency_ms)
        self.last_estimate_ns = estimate.trace.published_ns
