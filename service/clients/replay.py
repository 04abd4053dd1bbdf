"""Replay of packet logs: publish the recorded packets bit for bit, paced by their sensor clock."""

import logging
import math
import threading
import time
from dataclasses import dataclass, field

from neurove_core.io import BrokenRecording
from neurove_core.io.formats.packet_log.reader import LIMITS, McapRecording, RecordedMessage, RecordedPacket
from neurove_core.io.order import MAX_GAP_US
from neurove_protocol.camera import SCHEMA as CAMERA_SCHEMA
from neurove_protocol.camera import CameraInfo
from neurove_protocol.errors import NeuroVEError
from neurove_protocol.events import SCHEMA as EVENTS_SCHEMA
from neurove_protocol.events import EventPacket, decode_packet
from neurove_protocol.imu import SCHEMA as IMU_SCHEMA
from neurove_protocol.imu import decode_imu
from neurove_protocol.keys import Keys
from neurove_service.clients.driver import PlaySummary
from neurove_service.clients.pace import Lag, OnBehind, ignore_behind
from neurove_service.clients.stream_output import POLL_S
from neurove_service.transport import Publisher, Transport

log = logging.getLogger(__name__)


@dataclass
class Pace:
    """When the packets of each stream are due; each stream has its own clock, and clocks are not compared."""

    speed: float
    began: float = 0.0  # monotonic clock [s]
    first_log_ns: int | None = None
    clocks: dict[str, tuple[float, int, int]] = field(default_factory=dict)  # origin [s], its sensor time, newest [us]

    def due(self, recorded: RecordedPacket, packet: EventPacket) -> tuple[float, float]:
        """When a packet is due on the monotonic clock [s], and the sensor time since its stream began [s]."""
        t_us = int(packet.events.t[-1]) + 1 if packet.events.n else packet.t0_us
        if self.first_log_ns is None:
            self.began, self.first_log_ns = time.monotonic(), recorded.log_ns
        if recorded.stream not in self.clocks:  # keep the recorded delay after the first stream
            later_s = max(0, recorded.log_ns - self.first_log_ns) / 1e9 / self.speed
            self.clocks[recorded.stream] = (self.began + later_s, packet.t0_us, t_us)
        origin, first_us, newest_us = self.clocks[recorded.stream]
        if packet.t0_us < first_us or t_us < newest_us - 1_000_000:  # the driver was restarted
            origin, first_us = time.monotonic(), packet.t0_us
        elif packet.t0_us - newest_us > MAX_GAP_US:
            log.warning("gap skipped: stream=%s seconds=%.1f", recorded.stream, (packet.t0_us - newest_us) / 1e6)
            first_us += packet.t0_us - newest_us
        self.clocks[recorded.stream] = (origin, first_us, t_us)
        elapsed_s = (t_us - first_us) / 1e6
        return origin + elapsed_s / self.speed, elapsed_s


class Replay:
    """Publishes the packets of a packet log under the stream names in it.

    Args:
        recording: the packet log.
        only: name of the stream to publish; None for all streams.
        transport: an open session.
        keys: keys of the deployment.
        lens: announced for every stream instead of the recorded ones.
    """

    def __init__(
        self,
        recording: McapRecording,
        only: str | None,
        transport: Transport,
        keys: Keys,
        lens: CameraInfo | None = None,
    ) -> None:
        self._recording, self._only = recording, only
        self._transport, self._keys = transport, keys
        names = [only] if only else recording.all_streams
        self._publishers: dict[str, Publisher] = {
            name: transport.publisher(keys.events(name), EVENTS_SCHEMA) for name in names
        }
        self._imu_publishers: dict[str, Publisher] = {
            name: transport.publisher(keys.imu(name), IMU_SCHEMA) for name in names if recording.has_imu(name)
        }
        cameras = recording.cameras() if lens is None else {name: _named(lens, name) for name in names}
        for name, payload in cameras.items():
            if name in self._publishers:
                self._announce(keys.camera(name), payload)

    def _announce(self, key: str, payload: bytes) -> None:
        self._transport.answer(key, lambda _: payload)
        self._transport.put(key, payload, CAMERA_SCHEMA)

    @property
    def label(self) -> str:
        """Names of the streams, for messages."""
        return ", ".join(self._publishers)

    def wait_for_listener(self, timeout_s: float, stop: threading.Event) -> bool:
        """Wait until every stream has a subscriber.

        Returns:
            whether that happened before the timeout and the stop event.
        """
        deadline = time.monotonic() + timeout_s
        while not all(publisher.matching for publisher in self._publishers.values()):
            if time.monotonic() >= deadline or stop.wait(POLL_S):
                return False
        return True

    def play(
        self,
        stop: threading.Event,
        *,
        speed: float = 1.0,
        loop: bool = False,
        duration_s: float = math.inf,
        on_behind: OnBehind = ignore_behind,
    ) -> PlaySummary:
        """Publish the packets until the end, the duration, or the stop event.

        A packet that cannot be decoded is published at once, in its recorded order.

        Args:
            stop: ends the playback early.
            speed: sensor seconds per second; infinity publishes as fast as the recording is read.
            loop: must be False, because sequence numbers and times would repeat.
            duration_s: sensor time to play [s].
            on_behind: called once if this machine cannot keep up.

        Raises:
            ValueError: `loop` is true.
        """
        if loop:
            raise ValueError("a replay cannot loop")
        sent = PlaySummary(0, 0, None, None, None)
        pace, lag = Pace(speed), Lag(speed, on_behind)
        try:
            for message in self._recording.driven(self._only):
                if message.kind == "imu":
                    sent = sent._replace(samples=sent.samples + self._send_samples(message))
                    continue
                recorded = RecordedPacket(message.stream, message.payload, message.log_ns)
                packet = _read(recorded)
                if packet is not None:
                    due, elapsed_s = pace.due(recorded, packet)
                    if elapsed_s > duration_s or stop.wait(max(0.0, due - time.monotonic())):
                        break
                    first_us = packet.t0_us if sent.first_us is None else sent.first_us
                    last_us = int(packet.events.t[-1]) if packet.events.n else sent.last_us
                    sent = sent._replace(events=sent.events + packet.events.n, first_us=first_us, last_us=last_us)
                    lag.sent(due, elapsed_s)
                self._publishers[recorded.stream].put(recorded.payload, sent_us=time.monotonic_ns() // 1000)
                sent = sent._replace(packets=sent.packets + 1, behind_s=lag.most_s)
        except BrokenRecording as error:
            return sent._replace(broken=error)
        return sent

    def _send_samples(self, message: RecordedMessage) -> int:
        """Publish an IMU packet in its recorded order; return its number of samples.

        Older files of `neurove convert` hold samples without stream and number, which are not sent.
        """
        try:
            n = decode_imu(message.payload).samples.n
        except NeuroVEError:
            return 0
        self._imu_publishers[message.stream].put(message.payload)
        return n


def _named(lens: CameraInfo, stream: str) -> bytes:
    return CameraInfo(**(lens.model_dump() | {"stream": stream})).encode()


def _read(recorded: RecordedPacket) -> EventPacket | None:
    try:
        return decode_packet(recorded.payload, LIMITS)
    except NeuroVEError:
        return None
