"""Stream: the state of one camera stream; packet in, estimates out. It has no sockets and no threads."""

import time
from collections.abc import Callable
from typing import NamedTuple

from neurove_core.estimator import WindowEstimate
from neurove_protocol import CameraInfo, Flag, Sensor, Trace, Twist, TwistEstimate
from neurove_protocol.errors import InvalidField
from neurove_protocol.events import Packet
from neurove_service import logs
from neurove_service.streams.activity import Activity
from neurove_service.streams.flags import Flags
from neurove_service.streams.history import RingSize
from neurove_service.streams.lanes import Lanes, Pushing, ServingModelFailed
from neurove_service.streams.model_source import ModelSource
from neurove_service.streams.roles import Serving
from neurove_service.streams.sequence import Order, Sequence

log = logs.get(__name__)

CLOCK_RESET_US = 1_000_000
"""If the sensor time goes back by more than this, the sensor clock was reset; otherwise the packet is late."""

_LOSS_BY_ORDER = {Order.DUPLICATE: "duplicate_packets", Order.OUT_OF_ORDER: "out_of_order_packets"}


class Arrival(NamedTuple):
    """When a packet arrived, on the monotonic clock of this node [ns]."""

    received_ns: int
    queued_ns: int  # when it was taken out of the queue


class Stream:
    """One camera stream on this node.

    Args:
        name: of the stream.
        models: asked once per packet; a model change takes effect at the next packet.
        now_ns: monotonic clock of this node [ns].
        ring: bounds of the windows that are kept to prime another model.
    """

    def __init__(
        self,
        name: str,
        models: ModelSource,
        now_ns: Callable[[], int] = time.monotonic_ns,
        ring: RingSize = RingSize(),  # noqa: B008  # immutable
    ) -> None:
        self.name = name
        self.sensor: Sensor | None = None
        self.camera: CameraInfo | None = None
        self.activity = Activity(now_ns)
        self.counters = self.activity.counters
        self.lanes = Lanes(name, ring)
        self._models, self._now_ns = models, now_ns
        self._sequence = Sequence()
        self._flags = Flags()
        models.join(self)

    def accept(self, packet: Packet, arrival: Arrival) -> list[TwistEstimate]:
        """Process one packet; answer every window that it completes.

        Raises:
            InvalidField: the packet belongs to another stream.
        """
        if packet.stream != self.name:
            raise InvalidField("event packet", "stream", packet.stream, f"received on the key of stream {self.name!r}")
        counters, activity = self.counters, self.activity
        counters.packets_received += 1
        counters.events_received += packet.events.n
        activity.heard(arrival.received_ns)
        activity.taken_ns = arrival.queued_ns
        if not self._sequence.advance(packet) and not self._accept_irregular(packet):
            return []
        self._restart_if_changed(packet)
        pushing = self._push(packet)
        counters.outside_events += pushing.outside_events
        if pushing.late_events:
            activity.lost("late_events", pushing.late_events)
        if pushing.skipped_windows:
            activity.lost("skipped_windows", pushing.skipped_windows)
        return [self._estimate(window, pushing.serving, arrival) for window in pushing.estimates]

    @property
    def flowing(self) -> bool:
        """Whether packets are processed, however late."""
        return self.activity.flowing

    @property
    def calibration(self) -> CameraInfo | None:
        """The CameraInfo, if it belongs to the sensor of the stream."""
        return self.camera if self.camera is not None and self.camera.sensor == self.sensor else None

    def refused(self, received_ns: int) -> int:
        """Count a malformed packet; return how many there are now."""
        self.activity.heard(received_ns)
        self._sequence.skip(1)
        self.activity.lost("malformed_packets", 1)
        return self.counters.malformed_packets

    def failed(self) -> None:
        """Count a packet that an internal error lost, and restart: the state may be half updated."""
        self.activity.lost("failed_packets", 1)
        self._restart()

    def overloaded(self, packets: int) -> None:
        """Count packets that the queue dropped."""
        self._sequence.skip(packets)
        self._flags.set_next(Flag.OVERLOAD)
        self.activity.lost("overload_packets", packets)

    def set_camera(self, camera: CameraInfo) -> None:
        """Use this CameraInfo from the next packet on."""
        if camera == self.camera:
            return
        self.camera = camera
        if self.lanes.serving_lane is not None:
            self._flags.set_next(Flag.SENSOR_CHANGED)
            self._restart()
        log.info("camera info set", stream=self.name, sensor=str(camera.sensor), lens=camera.lens)

    def _accept_irregular(self, packet: Packet) -> bool:
        """Handle a packet that is not the expected one; whether it is processed."""
        order, lost = self._sequence.place(packet)
        if order is Order.AFTER_GAP:
            self._flags.add_gap(self.lanes.horizon_us, packet.t0_us, lost)
            if lost:
                self.activity.lost("gap_packets", lost)
                log.warning("packets lost", stream=self.name, gap=lost, total=self.counters.gap_packets)
            return True
        if order is Order.AFTER_RESTART:
            log.info("driver restarted", stream=self.name, seq=packet.seq)
            self._restart()
            return True
        if order is Order.FIRST:
            return True
        self.activity.lost(_LOSS_BY_ORDER[order], 1)
        return False

    def _restart(self) -> None:
        """Forget the recurrent state and the open window; the next packet begins a new sequence."""
        self.lanes.restart()
        self._flags.forget_gaps()
        self.counters.resets += 1

    def _restart_if_changed(self, packet: Packet) -> None:
        """Restart if the packet comes from another sensor or another clock than the previous one."""
        if self.sensor != packet.sensor:
            if self.sensor is not None:
                log.warning("sensor changed", stream=self.name, before=str(self.sensor), now=str(packet.sensor))
                self._flags.set_next(Flag.SENSOR_CHANGED)
                self._restart()
            self.sensor = packet.sensor
        horizon_us = self.lanes.horizon_us
        if horizon_us is not None and packet.t0_us < horizon_us - CLOCK_RESET_US:
            log.warning("sensor clock went backwards", stream=self.name, by_us=horizon_us - packet.t0_us)
            self._restart()

    def _push(self, packet: Packet) -> Pushing:
        self._assign_models(packet)
        try:
            return self.lanes.push(packet)
        except ServingModelFailed as failure:
            assert self.lanes.serving_lane is not None
            self._models.fault(self.lanes.serving_lane.serving, f"stream {self.name}: {failure}")
            self._assign_models(packet)
            return self.lanes.push(packet)

    def _assign_models(self, packet: Packet) -> None:
        optics = packet.sensor, self.calibration
        skipped = self.lanes.assign(self._models.roles(self.name), optics, packet)
        if skipped:
            self.activity.lost("skipped_windows", skipped)

    def _estimate(self, window: WindowEstimate, serving: Serving, arrival: Arrival) -> TwistEstimate:
        bundle = serving.estimator.bundle
        bins = len(window.twists)
        bin_us = (window.end_us - window.start_us) // bins
        now_ns = self._now_ns()
        estimate = TwistEstimate(
            stream=self.name,
            seq=self.counters.estimates,
            start_us=window.start_us,
            end_us=window.end_us,
            bin_end_us=tuple(window.start_us + bin_us * (i + 1) for i in range(bins)),
            twists=tuple(Twist(*row) for row in window.twists.tolist()),
            model=bundle.name,
            digest=bundle.digest,
            epoch=serving.epoch,
            events=window.events,
            flags=self._flags.of(window, self.calibration, trained=bundle.trained),
            covariance=None if window.covariance is None else tuple(window.covariance.ravel().tolist()),
            trace=Trace(
                received_ns=arrival.received_ns, queued_ns=arrival.queued_ns, computed_ns=now_ns, published_ns=now_ns
            ),
        )
        self.counters.windows += 1
        self.counters.estimates += 1
        return estimate
