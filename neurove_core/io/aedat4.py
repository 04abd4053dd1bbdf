"""AEDAT4 files of DV: compressed packets of several streams; the event stream is read, by the `aedat` package."""

import struct
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple, Self, TypeVar

import aedat

from neurove_core.io.errors import BrokenRecording, MissingGeometry, UnknownSource
from neurove_core.io.recording import SUPPORTED, EventsOnly, in_chunks, whole
from protocol.errors import EventOutsideSensor, InvalidField, TimeBackwards
from protocol.events import Events, Sensor, check_events

_MAGIC = b"#!AER-DAT4.0\r\n"
MAX_HEADER_BYTES = 16 << 20  # a header has some 3,000 bytes
_PACKET_HEADER = struct.Struct("<ii")  # stream, size of what follows [bytes]

T = TypeVar("T")


class _Fault(Exception):
    """The decoder can not go on."""


class _Packet(NamedTuple):
    start: int  # byte of its header in the file
    stream: int
    stop: int  # byte after it


@dataclass(frozen=True, slots=True)
class Aedat4Recording(EventsOnly):
    """An .aedat4 file; see `Recording`. Of several event streams it is the one with the lowest number."""

    path: Path
    name: str
    sensor: Sensor
    stream_id: int
    endless: bool = False

    @classmethod
    def open(cls, path: Path, sensor: Sensor | None = None) -> Self:
        """The recording in this file.

        Args:
            path: the .aedat4 file.
            sensor: its pixel array; overrides the file's.

        Raises:
            UnknownSource: the file is not AEDAT4, or has no event stream.
            MissingGeometry: its event stream has no size that a sensor could have.
            BrokenRecording: its header is not whole.
        """
        with path.open("rb") as file:
            if not _MAGIC.startswith(file.read(len(_MAGIC))):
                raise UnknownSource(path, SUPPORTED, "the file does not begin as AEDAT4 does")
            _read_header(path, file)
        try:
            streams = _guarded(lambda: aedat.Decoder(path).id_to_stream())
        except _Fault as fault:
            raise BrokenRecording(path, f"byte {len(_MAGIC)}", f"the header can not be read: {fault}") from None
        ids = sorted(key for key, stream in streams.items() if stream["type"] == "events")
        if not ids:
            raise UnknownSource(path, SUPPORTED, "the file has no event stream")
        try:
            sensor = sensor or Sensor(streams[ids[0]]["width"], streams[ids[0]]["height"])
        except InvalidField:
            raise MissingGeometry(path) from None
        name = path.name if len(ids) == 1 else f"{path.name} (stream {ids[0]}, the first of {len(ids)} event streams)"
        return cls(path, name, sensor, ids[0])

    def chunks(self) -> Iterator[Events]:
        """All events from the beginning; see `Recording`. Times are unix time [us]; other streams are skipped.

        Raises:
            BrokenRecording: a packet is cut or garbled, or an event is outside the sensor or earlier than the one
                before it; it names the byte where that packet begins.
        """
        not_before_us = None
        for start, records in self._event_packets():
            events = Events.from_records(records)
            try:
                check_events(events, self.sensor, not_before_us)
            except (EventOutsideSensor, TimeBackwards) as error:
                yield from in_chunks(whole(events, self.sensor, not_before_us))
                raise BrokenRecording(self.path, f"byte {start}", f"in this packet, {error.message}") from None
            yield from in_chunks(events)
            not_before_us = int(events.t[-1]) if events.n else not_before_us

    def _event_packets(self) -> Iterator[tuple[int, Any]]:
        """Where in the file each packet of the event stream begins, and its records (N,).

        The decoder tells neither where it stands nor where it failed, and believes every length; so the packet headers
        are walked and checked ahead of it.
        """
        with self.path.open("rb") as file:
            at, end = _read_header(self.path, file)
            size = file.seek(0, 2)
            decoder = _guarded(lambda: aedat.Decoder(self.path))
            while at != end:
                if _packet(file, at, size) is None:
                    if end < 0 and at == size:  # the recorder was stopped between two packets
                        return
                    raise BrokenRecording(
                        self.path, f"byte {at}", f"the file ends at byte {size}, before its packets do"
                    )
                try:
                    decoded = _guarded(lambda: next(decoder, None))
                except _Fault as fault:
                    raise BrokenRecording(self.path, f"byte {at}", f"this packet can not be read: {fault}") from None
                packet = decoded and _find(file, at, size, decoded["stream_id"])
                if not decoded or not packet:  # only frames were left, of a kind that the decoder passes over
                    return
                at = packet.stop
                if packet.stream == self.stream_id:
                    yield packet.start, decoded["events"]


def _read_header(path: Path, file: BinaryIO) -> tuple[int, int]:
    """The bytes where the packets begin and where they end, -1 where the recorder came not to write that.

    The text of the header is checked too: on bytes that are no UTF-8 the decoder ends the whole process.

    Raises:
        BrokenRecording: the header is not whole.
    """
    file.seek(len(_MAGIC))
    start = len(_MAGIC) + 4
    length = int.from_bytes(file.read(4), "little")
    header = file.read(min(length, MAX_HEADER_BYTES))
    if len(header) < max(length, 4):
        raise BrokenRecording(path, f"byte {start + len(header)}", "the file ends within its header")
    try:
        # a flatbuffer: a table of fields, and in front of it their places, 0 for a field that has its default
        (table,) = struct.unpack_from("<I", header)
        fields = table - struct.unpack_from("<i", header, table)[0]
        known, _, _, position, text = struct.unpack_from("<5H", header, fields)
        end = struct.unpack_from("<q", header, table + position)[0] if known >= 8 and position else -1
        text += table
        text += struct.unpack_from("<I", header, text)[0]
        (characters,) = struct.unpack_from("<I", header, text)
        struct.unpack_from(f"{characters}s", header, text + 4)[0].decode()
    except (struct.error, UnicodeDecodeError) as error:
        raise BrokenRecording(path, f"byte {start}", f"the header can not be read: {error}") from None
    return start + length, end


def _guarded(call: Callable[[], T]) -> T:
    """What the decoder answers; whatever it throws over its data becomes _Fault."""
    try:
        return call()
    except BaseException as error:  # a Rust panic is no Exception, and its class can not be imported
        if not isinstance(error, Exception) and type(error).__name__ != "PanicException":
            raise
        raise _Fault(str(error)) from None


def _packet(file: BinaryIO, at: int, size: int) -> _Packet | None:
    """The packet that begins at this byte, if it ends within the file."""
    file.seek(at)
    header = file.read(_PACKET_HEADER.size)
    if len(header) < _PACKET_HEADER.size:
        return None
    stream, length = _PACKET_HEADER.unpack(header)
    stop = at + _PACKET_HEADER.size + length
    return _Packet(at, stream, stop) if length >= 0 and stop <= size else None


def _find(file: BinaryIO, at: int, size: int, stream: int) -> _Packet | None:
    """The next packet of this stream from byte `at` on; the decoder passes over frames of an unknown kind."""
    packet = _packet(file, at, size)
    while packet is not None and packet.stream != stream:
        packet = _packet(file, packet.stop, size)
    return packet
