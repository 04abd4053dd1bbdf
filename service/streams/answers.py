"""Answers: the estimate of a window as the message that is published."""

import time
from collections.abc import Callable

from neurove_core.stream_state import WindowEstimate
from neurove_protocol import CameraInfo, HostTime, Trace, Twist, TwistEstimate
from neurove_protocol.events import Packet
from neurove_service.streams.activity import Activity
from neurove_service.streams.age import newest_us
from neurove_service.streams.flags import Flags
from neurove_service.streams.intake import Arrival, Intake
from neurove_service.streams.roles import Serving

LATE_SHARE = 0.25
"""An estimate is late if the end of its window is older than this share of max_age_s."""

_MAX_SPAN_US = 1 << 40  # from the end of a window to the newest event; beyond it no time of the host is told


class Answers:
    """Makes the messages of one stream.

    Args:
        stream: its name.
        node: name of the node.
        activity: counts windows and estimates.
        flags: what happened since the last estimate.
        intake: knows how old the packets are.
        now_ns: monotonic clock of this node [ns].
        max_age_s: older packets are dropped [s].
    """

    def __init__(
        self,
        stream: str,
        node: str | None,
        activity: Activity,
        flags: Flags,
        intake: Intake,
        now_ns: Callable[[], int],
        max_age_s: float,
    ) -> None:
        self._stream, self._node, self._activity = stream, node, activity
        self._flags, self._intake, self._now_ns = flags, intake, now_ns
        self._late_ns = LATE_SHARE * max_age_s * 1e9

    def of(
        self,
        window: WindowEstimate,
        serving: Serving,
        calibration: CameraInfo | None,
        packet: Packet,
        arrival: Arrival,
    ) -> TwistEstimate:
        """The message of a window, with its number, flags and times.

        Args:
            window: the estimate.
            serving: the model that made it.
            calibration: the camera info in use.
            packet: completed the window.
            arrival: of this packet.
        """
        bundle = serving.estimator.bundle
        bins = len(window.twists)
        bin_us = (window.end_us - window.start_us) // bins
        now_ns = self._now_ns()
        host = self._host_time(window.end_us, packet, arrival, now_ns)
        late = host is not None and host.age_ns > self._late_ns
        flags = self._flags.of(window, calibration, trained=bundle.trained, late=late, frozen=self._intake.frozen)
        estimate = TwistEstimate(
            stream=self._stream,
            seq=self._activity.counters.estimates,
            start_us=window.start_us,
            end_us=window.end_us,
            bin_end_us=tuple(window.start_us + bin_us * (i + 1) for i in range(bins)),
            twists=tuple(Twist(*row) for row in window.twists.tolist()),
            model=bundle.name,
            digest=bundle.digest,
            epoch=serving.epoch,
            events=window.events,
            flags=flags,
            covariance=None if window.covariance is None else tuple(window.covariance.ravel().tolist()),
            trace=Trace(
                received_ns=arrival.received_ns, queued_ns=arrival.queued_ns, computed_ns=now_ns, published_ns=now_ns
            ),
            node=self._node,
            host=host,
            source=window.source,
        )
        self._activity.counters.windows += 1
        self._activity.counters.estimates += 1
        return estimate

    def _host_time(self, end_us: int, packet: Packet, arrival: Arrival, now_ns: int) -> HostTime | None:
        """When a window ended on the clocks of this node."""
        span_us = newest_us(packet) - end_us
        if abs(span_us) > _MAX_SPAN_US:
            return None
        age_ns = max(0, now_ns - arrival.received_ns + self._intake.delay_ns + span_us * 1000)
        uncertainty_ns = self._intake.ages.uncertainty_ns
        return HostTime(end_ns=time.time_ns() - age_ns, uncertainty_ns=uncertainty_ns, age_ns=age_ns)
