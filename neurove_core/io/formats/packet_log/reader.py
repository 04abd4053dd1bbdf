"""Reading our own recordings: as events, and as the packets that they hold."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, NamedTuple, Self, TypeVar

import numpy as np

from neurove_core.geometry.motion import Poses, Twists
from neurove_core.io.checked import checked
from neurove_core.io.errors import BrokenRecording, UnknownSource
from neurove_core.io.format import Format
from neurove_core.io.formats.containers.mcap import McapFile, Record
from neurove_core.io.formats.packet_log import layout
from neurove_core.io.formats.packet_log.layout import PROFILE, BadColumns
from neurove_core.io.recording import EventsOnly, Frame, Imu, Triggers, later
from neurove_protocol.camera import CameraInfo
from neurove_protocol.errors import NeuroVEError
from neurove_protocol.events import EventPacket, Events, PacketLimits, Sensor, decode_packet

LIMITS: Final = PacketLimits(max_events=16_000_000, max_side_px=1 << 15)
"""Caps on packets: those of the wire are the service's to set, and a recording may come from any."""

T = TypeVar("T")


class RecordedPacket(NamedTuple):
    """One event packet as it was published."""

    stream: str
    payload: bytes
    log_ns: int  # when it was received [unix ns]; where it was converted, the sensor's time [ns]


@dataclass(frozen=True, slots=True)
class McapRecording(EventsOnly):
    """One stream of a recording of ours; see `Recording`. Times are as in its packets."""

    path: Path
    name: str
    sensor: Sensor
    stream: str
    file: McapFile
    endless: bool = False

    @classmethod
    def open(cls, path: Path, sensor: Sensor | None = None, topic: str | None = None) -> Self:
        """One stream of the file.

        Args:
            path: the .mcap file.
            sensor: the pixel array; overrides the packets'.
            topic: name of the stream; by default the first one by name, and the recording's name tells which.

        Raises:
            UnknownSource: it is no recording of ours, or has no such stream or no packet of it.
            BrokenRecording: not even its first packet is whole.
        """
        file = McapFile.open(path)
        streams = _streams(file)
        wanted = topic.removesuffix("/events") if topic is not None else None
        if not streams or wanted not in (None, *streams):
            why = f"no stream {wanted!r}; its streams are {', '.join(streams)}" if streams else "it holds no stream"
            raise UnknownSource(path, why)
        name = path.name if wanted is None else f"{path.name} ({wanted})"
        if wanted is None and len(streams) > 1:
            name = f"{path.name} ({streams[0]}, the first of {len(streams)} streams)"
        stream = wanted or streams[0]
        first = next(file.records((f"{stream}/events",)), None)
        if first is None:
            raise UnknownSource(path, f"its stream {stream} has no packet")
        return cls(path, name, sensor or _decoded(path, first).sensor, stream, file)

    @property
    def streams(self) -> tuple[str, ...]:
        """Events, and what else the file has of this stream."""
        kinds = ("imu", "frames", "triggers", "poses", "twists")
        return ("events", *(kind for kind in kinds if self._topic(kind) in self.file.topics))

    def chunks(self) -> Iterator[Events]:
        """All events from the beginning; see `Recording`.

        Raises:
            BrokenRecording: the file is cut or garbled, or a packet is not what it must be, of another sensor than the
                first, or earlier than the one before it; it names the byte.
        """
        return checked(self.path, self._pieces(0), self.sensor)

    def since(self, t_us: int) -> Iterator[Events]:
        """As `chunks`, from this time on; by bisection of the file's index."""
        chunks = self.file.chunks_of(self._topic("events"))
        low, high = 0, len(chunks)
        while high - low > 1:  # the last chunk that begins before that time
            middle = (low + high) // 2
            first = self.file.first_in_chunk(self._topic("events"), chunks[middle])
            if first is None or _begins_us(_decoded(self.path, first)) < t_us:
                low = middle
            else:
                high = middle
        return later(checked(self.path, self._pieces(chunks[low] if chunks else 0), self.sensor), t_us)

    def _pieces(self, first_chunk: int) -> Iterator[tuple[str, Events]]:
        first: EventPacket | None = None
        for record in self.file.records((self._topic("events"),), first_chunk):
            packet = _decoded(self.path, record)
            first = first or packet
            if packet.sensor != first.sensor:
                why = f"a packet of a sensor {packet.sensor}, after those of {first.sensor}"
                raise BrokenRecording(self.path, record.where, why)
            yield record.where, packet.events

    def packets(self, stream: str | None = None) -> Iterator[RecordedPacket]:
        """The packets of all streams, or of one, in the order recorded, bit for bit and not looked at.

        Raises:
            BrokenRecording: the file is cut or garbled; after everything whole was handed out.
        """
        streams = _streams(self.file) if stream is None else [stream]
        for record in self.file.records([f"{name}/events" for name in streams]):
            name = record.channel.topic.removesuffix("/events")
            yield RecordedPacket(name, record.data, record.log_ns)

    @property
    def all_streams(self) -> tuple[str, ...]:
        """Names of all streams in the file that have packets."""
        return tuple(_streams(self.file))

    def cameras(self) -> dict[str, bytes]:
        """The last CameraInfo of each stream that has one, bit for bit."""
        topics = [f"{name}/camera" for name in _streams(self.file)]
        present = [topic for topic in topics if topic in self.file.topics]
        found = self.file.records(present) if present else ()
        return {record.channel.topic.removesuffix("/camera"): record.data for record in found}

    def camera(self, stream: str) -> CameraInfo | None:
        """The lens as the stream's driver told it, or None where it did not."""
        payload = self.cameras().get(self.stream)
        return (payload and CameraInfo(**(CameraInfo.decode(payload).model_dump() | {"stream": stream}))) or None

    def imu(self) -> Iterator[Imu]:
        """Samples of the inertial unit, as the converted recording had them."""
        return self._tables("imu")

    def triggers(self) -> Iterator[Triggers]:
        """Trigger edges, as the converted recording had them."""
        return self._tables("triggers")

    def frames(self) -> Iterator[Frame]:
        """Images, as the converted recording had them."""
        return self._messages("frames", layout.unpack_frame)

    def poses(self) -> Poses | None:
        """Poses, as the converted recording had them."""
        return self._joined("poses", Poses)

    def twists(self) -> Twists | None:
        """Twists, as the converted recording had them."""
        return self._joined("twists", Twists)

    def _topic(self, kind: str) -> str:
        return f"{self.stream}/{kind}"

    def _tables(self, kind: str) -> Iterator[Any]:
        return self._messages(kind, lambda data: layout.unpack_columns(kind, data))

    def _joined(self, kind: str, table: Callable[..., T]) -> T | None:
        parts = list(self._tables(kind))
        return table(*(np.concatenate(columns) for columns in zip(*parts, strict=True))) if parts else None

    def _messages(self, kind: str, unpack: Callable[[bytes], T]) -> Iterator[T]:
        topic = self._topic(kind)
        if topic not in self.file.topics:
            return
        chunks = self.file.chunks_of(topic)
        for record in self.file.records((topic,), chunks[0] if chunks else 0):
            try:
                yield unpack(record.data)
            except BadColumns as why:
                raise BrokenRecording(self.path, record.where, str(why)) from None


def _streams(file: McapFile) -> list[str]:
    return sorted(topic.removesuffix("/events") for topic in file.topics if topic.endswith("/events"))


def _decoded(path: Path, record: Record) -> EventPacket:
    try:
        return decode_packet(record.data, LIMITS)
    except NeuroVEError as error:
        raise BrokenRecording(path, record.where, error.message) from None


def _begins_us(packet: EventPacket) -> int:
    return int(packet.events.t[0]) if packet.events.n else packet.t0_us


def _accepts(path: Path) -> bool:
    """Whether this is an .mcap file with our profile."""
    return path.is_file() and McapFile.open(path).profile == PROFILE


FORMAT = Format(
    "FILE.mcap (our own, from `neurove record` and `neurove convert`)", McapRecording.open, (".mcap",), _accepts
)
