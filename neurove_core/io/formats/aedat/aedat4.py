"""AEDAT4 files of DV: compressed packets of events, inertial samples, frames and triggers."""

import re
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import BinaryIO, NamedTuple, Self, TypeVar

import numpy as np

from neurove_core.io.axes import optical_samples
from neurove_core.io.checked import as_recorded, cleaned, ordered, until_broken
from neurove_core.io.errors import BrokenRecording, MissingGeometry, UnknownSource
from neurove_core.io.faults import Faults, Reason, Tally
from neurove_core.io.format import Format
from neurove_core.io.formats.aedat.flatbuffer import MAX_PACKET_BYTES, BadPacket, events_of, frame_of, tables_of
from neurove_core.io.formats.aedat.header import MAX_HEADER_BYTES, PACKET_HEADER, BadHeader, Stream, parse_header
from neurove_core.io.recording import BLOCK_BYTES, EventsOnly, Frame, Triggers
from neurove_protocol.events import Events, Sensor
from neurove_protocol.imu import Imu

_MAGIC = b"#!AER-DAT4.0\r\n"
_PACKET_START = re.compile(rb"\x04\x22\x4d\x18|\x28\xb5\x2f\xfd|(?<=.{8})(?:EVTS|IMUS|TRIG|FRME)", re.DOTALL)
"""First bytes of compressed content, or the identifier at byte 8 of uncompressed content."""

EXTERNAL, GENERATOR, READOUT, EXPOSURE = range(4)
"""Channels of the triggers: the camera's input, its generator, and the readout and exposure of a frame."""

_T = (0, "<i8")  # field of a time in the table of an inertial sample or a trigger
_UNITS = tuple((field, "<f4") for field in range(2, 8))  # accelerometer x y z, gyroscope x y z
_EDGES = {  # source in the file -> channel and level; a pulse is one rising edge
    1: (EXTERNAL, 1),
    2: (EXTERNAL, 0),
    3: (EXTERNAL, 1),
    4: (GENERATOR, 1),
    5: (GENERATOR, 0),
    6: (READOUT, 1),
    7: (READOUT, 0),
    8: (EXPOSURE, 1),
    9: (EXPOSURE, 0),
}

T = TypeVar("T")


class _Header(NamedTuple):
    streams: list[Stream]
    start: int  # byte of the first packet
    end: int  # byte after the last packet; -1 if the recorder did not write it


class _Packet(NamedTuple):
    start: int  # byte of its header in the file
    stream: int
    stop: int  # byte after it


@dataclass(frozen=True, slots=True)
class Aedat4Recording(EventsOnly):
    """One camera of an .aedat4 file; see `Recording`.

    Of several streams of one kind it reads that of the same camera, otherwise the one with the lowest number.
    """

    path: Path
    name: str
    sensor: Sensor
    numbers: Mapping[str, int]  # stream number by kind, for the kinds in the file
    endless: bool = False
    faults: Faults = field(default_factory=Faults, compare=False, repr=False)

    @classmethod
    def open(cls, path: Path, sensor: Sensor | None = None, topic: str | None = None) -> Self:
        """Open one camera of this file.

        Args:
            path: the .aedat4 file.
            sensor: its pixel array, which takes precedence over the size in the file.
            topic: number of the event stream; the default is the lowest.

        Raises:
            UnknownSource: the file is not AEDAT4, has no event stream, or has no event stream of this number.
            MissingGeometry: its event stream has no valid sensor size.
            BrokenRecording: its header is truncated or corrupt.
        """
        with path.open("rb") as file:
            if not _MAGIC.startswith(file.read(len(_MAGIC))):
                raise UnknownSource(path, "the file does not begin with the AEDAT4 signature")
            streams = _read_header(path, file).streams
        cameras = {str(stream.number): stream for stream in streams if stream.kind == "events"}
        if not cameras:
            raise UnknownSource(path, "the file has no event stream")
        if topic not in (None, *cameras):
            raise UnknownSource(path, f"it has no event stream {topic!r}; its event streams are {', '.join(cameras)}")
        chosen = cameras[topic] if topic is not None else next(iter(cameras.values()))
        sensor = sensor or chosen.sensor
        if sensor is None:
            raise MissingGeometry(path)
        name = path.name
        if topic is not None:
            name = f"{path.name} (stream {topic})"
        elif len(cameras) > 1:
            name = f"{path.name} (stream {chosen.number}, the first of {len(cameras)} event streams)"
        by_kind = sorted(streams, key=lambda stream: (stream.source == chosen.source, -stream.number))
        numbers = {stream.kind: stream.number for stream in by_kind} | {"events": chosen.number}
        return cls(path, name, sensor, numbers)

    @property
    def streams(self) -> tuple[str, ...]:
        """The streams in the header."""
        return tuple(kind for kind in ("events", "imu", "frames", "triggers") if kind in self.numbers)

    def chunks(self) -> Iterator[Events]:
        """All events from the beginning; see `Recording`. Times are Unix time [us]. Other streams are skipped."""
        tally = self.faults.begin("events")
        return cleaned(self._decoded("events", decode_events, tally), self.sensor, tally)

    def imu(self) -> Iterator[Imu]:
        """All samples in the optical frame; see `Recording` and `axes.OPTICAL`. DV writes deg/s and g."""
        tally = self.faults.begin("imu")
        return ordered(self._decoded("imu", decode_imu, tally), tally)

    def triggers(self) -> Iterator[Triggers]:
        """All edges; see `Recording`. DV writes edges of the camera's input (channel EXTERNAL) and also of the frames.

        The edges of a packet are sorted by time. Entries for a reset of the clock are skipped.
        """
        tally = self.faults.begin("triggers")
        return ordered(self._decoded("triggers", _triggers_of, tally), tally)

    def frames(self) -> Iterator[Frame]:
        """All images; see `Recording`. A frame smaller than the sensor is not padded. A late one is skipped."""
        tally = self.faults.begin("frames")
        last_us: int | None = None
        for where, (t_us, image) in until_broken(self._decoded("frames", frame_of, tally), tally):
            if last_us is not None and t_us < last_us:
                tally.add(Reason.LATE, where, f"t={t_us} us comes after t={last_us} us: time runs backwards")
            else:
                last_us = t_us
                yield Frame(t_us, np.ascontiguousarray(image))

    def _decoded(self, kind: str, decode: Callable[[bytes], T], tally: Tally) -> Iterator[tuple[str, T]]:
        """The place and the content of each packet of a kind. A packet that cannot be decoded is skipped."""
        wanted = self.numbers.get(kind)
        if wanted is None:
            return
        with self.path.open("rb") as file:
            for packet in self._packets(file, tally):
                if packet.stream != wanted:
                    continue
                where = f"byte {packet.start}"
                file.seek(packet.start + PACKET_HEADER.size)
                try:
                    content = decode(file.read(packet.stop - packet.start - PACKET_HEADER.size))
                except BadPacket as why:
                    tally.add(Reason.DAMAGED, where, f"this packet cannot be read: {why}")
                else:
                    yield where, content

    def _packets(self, file: BinaryIO, tally: Tally) -> Iterator[_Packet]:
        """The place of each packet. Where the header of a packet is corrupt, the next packet is searched."""
        streams, at, end = _read_header(self.path, file)
        numbers = {stream.number for stream in streams}
        size = file.seek(0, 2)
        while at != end and not (end < 0 and at == size):  # the recorder stopped between two packets
            packet = _packet(file, at, size)
            if packet is not None and packet.stream in numbers:
                yield packet
                at = packet.stop
                continue
            after = _next_packet(file, at + 1, size, numbers)
            if after is None:
                raise BrokenRecording(self.path, f"byte {at}", f"the file ends at byte {size}, before its packets do")
            tally.add(Reason.DAMAGED, f"byte {at}", f"no packet begins here; the next one begins at byte {after.start}")
            at = after.start


def decode_events(packet: bytes) -> Events:
    """Events of a packet, as they were recorded; see `checked.as_recorded`.

    Raises:
        BadPacket: the packet is corrupt.
    """
    rows = events_of(packet)
    return as_recorded(rows["t"], rows["x"], rows["y"], rows["p"] > 0)


def decode_imu(packet: bytes) -> Imu:
    """Inertial samples of a packet in the optical frame; see `axes.OPTICAL`.

    Raises:
        BadPacket: the packet is corrupt.
    """
    t, *numbers = tables_of(packet, b"IMUS", (_T, *_UNITS))
    values = np.stack(numbers, -1).astype(np.float64)
    return optical_samples(t, values[:, :3], values[:, 3:])


def _triggers_of(packet: bytes) -> Triggers:
    t, source = tables_of(packet, b"TRIG", (_T, (1, "<i1")))
    order = np.argsort(t, kind="stable")
    order = order[np.isin(source[order], list(_EDGES))]
    edges = np.array([_EDGES[int(one)] for one in source[order]], np.uint8).reshape(-1, 2)
    return Triggers(t[order], edges[:, 0].copy(), edges[:, 1].copy())


def _read_header(path: Path, file: BinaryIO) -> _Header:
    """The streams, and the bytes where the packets begin and end.

    Raises:
        BrokenRecording: the header is truncated or corrupt.
    """
    file.seek(len(_MAGIC))
    start = len(_MAGIC) + 4
    length = int.from_bytes(file.read(4), "little")
    header = file.read(min(length, MAX_HEADER_BYTES))
    if len(header) < max(length, 4):
        raise BrokenRecording(path, f"byte {start + len(header)}", "the file ends within its header")
    try:
        streams, end = parse_header(header)
    except BadHeader as error:
        raise BrokenRecording(path, f"byte {start}", f"the header cannot be read: {error}") from None
    return _Header(streams, start + length, end)


def _packet(file: BinaryIO, at: int, size: int) -> _Packet | None:
    """The packet that begins at byte `at`, or None if no packet that fits into the file of `size` bytes does."""
    file.seek(at)
    header = file.read(PACKET_HEADER.size)
    if len(header) < PACKET_HEADER.size:
        return None
    stream, length = PACKET_HEADER.unpack(header)
    stop = at + PACKET_HEADER.size + length
    return _Packet(at, stream, stop) if 0 <= length <= MAX_PACKET_BYTES and stop <= size else None


def _next_packet(file: BinaryIO, at: int, size: int, streams: set[int]) -> _Packet | None:
    """The first packet of a known stream from byte `at` on that begins as packets do; None without one."""
    while at < size:
        file.seek(at)
        block = file.read(BLOCK_BYTES)
        for match in _PACKET_START.finditer(block):
            content = match.start() - (8 if match.group()[:1].isalpha() else 0)
            packet = _packet(file, at + content - PACKET_HEADER.size, size) if content >= PACKET_HEADER.size else None
            if packet is not None and packet.stream in streams:
                return packet
        if at + len(block) >= size:
            return None
        at += len(block) - 32  # the first bytes of a packet may lie across two blocks
    return None


FORMAT = Format("FILE.aedat4 (DV)", Aedat4Recording.open, (".aedat4",), signature=b"#!AER-DAT4")
