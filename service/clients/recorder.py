"""Recording of live traffic: write event packets and CameraInfos, byte for byte, into one packet log."""

import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from typing import Any, Final, NamedTuple, TypeVar

from neurove_core.io.formats.packet_log.reader import LIMITS
from neurove_core.io.formats.packet_log.writer import PacketWriter
from neurove_protocol.errors import NeuroVEError
from neurove_protocol.events import EventPacket, decode_packet
from neurove_protocol.imu import ImuPacket, decode_imu
from neurove_protocol.keys import Keys
from neurove_service import logs
from neurove_service.transport import Transport

log = logs.get(__name__)

QUEUE_BYTES: Final = 64 << 20
"""Most bytes that wait to be written; a message that does not fit is dropped and counted."""

PacketT = TypeVar("PacketT", EventPacket, ImuPacket)

_ASK_S = 0.5
_POLL_S = 0.1


class _Message(NamedTuple):
    stream: str
    kind: str  # events, imu or camera
    payload: bytes
    received_ns: int  # monotonic clock


@dataclass
class StreamSummary:
    """Counts of one stream; packets are those in the file."""

    packets: int = 0
    events: int = 0
    bytes: int = 0
    missing: int = 0  # sequence numbers that no readable packet in the file has, for any reason
    dropped: int = 0  # by this recorder, because the disk was too slow; also counted in missing
    refused: int = 0  # packets that cannot be decoded; they are in the file too
    restarts: int = 0  # sequence numbers that are lower than expected
    imu_packets: int = 0  # of the inertial unit; its losses count as the others do
    samples: int = 0
    first_us: int | None = None
    last_us: int | None = None


@dataclass
class _Inbox:
    """Messages that were received and not yet written; filled on Zenoh's thread."""

    waiting: deque[_Message] = field(default_factory=deque)
    cap: int = QUEUE_BYTES
    size: int = 0
    dropped: dict[str, int] = field(default_factory=dict)
    lock: threading.Lock = field(default_factory=threading.Lock)
    filled: threading.Event = field(default_factory=threading.Event)

    def put(self, message: _Message) -> None:
        with self.lock:
            if self.size + len(message.payload) > self.cap:
                self.dropped[message.stream] = self.dropped.get(message.stream, 0) + 1
                return
            self.size += len(message.payload)
            self.waiting.append(message)
        self.filled.set()

    def take(self) -> list[_Message]:
        with self.lock:
            taken, self.size = list(self.waiting), 0
            self.waiting.clear()
            self.filled.clear()
        return taken


class Recorder:
    """Writes the streams of a deployment, from its construction on.

    Args:
        writer: an open packet log.
        transport: an open session.
        keys: keys of the deployment.
        streams: names of the streams; None for all.
        queue_bytes: most bytes that wait to be written.
    """

    def __init__(
        self,
        writer: PacketWriter,
        transport: Transport,
        keys: Keys,
        streams: tuple[str, ...] | None = None,
        queue_bytes: int = QUEUE_BYTES,
    ) -> None:
        self._writer, self._keys, self._streams = writer, keys, streams
        self._inbox = _Inbox(cap=queue_bytes)
        self._summaries: dict[str, StreamSummary] = {}
        self._next: dict[tuple[str, str], int] = {}  # stream and kind -> number of its next packet
        self._cameras: dict[str, bytes] = {}
        self._unix_ns = time.time_ns() - time.monotonic_ns()  # one clock for the whole file, which never jumps
        for stream in streams or ("*",):
            transport.subscribe(keys.events(stream), self._receiver("events"))
            transport.subscribe(keys.camera(stream), self._receiver("camera"))
            transport.subscribe(keys.imu(stream), self._receiver("imu"))
            for answer in transport.ask(
                keys.camera(stream), b"", _ASK_S
            ):  # of drivers that published before this subscription
                self._receiver("camera")(answer.key, answer.payload, time.monotonic_ns())

    def _receiver(self, kind: str) -> Callable[[str, bytes, int], None]:
        def on_sample(key: str, payload: bytes, received_ns: int) -> None:
            try:
                stream = self._keys.stream_of(key)
            except NeuroVEError:
                return  # no stream has such a name
            self._inbox.put(_Message(stream, kind, payload, received_ns))

        return on_sample

    def run(
        self,
        stop: threading.Event,
        duration_s: float,
        progress: Callable[[dict[str, StreamSummary]], None] | None = None,
    ) -> dict[str, StreamSummary]:
        """Write until the stop event or the duration, then write what has arrived until then.

        Args:
            stop: ends the recording.
            duration_s: longest recording [s].
            progress: called five to ten times per second.

        Returns:
            the counts, by stream.
        """
        deadline = time.monotonic() + duration_s
        while not stop.is_set() and time.monotonic() < deadline:
            self._inbox.filled.wait(_POLL_S)
            self._write()
            if progress:
                progress(self._summaries)
            stop.wait(_POLL_S)  # collects a burst into one turn
        self._write()
        return self._summaries

    def _write(self) -> None:
        for message in self._inbox.take():
            log_ns = message.received_ns + self._unix_ns
            if message.kind == "events":
                self._writer.write(message.stream, message.payload, log_ns)
                self._count(message)
            elif message.kind == "imu":
                self._writer.add(message.stream, "imu", message.payload, log_ns)
                self._count_samples(message)
            elif self._cameras.get(message.stream) != message.payload:
                self._cameras[message.stream] = message.payload
                self._writer.add(message.stream, "camera", message.payload, log_ns)
        for stream, dropped in self._inbox.dropped.copy().items():
            self._summary(stream).dropped = dropped

    def _summary(self, stream: str) -> StreamSummary:
        return self._summaries.setdefault(stream, StreamSummary())

    def _count(self, message: _Message) -> None:
        summary = self._summary(message.stream)
        summary.packets += 1
        packet = self._decoded(message, lambda data: decode_packet(data, LIMITS), summary)
        if packet is None:
            return
        summary.events += packet.events.n
        first_us = int(packet.events.t[0]) if packet.events.n else packet.t0_us
        summary.first_us = first_us if summary.first_us is None else summary.first_us
        summary.last_us = int(packet.events.t[-1]) if packet.events.n else packet.t0_us

    def _count_samples(self, message: _Message) -> None:
        summary = self._summary(message.stream)
        summary.imu_packets += 1
        packet = self._decoded(message, decode_imu, summary)
        if packet is not None:
            summary.samples += packet.samples.n

    def _decoded(self, message: _Message, decode: Callable[[bytes], PacketT], summary: StreamSummary) -> PacketT | None:
        """A packet, followed by its number; None if it is refused, which is counted."""
        summary.bytes += len(message.payload)
        try:
            packet = decode(message.payload)
        except NeuroVEError as error:
            if not summary.refused:
                log.warning("packet refused", stream=message.stream, why=error.message)
            summary.refused += 1
            return None
        self._follow(message, packet.seq, summary)
        return packet

    def _follow(self, message: _Message, seq: int, summary: StreamSummary) -> None:
        """Count the numbers that are missing before a packet."""
        key = message.stream, message.kind
        expected = self._next.get(key, seq)
        if seq > expected:
            summary.missing += seq - expected
        elif seq < expected:
            summary.restarts += 1
        self._next[key] = seq + 1


def as_json(summaries: dict[str, StreamSummary]) -> dict[str, Any]:
    """The counts as plain values for JSON."""
    return {stream: asdict(summary) for stream, summary in sorted(summaries.items())}
