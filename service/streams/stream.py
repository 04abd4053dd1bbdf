"""Stream: the state of one camera stream; packet in, estimates out. It has no sockets and no threads."""

import time
from collections.abc import Callable, Sequence

from neurove_protocol import CameraInfo, Flag, Sensor, TwistEstimate
from neurove_protocol.errors import InvalidField
from neurove_protocol.events import Packet, PacketLimits
from neurove_service import logs
from neurove_service.guard import Guard
from neurove_service.streams.activity import Activity
from neurove_service.streams.age import newest_us
from neurove_service.streams.answers import Answers
from neurove_service.streams.flags import Flags
from neurove_service.streams.history import RingSize
from neurove_service.streams.inertial import Inertial
from neurove_service.streams.intake import Arrival, Intake
from neurove_service.streams.lanes import Lanes, Pushing, ServingModelFailed
from neurove_service.streams.model_source import ModelSource
from neurove_service.streams.runs import Run, Wanted, collect
from neurove_service.streams.sequence import Order
from neurove_service.streams.verdict import Verdicts

log = logs.get(__name__)

CLOCK_RESET_US = 1_000_000
"""If the sensor time goes back by more than this, the sensor clock was reset; otherwise the packet is late."""

UNREFINED_NS = 50_000_000
"""The windows of a packet that waited longer are not refined: a slow node leaves out the refinement first.

It is half of the time after which a packet counts as behind, see `overload`."""

_PROCESSED = (None, Order.FIRST, Order.AFTER_GAP, Order.AFTER_RESTART, Order.RECOVERED, Order.UNCOUNTED)


class Stream:
    """One camera stream on this node.

    Args:
        name: of the stream.
        models: asked once per packet; a model change takes effect at the next packet.
        now_ns: monotonic clock of this node [ns].
        ring: bounds of the windows that are kept to prime another model.
        node: name of the node, for the estimates.
        max_age_s: older packets are dropped [s].
        guard: counts errors of refinement and gyroscope, which cost no answer.
    """

    def __init__(
        self,
        name: str,
        models: ModelSource,
        now_ns: Callable[[], int] = time.monotonic_ns,
        ring: RingSize = RingSize(),  # noqa: B008  # immutable
        node: str | None = None,
        max_age_s: float = 1.0,
        guard: Guard | None = None,
    ) -> None:
        self.name, guard = name, guard or Guard()
        self.sensor: Sensor | None = None
        self.camera: CameraInfo | None = None
        self.activity = Activity(now_ns)
        self.counters = self.activity.counters
        self.verdicts = Verdicts(self.activity)
        self.lanes = Lanes(name, ring, guard)
        self.models = models
        self.inertial = Inertial(name, now_ns, guard)
        self._flags = Flags()
        self._intake = Intake(name, self.activity, self._flags, max_age_s)
        self._answers = Answers(name, node, self.activity, self._flags, self._intake, now_ns, max_age_s)
        models.join(self)

    def accept(self, packet: Packet, arrival: Arrival) -> list[TwistEstimate]:
        """Process one packet; answer every window that it completes.

        Raises:
            InvalidField: the packet belongs to another stream.
        """
        if packet.stream != self.name:
            raise InvalidField("event packet", "stream", packet.stream, f"received on the key of stream {self.name!r}")
        self._heard(packet, arrival, 1)
        order = self._intake.order(packet, arrival.received_ns)
        if order not in _PROCESSED:
            return []
        if order is Order.RECOVERED:  # its delay is that of a detour, and its time is not that of another clock
            window = self.lanes.open_window
            if packet.sensor != self.sensor or window is None or newest_us(packet) < window.start_us:
                self.activity.lost("out_of_order_packets", 1)  # all of its windows are answered
                return []
            return self._process(packet, arrival, packet)
        if order is Order.AFTER_RESTART:
            self._restart()
            self._intake.ages.forget()
        self._restart_if_changed(packet)
        if self._intake.is_stale(packet, arrival):
            return []
        self._flags.close_gap(self.lanes.open_window, packet.t0_us)
        return self._process(packet, arrival, packet)

    def collect(self, payloads: Sequence[bytes], limits: PacketLimits) -> Run | None:
        """The packets at the begin of some payloads that `accept_run` takes at once; None if there are none.

        Args:
            payloads: of packets, in order of arrival.
            limits: limits of packets.
        """
        window, expected = self.lanes.open_window, self._intake.expected
        if window is None or expected is None or self.sensor is None:
            return None
        return collect(payloads, limits, Wanted(self.name, self.sensor, expected, window))

    def accept_run(self, run: Run, arrival: Arrival) -> list[TwistEstimate]:
        """Process a run of packets, the last of which arrived then, with the results of `accept` for each."""
        packet, marks, first = run
        self._heard(packet, arrival, len(marks))
        self._intake.advance_run(marks, arrival.received_ns)
        if self._intake.is_stale(packet, arrival, len(marks)):
            return []
        self._flags.close_gap(self.lanes.open_window, packet.t0_us)
        return self._process(packet, arrival, first)

    def _heard(self, packet: Packet, arrival: Arrival, packets: int) -> None:
        self.counters.packets_received += packets
        self.counters.events_received += packet.events.n
        self.activity.heard(arrival.received_ns)
        self.activity.taken_ns, self.activity.waited_ns = arrival.queued_ns, arrival.queued_ns - arrival.received_ns

    def _process(self, packet: Packet, arrival: Arrival, first: Packet) -> list[TwistEstimate]:
        activity, window = self.activity, self.lanes.open_window
        kept = self._intake.without_shed_events(packet, window.start_us if window else None)
        pushing = self._push(kept, behind=arrival.queued_ns - arrival.received_ns > UNREFINED_NS)
        self.counters.outside_events += pushing.outside_events
        self.counters.unrefined_windows += pushing.unrefined_windows
        for name in ("late_events", "skipped_windows"):
            if number := getattr(pushing, name):
                activity.lost(name, number)
        aided = self.inertial.aid(pushing.estimates, pushing.serving.estimator, self.calibration)
        estimates = [self._answers.of(one, pushing.serving, self.calibration, packet, arrival) for one in aided]
        self._intake.compare(first)  # later: the windows ended before this packet
        return estimates

    @property
    def flowing(self) -> bool:
        """Whether packets are processed, however late."""
        return self.activity.flowing

    @property
    def calibration(self) -> CameraInfo | None:
        """The CameraInfo, if it belongs to the sensor of the stream."""
        return self.camera if self.camera is not None and self.camera.sensor == self.sensor else None

    def refused(self, received_ns: int, why: str = "") -> int:
        """Count a malformed packet; return how many there are now."""
        self.activity.heard(received_ns)
        self._intake.skip(1)
        self.activity.lost("malformed_packets", 1)
        self.activity.refusal = why
        return self.counters.malformed_packets

    def refused_camera(self, why: str) -> None:
        """Count a CameraInfo that was refused or does not belong to the sensor."""
        self.activity.add("refused_cameras", 1)
        self.activity.refusal = why

    def failed(self, packets: int = 1) -> None:
        """Count packets that an internal error lost, and restart: the state may be half updated."""
        self.activity.lost("failed_packets", packets)
        self._restart()
        self._flags.missing()

    def overloaded(self, packets: int) -> None:
        """Count packets that the queue dropped."""
        self._intake.skip(packets, Flag.OVERLOAD)
        self.activity.lost("overload_packets", packets)

    def shed(self, packets: int, start_us: int) -> None:
        """Leave out all windows before `start_us`, with so many whole packets, because this node cannot keep up."""
        window = self.lanes.open_window
        assert window is not None
        self._intake.shed(packets)
        self.activity.lost("shed_windows", (start_us - window.start_us) // window.duration_us)
        if packets:
            self.activity.lost("overload_packets", packets)
        self.lanes.leave_out_until(start_us)

    def set_camera(self, camera: CameraInfo) -> None:
        """Use this CameraInfo from the next packet on."""
        if camera == self.camera:
            return
        self.camera = camera
        if self.lanes.serving_lane is not None:
            self._flags.set_next(Flag.SENSOR_CHANGED)
            self._restart()
        log.info("camera info set", stream=self.name, sensor=str(camera.sensor), lens=camera.lens)

    def _restart(self) -> None:
        """Forget the recurrent state and the open window; the next packet begins a new sequence."""
        if (window := self.lanes.open_window) is not None and window.events:
            self.activity.lost("restart_windows", 1)
        self.lanes.restart()
        self.inertial.restart()
        self._flags.forget_gaps()
        self.activity.was_reset()

    def _restart_if_changed(self, packet: Packet) -> None:
        """Restart if the packet comes from another sensor or another clock than the previous one."""
        if self.sensor is not packet.sensor and self.sensor != packet.sensor:
            if self.sensor is not None:
                log.warning("sensor changed", stream=self.name, before=str(self.sensor), now=str(packet.sensor))
                self._flags.set_next(Flag.SENSOR_CHANGED)
                self._restart()
            self.sensor = packet.sensor
            if self.camera is not None and self.calibration is None:
                self.refused_camera(f"the camera info is for {self.camera.sensor}, the stream sends {packet.sensor}")
        window = self.lanes.open_window
        if window is not None and packet.t0_us < window.horizon_us - CLOCK_RESET_US:
            log.warning("sensor clock went backwards", stream=self.name, by_us=window.horizon_us - packet.t0_us)
            self._restart()
            self._intake.ages.forget()

    def _push(self, packet: Packet, *, behind: bool) -> Pushing:
        self._assign_models(packet)
        try:
            return self.lanes.push(packet, behind=behind)
        except ServingModelFailed as failure:
            assert self.lanes.serving_lane is not None
            self.models.fault(self.lanes.serving_lane.serving, f"stream {self.name}: {failure}")
            self._assign_models(packet)
            return self.lanes.push(packet, behind=behind)

    def _assign_models(self, packet: Packet) -> None:
        optics = packet.sensor, self.calibration
        skipped = self.lanes.assign(self.models.roles(self.name), optics, packet)
        if skipped:
            self.activity.lost("skipped_windows", skipped)
