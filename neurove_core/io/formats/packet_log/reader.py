"""Reader of NeuroVE recordings: it gives events, or the packets as published."""

import contextlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final, NamedTuple, Self, TypeVar

import numpy as np

from neurove_core.geometry.motion import Poses, Twists
from neurove_core.io.checked import cleaned, ordered, until_broken
from neurove_core.io.errors import BrokenRecording, UnknownSource
from neurove_core.io.faults import Faults, Reason, Tally
from neurove_core.io.format import Format
from neurove_core.io.formats.containers.mcap import McapFile, Record
from neurove_core.io.formats.packet_log import layout
from neurove_core.io.formats.packet_log.layout import PROFILE, BadColumns
from neurove_core.io.recording import EventsOnly, Frame, Triggers, later
from neurove_protocol.camera import CameraInfo
from neurove_protocol.errors import NeuroVEError
from neurove_protocol.events import EventPacket, Events, PacketLimits, Sensor, decode_packet
from neurove_protocol.imu import Imu

LIMITS: Final = PacketLimits(max_events=16_000_000, max_side_px=1 << 15)
"""Limits for packets. Each service sets its own wire limits, and a recording may come from any service."""

T = TypeVar("T")


class RecordedMessage(NamedTuple):
    """One message of a driver, as published."""

    stream: str
    kind: str  # events or imu
    payload: bytes
    log_ns: int  # as in RecordedPacket


class RecordedPacket(NamedTuple):
    """One event packet, as published."""

    stream: str
    payload: bytes
    log_ns: int  # receive time [unix ns]; in a converted recording the sensor time [ns]


@dataclass(frozen=True, slots=True)
class McapRecording(EventsOnly):
    """One stream of a NeuroVE recording; see `Recording`. Event times are those of the packets."""

    path: Path
    name: str
    sensor: Sensor
    stream: str
    file: McapFile
    endless: bool = False
    faults: Faults = field(default_factory=Faults, compare=False, repr=False)

    @classmethod
    def open(cls, path: Path, sensor: Sensor | None = None, topic: str | None = None) -> Self:
        """Open one stream of the file.

        Args:
            path: the .mcap file.
            sensor: the pixel array; overrides the one in the packets.
            topic: name of the stream. The default is the first stream by name; if the file has several, the recording's
                name gives the one that is read.

        Raises:
            UnknownSource: the file is not a NeuroVE recording, or it has no such stream, or the stream has no packet.
            BrokenRecording: the first packet is incomplete or invalid.
        """
        file = McapFile.open(path)
        streams = _streams(file)
        wanted = topic.removesuffix("/events") if topic is not None else None
        if not streams or wanted not in (None, *streams):
            why = (
                f"no stream {wanted!r}; its streams are {', '.join(streams)}"
                if streams
                else "the file has no stream of events"
            )
            raise UnknownSource(path, why)
        name = path.name if wanted is None else f"{path.name} ({wanted})"
        if wanted is None and len(streams) > 1:
            name = f"{path.name} ({streams[0]}, the first of {len(streams)} streams)"
        stream = wanted or streams[0]
        return cls(path, name, sensor or _sensor_of(path, file, stream), stream, file)

    @property
    def streams(self) -> tuple[str, ...]:
        """Names of the data that the file holds for this stream; the first is `events`."""
        kinds = ("imu", "frames", "triggers", "poses", "twists")
        return ("events", *(kind for kind in kinds if self._topic(kind) in self.file.topics))

    def chunks(self) -> Iterator[Events]:
        """Yield all events; see `Recording`. An invalid packet is skipped, and so is one of another sensor."""
        return self._cleaned(0)

    def since(self, t_us: int) -> Iterator[Events]:
        """Yield the events from this time [us] on, as `chunks` does. Bisects the index of the file."""
        chunks = self.file.chunks_of(self._topic("events"))
        low, high = 0, len(chunks)
        while high - low > 1:  # find the last chunk that begins before that time
            middle = (low + high) // 2
            first = self.file.first_in_chunk(self._topic("events"), chunks[middle])
            if first is None or _begins_us(_decoded(self.path, first)) < t_us:
                low = middle
            else:
                high = middle
        return later(self._cleaned(chunks[low] if chunks else 0), t_us)

    def _cleaned(self, first_chunk: int) -> Iterator[Events]:
        tally = self.faults.begin("events")
        return cleaned(self._pieces(first_chunk, tally), self.sensor, tally)

    def _pieces(self, first_chunk: int, tally: Tally) -> Iterator[tuple[str, Events]]:
        first: Sensor | None = None
        for record in self.file.records((self._topic("events"),), first_chunk, tally):
            try:
                packet = _decoded(self.path, record)
            except BrokenRecording as error:
                tally.add(Reason.DAMAGED, error.where, error.why)
                continue
            first = first or packet.sensor
            if packet.sensor == first:
                yield record.where, packet.events
            else:
                why = f"a packet has sensor {packet.sensor}, but the first packet has {first}"
                tally.add(Reason.INVALID, record.where, why)

    def packets(self, stream: str | None = None) -> Iterator[RecordedPacket]:
        """Yield the packets of one stream, or of all streams, in recorded order. They are not decoded or checked.

        Args:
            stream: name of the stream; None for all streams.

        Raises:
            BrokenRecording: the file is truncated or corrupt. It is raised after all complete packets.
        """
        streams = _streams(self.file) if stream is None else [stream]
        for record in self.file.records([f"{name}/events" for name in streams], tally=self.faults.begin("packets")):
            name = record.channel.topic.removesuffix("/events")
            yield RecordedPacket(name, record.data, record.log_ns)

    def has_imu(self, stream: str) -> bool:
        """Whether the file holds inertial samples of a stream."""
        return f"{stream}/imu" in self.file.topics

    def driven(self, stream: str | None = None) -> Iterator[RecordedMessage]:
        """Yield what the drivers of one stream, or of all streams, published in turn: event and IMU packets.

        Args:
            stream: name of the stream; None for all streams.

        Raises:
            BrokenRecording: as in `packets`.
        """
        streams = _streams(self.file) if stream is None else [stream]
        topics = [topic for name in streams for topic in (f"{name}/events", f"{name}/imu") if topic in self.file.topics]
        for record in self.file.records(topics, tally=self.faults.begin("packets")):
            name, _, kind = record.channel.topic.rpartition("/")
            yield RecordedMessage(name, kind, record.data, record.log_ns)

    @property
    def all_streams(self) -> tuple[str, ...]:
        """Names of all event streams in the file."""
        return tuple(_streams(self.file))

    def cameras(self) -> dict[str, bytes]:
        """Return the last CameraInfo of each stream that has one, as published bytes."""
        topics = [f"{name}/camera" for name in _streams(self.file)]
        present = [topic for topic in topics if topic in self.file.topics]
        found: dict[str, bytes] = {}
        with contextlib.suppress(BrokenRecording):  # reading the events counts it
            for record in self.file.records(present) if present else ():
                found[record.channel.topic.removesuffix("/camera")] = record.data
        return found

    def camera(self, stream: str) -> CameraInfo | None:
        """Return the lens that the driver of the stream published, or None.

        Args:
            stream: stream name for the result.
        """
        payload = self.cameras().get(self.stream)
        return (payload and CameraInfo(**(CameraInfo.decode(payload).model_dump() | {"stream": stream}))) or None

    def imu(self) -> Iterator[Imu]:
        """Yield the IMU samples, in the frame in which they were published or converted."""
        tally = self.faults.begin("imu")
        return ordered(self._tables("imu", tally), tally)

    def triggers(self) -> Iterator[Triggers]:
        """Yield the trigger edges of the converted recording."""
        tally = self.faults.begin("triggers")
        return ordered(self._tables("triggers", tally), tally)

    def frames(self) -> Iterator[Frame]:
        """Yield the images of the converted recording."""
        tally = self.faults.begin("frames")
        return (frame for _, frame in until_broken(self._messages("frames", layout.unpack_frame, tally), tally))

    def poses(self) -> Poses | None:
        """Return the poses of the converted recording, or None."""
        return self._joined("poses", Poses)

    def twists(self) -> Twists | None:
        """Return the twists of the converted recording, or None."""
        return self._joined("twists", Twists)

    def _topic(self, kind: str) -> str:
        return f"{self.stream}/{kind}"

    def _tables(self, kind: str, tally: Tally) -> Iterator[tuple[str, Any]]:
        return self._messages(kind, lambda data: layout.unpack_columns(kind, data), tally)

    def _joined(self, kind: str, table: Callable[..., T]) -> T | None:
        tally = self.faults.begin(kind)
        parts = list(ordered(self._tables(kind, tally), tally))
        return table(*(np.concatenate(columns) for columns in zip(*parts, strict=True))) if parts else None

    def _messages(self, kind: str, unpack: Callable[[bytes], T], tally: Tally) -> Iterator[tuple[str, T]]:
        topic = self._topic(kind)
        if topic not in self.file.topics:
            return
        chunks = self.file.chunks_of(topic)
        for record in self.file.records((topic,), chunks[0] if chunks else 0, tally):
            try:
                unpacked = unpack(record.data)
            except BadColumns as why:
                tally.add(Reason.DAMAGED, record.where, str(why))
            else:
                yield record.where, unpacked


def _streams(file: McapFile) -> list[str]:
    return sorted(topic.removesuffix("/events") for topic in file.topics if topic.endswith("/events"))


def _sensor_of(path: Path, file: McapFile, stream: str) -> Sensor:
    """The sensor of the first packet that can be decoded.

    Raises:
        UnknownSource: the stream has no packet. BrokenRecording: it has none that can be decoded.
    """
    bad: BrokenRecording | None = None
    for record in file.records((f"{stream}/events",)):
        try:
            return _decoded(path, record).sensor
        except BrokenRecording as error:
            bad = bad or error
    raise bad or UnknownSource(path, f"stream {stream} has no packet")


def _decoded(path: Path, record: Record) -> EventPacket:
    try:
        return decode_packet(record.data, LIMITS)
    except NeuroVEError as error:
        raise BrokenRecording(path, record.where, error.message) from None


def _begins_us(packet: EventPacket) -> int:
    return int(packet.events.t[0]) if packet.events.n else packet.t0_us


def _accepts(path: Path) -> bool:
    """Return whether the path is an MCAP file with the profile `neurove`."""
    return path.is_file() and McapFile.open(path).profile == PROFILE


FORMAT = Format(
    "FILE.mcap (NeuroVE, from `neurove record` and `neurove convert`)",
    McapRecording.open,
    (".mcap",),
    _accepts,
    rb"\x89MCAP0\r\n",
)
