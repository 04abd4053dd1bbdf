"""Stream: one camera's state, gap check and counters; packet in, estimates out. No sockets, no threads."""

import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import NamedTuple

from neurove_core.estimator import WindowEstimate
from neurove_protocol import CameraInfo, Flag, Sensor, Trace, Twist, TwistEstimate
from neurove_protocol.control import Losses
from neurove_protocol.errors import InvalidField
from neurove_protocol.events import Packet
from neurove_service import logs
from neurove_service.models.slot import ModelSlot
from neurove_service.streams.lane import Serving
from neurove_service.streams.lanes import Lanes, Pushing, RingSize, Unfit

log = logs.get(__name__)

CLOCK_RESET_US = 1_000_000
"""Sensor time that goes back by more than this is a new clock, not a late packet."""

REWIND_PACKETS = 3
"""So many packets in a row that count up from an old number are a driver that restarted, not stray ones."""

IDLE_NS = 1_000_000_000
"""A stream without a packet for so long is idle."""

_LATENCIES = 512


class Arrival(NamedTuple):
    """When a packet came, on our monotonic clock [ns]."""

    received_ns: int
    queued_ns: int  # taken out of the queue


@dataclass
class Counters:
    """What one stream has seen since it began; the stream's worker alone writes them."""

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
        """The counters of what did not become part of an estimate."""
        return Losses(**{name: getattr(self, name) for name in Losses.model_fields})


class _Hole(NamedTuple):
    start_us: int
    end_us: int
    flags: frozenset[Flag]


@dataclass
class _Sequence:
    """What the sequence numbers of a stream say."""

    expected: int | None = None
    first_t0_us: int = 0
    rewind: deque[int] = field(default_factory=lambda: deque(maxlen=REWIND_PACKETS))
    unread: int = 0  # numbers that came but were refused or dropped here: not lost on the way


class Stream:
    """One camera stream on this node.

    Args:
        name: of the stream.
        slot: read once per packet; a change of model takes effect at the next one.
        now_ns: our monotonic clock.
        ring: what it keeps of its newest windows, to prime another model with.
    """

    def __init__(
        self,
        name: str,
        slot: ModelSlot,
        now_ns: Callable[[], int] = time.monotonic_ns,
        ring: RingSize = RingSize(),  # noqa: B008  # immutable
    ) -> None:
        self.name = name
        self.counters = Counters()
        self.sensor: Sensor | None = None
        self.camera: CameraInfo | None = None
        self.latencies_ms: deque[float] = deque(maxlen=_LATENCIES)
        self.last_packet_ns = self.last_estimate_ns = self.flow_began_ns = now_ns()
        self.last_loss_ns: int | None = None
        self._taken_ns = 0  # when the newest packet was taken out of the queue
        self._slot, self._now_ns = slot, now_ns
        self.lanes = Lanes(name, ring)
        self._sequence = _Sequence()
        self._holes: list[_Hole] = []
        self._pending: set[Flag] = set()
        slot.join(self)

    def accept(self, packet: Packet, arrival: Arrival) -> list[TwistEstimate]:
        """Take one packet; answer every window that it completes.

        Raises:
            InvalidField: the packet is of another stream than this.
        """
        if packet.stream != self.name:
            raise InvalidField("event packet", "stream", packet.stream, f"it came on the key of stream {self.name!r}")
        self.counters.packets_received += 1
        self.counters.events_received += packet.events.n
        self._heard(arrival.received_ns)
        self._taken_ns = arrival.queued_ns
        if not self._in_sequence(packet):
            return []
        self._look_at(packet)
        pushing = self._push(packet)
        self.counters.outside_events += pushing.outside_events
        self._count("late_events", pushing.late_events)
        self._count("skipped_windows", pushing.skipped_windows)
        return [self._estimate(window, pushing.serving, arrival) for window in pushing.estimates]

    @property
    def flowing(self) -> bool:
        """Whether packets are worked on, however late they may be."""
        return self._now_ns() - self._taken_ns < IDLE_NS

    @property
    def owes(self) -> bool:
        """Whether a model that runs beside the one that answers has something to catch up on."""
        return self.lanes.owes

    def attend(self) -> None:
        """Let the model beside do one piece of its work: for when no packet waits."""
        self.lanes.attend()

    def refused(self, received_ns: int) -> int:
        """Count a packet that could not be read; returns how many these are by now."""
        self._heard(received_ns)
        self._sequence.unread += 1
        self._count("malformed_packets", 1)
        return self.counters.malformed_packets

    def failed(self) -> None:
        """Count a packet that a fault of ours has cost, and start anew: the state may be half changed."""
        self._count("failed_packets", 1)
        self._restart()

    def overloaded(self, packets: int) -> None:
        """Count packets that were dropped before the stream saw them."""
        self._sequence.unread += packets
        self._pending.add(Flag.OVERLOAD)
        self._count("overload_packets", packets)

    def see_through(self, camera: CameraInfo) -> None:
        """Use this CameraInfo from the next packet on."""
        if camera == self.camera:
            return
        self.camera = camera
        if self.lanes.front is not None:
            self._pending.add(Flag.SENSOR_CHANGED)
            self._restart()
        log.info("camera info", stream=self.name, sensor=str(camera.sensor), lens=camera.lens)

    def published(self, estimate: TwistEstimate) -> None:
        """Keep an estimate's latency for the statistics."""
        self.latencies_ms.append(estimate.trace.latency_ms)
        self.last_estimate_ns = estimate.trace.published_ns

    def _heard(self, received_ns: int) -> None:
        if received_ns - self.last_packet_ns > IDLE_NS:
            self.flow_began_ns = received_ns
        self.last_packet_ns = received_ns

    def _count(self, name: str, number: int) -> None:
        if number:
            setattr(self.counters, name, getattr(self.counters, name) + number)
            self.last_loss_ns = self._now_ns()

    def _in_sequence(self, packet: Packet) -> bool:
        """Whether the packet is the next one, after counting what is missing before it."""
        sequence = self._sequence
        if sequence.expected is None:
            self._begin(packet)
            return True
        if packet.seq < sequence.expected:
            if not self._driver_restarted(packet):
                return False
            log.info("driver restarted", stream=self.name, seq=packet.seq)
            self._restart()
            self._begin(packet)
            return True
        missing = packet.seq - sequence.expected
        lost = max(0, missing - sequence.unread)
        if missing:
            self._note_hole(packet.t0_us, lost)
        if lost:
            self._count("gap_packets", lost)
            log.warning("packets lost", stream=self.name, gap=lost, total=self.counters.gap_packets)
        sequence.expected, sequence.unread = packet.seq + 1, 0
        sequence.rewind.clear()
        return True

    def _begin(self, packet: Packet) -> None:
        self._sequence = _Sequence(packet.seq + 1, packet.t0_us)

    def _driver_restarted(self, packet: Packet) -> bool:
        sequence = self._sequence
        if packet.seq == 0 and packet.t0_us != sequence.first_t0_us:
            return True
        if sequence.rewind and packet.seq != sequence.rewind[-1] + 1:
            sequence.rewind.clear()
        sequence.rewind.append(packet.seq)
        if len(sequence.rewind) == REWIND_PACKETS:
            return True
        newest = (sequence.expected or 0) - 1
        self._count("duplicate_packets" if packet.seq == newest else "out_of_order_packets", 1)
        return False

    def _note_hole(self, until_us: int, lost: int) -> None:
        flags = {Flag.GAP} if lost else set()
        if Flag.OVERLOAD in self._pending:
            flags |= {Flag.OVERLOAD, Flag.GAP}
            self._pending.discard(Flag.OVERLOAD)
        horizon_us = self.lanes.horizon_us
        if horizon_us is not None and flags:
            self._holes.append(_Hole(horizon_us, until_us, frozenset(flags)))

    def _restart(self) -> None:
        """Forget the recurrent state and the open window: the next packet begins anew."""
        self.lanes.restart()
        self._holes.clear()
        self.counters.resets += 1

    def _look_at(self, packet: Packet) -> None:
        """Begin anew where the packet is of another sensor or another clock than those before."""
        if self.sensor != packet.sensor:
            if self.sensor is not None:
                log.warning("sensor changed", stream=self.name, before=str(self.sensor), now=str(packet.sensor))
                self._pending.add(Flag.SENSOR_CHANGED)
                self._restart()
            self.sensor = packet.sensor
        horizon_us = self.lanes.horizon_us
        if horizon_us is not None and packet.t0_us < horizon_us - CLOCK_RESET_US:
            log.warning("sensor clock went back", stream=self.name, by_us=horizon_us - packet.t0_us)
            self._restart()

    def _push(self, packet: Packet) -> Pushing:
        self._arrange(packet)
        try:
            return self.lanes.push(packet)
        except Unfit as unfit:
            assert self.lanes.front is not None
            self._slot.fault(self.lanes.front.serving, f"stream {self.name}: {unfit}")
            self._arrange(packet)
            return self.lanes.push(packet)

    def _arrange(self, packet: Packet) -> None:
        about = packet.sensor, self._camera_of(packet.sensor)
        self._count("skipped_windows", self.lanes.arrange(self._slot.roles(self.name), about, packet))

    def _camera_of(self, sensor: Sensor) -> CameraInfo | None:
        """The CameraInfo, if it is of this sensor."""
        return self.camera if self.camera is not None and self.camera.sensor == sensor else None

    @property
    def calibrated(self) -> bool:
        """Whether events go through a CameraInfo of their sensor."""
        return self.sensor is not None and self._camera_of(self.sensor) is not None

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
            flags=self._flags(window, serving),
            covariance=None if window.covariance is None else tuple(window.covariance.ravel().tolist()),
            trace=Trace(
                received_ns=arrival.received_ns, queued_ns=arrival.queued_ns, computed_ns=now_ns, published_ns=now_ns
            ),
        )
        self.counters.windows += 1
        self.counters.estimates += 1
        return estimate

    def _flags(self, window: WindowEstimate, serving: Serving) -> tuple[str, ...]:
        camera = self._camera_of(self.sensor) if self.sensor is not None else None
        conditions = {
            Flag.UNTRAINED: not serving.estimator.bundle.trained,
            Flag.UNCALIBRATED: camera is None,
            Flag.UNSCALED: camera is None or camera.height_m is None,
            Flag.RESET: window.first,
            Flag.SETTLING: not window.settled,
            Flag.LOW_ACTIVITY: window.low_activity,
            Flag.SATURATED: window.saturated,
            Flag.UNCERTAIN: window.uncertain,
        }
        flags = {flag for flag, holds in conditions.items() if holds} | self._pending
        self._pending.clear()
        for hole in self._holes:
            if hole.start_us < window.end_us and hole.end_us > window.start_us:
                flags |= hole.flags
        self._holes = [hole for hole in self._holes if hole.end_us > window.end_us]
        return tuple(flag.value for flag in Flag if flag in flags)
