"""Feed: the messages of one ROS camera -> the packets of one stream. Bytes in, bytes out; no network, no thread."""

import dataclasses
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from neurove_core.io.calibration import read_calibration
from neurove_core.io.faults import Tally
from neurove_core.io.formats.ros import messages, types
from neurove_core.io.formats.ros.events import Decoder
from neurove_core.io.formats.ros.messages import BadMessage, EventMessage
from neurove_core.io.formats.ros.types import CameraMessage, EventsMessage, ImuMessage
from neurove_core.io.packets import PACKET_EVENTS
from neurove_protocol import CameraInfo, EventPacket, Events, Sensor
from neurove_protocol.errors import InvalidField, NeuroVEError
from neurove_protocol.events import encode_packet
from neurove_service.ros2.clock import RosClock
from neurove_service.ros2.inertial import Inertial
from neurove_service.ros2.link import Received

MAX_LOST: Final = 100_000
"""A larger step of the message counter is another counter, not a loss."""

SECOND_PUBLISHER_NS: Final = 500_000_000
"""Of two publishers of a topic, the second one is followed after this silence of the first."""

_RESTART_US: Final = 1_000_000  # a larger step back is a new clock of the sensor
_TICK_MARGIN_US: Final = 50_000  # a message without events may report a time that is later by the jitter of the link
_SPAN_US: Final = 60_000  # of one packet
_TIME_BASE: Final = ("libcaer", "libcaer_cmp", "mono")  # encodings whose time base is the time of the message

Kind = Literal["events", "imu", "camera"]


def warm_up() -> None:
    """Compile the decoders, so that the first message of a camera does not wait for seconds."""
    for encoding in ("evt3", "evt2", "evt21", "libcaer_cmp"):
        list(Decoder().events(EventMessage(0, 1, 1, 0, 0, encoding, memoryview(bytes(8)))))


class Packet(NamedTuple):
    """A message to the service."""

    kind: Kind
    payload: bytes


@dataclass
class FeedCounts:
    """What came from ROS, since the start."""

    messages: int = 0  # of events
    events: int = 0
    packets: int = 0  # of events, to the service
    lost_messages: int = 0  # numbers that are missing in the counter of the messages
    dropped_messages: int = 0  # by this bridge, because it was too slow
    refused_messages: int = 0  # not valid, or of an encoding that is not supported
    other_type: int = 0  # messages of another type on a topic of ours
    foreign_messages: int = 0  # of a second publisher of the topic
    restarts: int = 0  # of the publisher
    resizes: int = 0  # changes of the sensor's size
    clock_resets: int = 0  # the sensor clock went back by more than 1 s
    outside_events: int = 0  # outside the sensor
    late_events: int = 0  # earlier than an event before
    reserved_words: int = 0  # of an unknown type, in Prophesee and libcaer_cmp data
    imu_samples: int = 0  # to the service
    ignored_imu: int = 0  # late, not finite, too large, or the axes are unknown
    cameras: int = 0  # different CameraInfos to the service


class Feed:
    """State of one camera.

    Args:
        stream: name of the stream.
        height_m: height of the camera above the ground [m].
        calibration: calibration file, instead of a camera_info.
        imu_axes: rotation (3, 3) from the axes of the inertial unit to the optical frame; None: known for libcaer only.
    """

    def __init__(
        self,
        stream: str,
        height_m: float | None = None,
        calibration: str | None = None,
        imu_axes: NDArray[np.float64] | None = None,
    ) -> None:
        self.counts, self.clock = FeedCounts(), RosClock()
        self.frame_id = ""  # of the newest events
        self.refusal = ""  # why the newest message was refused or ignored
        self.newest_ns: int | None = None  # when the newest events arrived, monotonic clock
        self._stream = stream
        self._calibration = calibration
        self._lens = _Lens(stream, height_m)
        self._sensor: Sensor | None = None
        self._encoding = ""
        self._tally = Tally("events")
        self._decoder = Decoder(tally=self._tally)
        self._follow = _Follow()
        self._inertial = Inertial(stream, imu_axes)
        self._seq = 0
        self._last_us: int | None = None

    def accept(self, received: Received) -> list[Packet]:
        """The packets that follow from a message; a message that is not valid is counted."""
        packets: list[Packet] = []
        before = self.counts.messages
        try:
            packets.extend(self._packets_of(received))  # keeps what precedes an error
        except (NeuroVEError, BadMessage) as error:
            self.counts.refused_messages += 1
            self.refusal = str(error)
            self._seq += self.counts.messages > before  # a gap for the service; without a number, the next one shows it
        return packets

    def _packets_of(self, received: Received) -> Iterator[Packet]:
        match received.type:
            case types.EVENTS:
                yield from self._events(types.decode(types.EVENTS, received.payload), received)
            case types.IMU:
                yield from self._imu(types.decode(types.IMU, received.payload))
            case types.CAMERA:
                yield from self._camera(types.decode(types.CAMERA, received.payload))
            case other:
                self.counts.other_type += 1
                self.refusal = f"a publisher of this topic sends the type {other[:200]}"

    def _events(self, ros: EventsMessage, received: Received) -> Iterator[Packet]:
        message, sensor = ros.message(), Sensor(ros.width, ros.height)
        follows, lost = self._follow.check(message.seq, received)
        if follows is _FOREIGN:
            self.counts.foreign_messages += 1
            return
        self.counts.messages += 1
        self.newest_ns, self.frame_id = received.received_ns, ros.header.frame_id
        if follows is _RESTARTED:
            self._restart()
        if lost:
            self.counts.lost_messages += lost
            self._seq += lost  # so that the service sees the gap
        if sensor != self._sensor:
            yield from self._resize(sensor)
        self._encoding = message.encoding
        stamp_ns = message.stamp_ns or received.unix_ns
        tidy = [self._tidy(part, sensor) for part in self._decoder.events(message)]
        self.counts.reserved_words = sum(fault.count for fault in self._tally.faults)
        events = Events.join([part for part in tidy if part.n])
        if events.n:
            self._learn(message, events, stamp_ns)
        yield from self._samples()
        yield from self._packets(events, sensor) if events.n else self._tick(stamp_ns, sensor)

    def _restart(self) -> None:
        """The publisher has begun anew: its counter, its decoder and the clock of its sensor."""
        self.counts.restarts += 1
        self._decoder = Decoder(tally=self._tally)
        self._new_clock()
        self._seq += 1

    def _new_clock(self) -> None:
        self.clock.forget()
        self._last_us = None
        self._inertial.forget()

    def _resize(self, sensor: Sensor) -> Iterator[Packet]:
        self.counts.resizes += self._sensor is not None
        self._sensor = sensor
        if self._calibration is not None:
            lens = read_calibration(self._calibration, sensor)
            yield from self._send_lens(lens)

    def _tidy(self, events: Events, sensor: Sensor) -> Events:
        """The events on the sensor whose times do not decrease."""
        if not events.n:
            return events
        inside = (events.x < sensor.width) & (events.y < sensor.height)
        if self._last_us is not None and int(events.t[0]) < self._last_us - _RESTART_US:
            self.counts.clock_resets += 1
            self._new_clock()
        newest = np.maximum.accumulate(events.t)
        ordered = events.t == newest if self._last_us is None else events.t >= np.maximum(newest, self._last_us)
        self.counts.outside_events += int(np.count_nonzero(~inside))
        self.counts.late_events += int(np.count_nonzero(inside & ~ordered))
        kept = inside & ordered
        if not kept.all():
            events = Events(events.t[kept], events.x[kept], events.y[kept], events.p[kept])
        if events.n:
            self._last_us = int(events.t[-1])
        return events

    def _learn(self, message: EventMessage, events: Events, stamp_ns: int) -> None:
        based = message.encoding in _TIME_BASE
        self.clock.learn(message.time_base_ns if based else events.first_us * 1000, stamp_ns)
        self.clock.advance(events.last_us)

    def _packets(self, events: Events, sensor: Sensor) -> Iterator[Packet]:
        first = 0
        while first < events.n:
            stop = min(
                first + PACKET_EVENTS, first + events.span(first, events.n).before(int(events.t[first]) + _SPAN_US)
            )
            part = events.span(first, stop)
            yield self._packet(part, int(part.t[0]), sensor)
            first = stop

    def _tick(self, stamp_ns: int, sensor: Sensor) -> Iterator[Packet]:
        """A message without events: the time goes on."""
        t_us = self.clock.sensor_us(stamp_ns)
        if t_us is not None and self._last_us is not None and t_us - _TICK_MARGIN_US > self._last_us:
            self._last_us = t_us - _TICK_MARGIN_US
            self.clock.advance(self._last_us)
            yield self._packet(Events.empty(), self._last_us, sensor)

    def _packet(self, events: Events, t0_us: int, sensor: Sensor) -> Packet:
        payload = encode_packet(EventPacket(self._stream, self._seq, sensor, t0_us, events))
        self._seq += 1
        self.counts.packets += 1
        self.counts.events += events.n
        return Packet("events", payload)

    def _imu(self, message: ImuMessage) -> Iterator[Packet]:
        if self._inertial.push(message):
            yield from self._samples()

    def _samples(self) -> Iterator[Packet]:
        payload = self._inertial.packet(self.clock, self._encoding)
        self.counts.imu_samples, self.counts.ignored_imu = self._inertial.sent, self._inertial.ignored
        self.refusal = self._inertial.refusal or self.refusal
        if payload is not None:
            yield Packet("imu", payload)

    def _camera(self, message: CameraMessage) -> Iterator[Packet]:
        if self._calibration is not None:
            return
        lens = messages.lens(message.width, message.height, message.distortion_model, message.d, message.k)
        if lens is None:
            why = "it is calibrated: k above 0, plumb_bob with 4 or 5 or equidistant with 4 coefficients"
            raise InvalidField(types.CAMERA, "distortion_model", message.distortion_model, why)
        yield from self._send_lens(lens)

    def _send_lens(self, lens: CameraInfo) -> Iterator[Packet]:
        payload = self._lens.changed(lens)
        if payload is not None:
            self.counts.cameras += 1
            yield Packet("camera", payload)

    def as_json(self) -> dict[str, int]:
        """The counts."""
        return dataclasses.asdict(self.counts)


class _Lens:
    """The CameraInfo of the stream, and whether it changed."""

    def __init__(self, stream: str, height_m: float | None) -> None:
        self._of_stream = {"stream": stream} | ({} if height_m is None else {"height_m": height_m})
        self._payload: bytes | None = None

    def changed(self, lens: CameraInfo) -> bytes | None:
        payload = CameraInfo(**(lens.model_dump() | self._of_stream)).encode()
        if payload == self._payload:
            return None
        self._payload = payload
        return payload


_FOLLOWS, _RESTARTED, _FOREIGN = "follows", "restarted", "foreign"


class _Follow:
    """Checks publisher and counter of the messages of a topic."""

    def __init__(self) -> None:
        self._publisher: bytes | None = None
        self._seq: int | None = None
        self._newest_ns = 0

    def check(self, seq: int, received: Received) -> tuple[str, int]:
        """Whether a message follows the one before, and how many messages are lost before it."""
        before, self._seq = self._seq, seq
        if before is None:
            return self._accept(received, _FOLLOWS), 0
        if received.publisher != self._publisher and received.received_ns - self._newest_ns < SECOND_PUBLISHER_NS:
            self._seq = before
            return _FOREIGN, 0
        if received.publisher != self._publisher or not before < seq <= before + MAX_LOST:
            return self._accept(received, _RESTARTED), 0
        return self._accept(received, _FOLLOWS), seq - before - 1

    def _accept(self, received: Received, order: str) -> str:
        self._publisher, self._newest_ns = received.publisher, received.received_ns
        return order
