"""AEDAT4 files of DV: compressed packets of events, inertial samples, frames and triggers.

The package `aedat` decodes the packets.
"""

import struct
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple, Self, TypeVar

import aedat
import numpy as np
from numpy.typing import NDArray

from neurove_core.io.errors import BrokenRecording, MissingGeometry, UnknownSource
from neurove_core.io.format import Format
from neurove_core.io.recording import EventsOnly, Frame, Imu, Triggers, in_chunks, refuse_topic, valid_prefix
from neurove_protocol.errors import EventOutsideSensor, InvalidField, TimeBackwards
from neurove_protocol.events import Events, Sensor, check_events

_MAGIC = b"#!AER-DAT4.0\r\n"
MAX_HEADER_BYTES = 16 << 20  # a header has about 3,000 bytes
_PACKET_HEADER = struct.Struct("<ii")  # stream, size of the packet after this header [bytes]

G_M_S2 = 9.80665
"""Standard gravity: DV writes accelerations in this unit."""

EXTERNAL, GENERATOR, READOUT, EXPOSURE = range(4)
"""Channels of the triggers: the camera's input, its generator, and the readout and exposure of a frame."""

_KINDS = {"events": "events", "imus": "imu", "frame": "frames", "triggers": "triggers"}  # type of the decoder -> stream
_UNITS = ("accelerometer", "gyroscope")
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


class _Fault(Exception):
    """The decoder cannot continue."""


class _Packet(NamedTuple):
    start: int  # byte of its header in the file
    stream: int
    stop: int  # byte after it


@dataclass(frozen=True, slots=True)
class Aedat4Recording(EventsOnly):
    """An .aedat4 file; see `Recording`. Of several streams of one kind it reads the one with the lowest number."""

    path: Path
    name: str
    sensor: Sensor
    numbers: Mapping[str, int]  # stream number by kind, for the kinds in the file
    endless: bool = False

    @classmethod
    def open(cls, path: Path, sensor: Sensor | None = None) -> Self:
        """Open the recording in this file.

        Args:
            path: the .aedat4 file.
            sensor: its pixel array, which takes precedence over the size in the file.

        Raises:
            UnknownSource: the file is not AEDAT4, or has no event stream.
            MissingGeometry: its event stream has no valid sensor size.
            BrokenRecording: its header is truncated or corrupt.
        """
        with path.open("rb") as file:
            if not _MAGIC.startswith(file.read(len(_MAGIC))):
                raise UnknownSource(path, "the file does not begin with the AEDAT4 signature")
            _read_header(path, file)
        try:
            streams = _guarded(lambda: aedat.Decoder(path).id_to_stream())
        except _Fault as fault:
            raise BrokenRecording(path, f"byte {len(_MAGIC)}", f"the header cannot be read: {fault}") from None
        ids = sorted(key for key, stream in streams.items() if stream["type"] == "events")
        if not ids:
            raise UnknownSource(path, "the file has no event stream")
        try:
            sensor = sensor or Sensor(streams[ids[0]]["width"], streams[ids[0]]["height"])
        except InvalidField:
            raise MissingGeometry(path) from None
        name = path.name if len(ids) == 1 else f"{path.name} (stream {ids[0]}, the first of {len(ids)} event streams)"
        kinds = ((_KINDS.get(streams[key]["type"]), key) for key in sorted(streams, reverse=True))
        numbers = {kind: key for kind, key in kinds if kind}
        return cls(path, name, sensor, numbers)

    @property
    def streams(self) -> tuple[str, ...]:
        """The streams in the header."""
        return tuple(kind for kind in _KINDS.values() if kind in self.numbers)

    def chunks(self) -> Iterator[Events]:
        """All events from the beginning; see `Recording`. Times are Unix time [us]. Other streams are skipped.

        Raises:
            BrokenRecording: a packet is truncated or corrupt, or an event is outside the sensor or earlier than the one
                before it. The error names the first byte of the packet.
        """
        not_before_us = None
        for start, packet in self._packets("events"):
            events = Events.from_records(packet["events"])
            try:
                check_events(events, self.sensor, not_before_us)
            except (EventOutsideSensor, TimeBackwards) as error:
                yield from in_chunks(valid_prefix(events, self.sensor, not_before_us))
                raise BrokenRecording(self.path, f"byte {start}", f"in this packet, {error.message}") from None
            yield from in_chunks(events)
            not_before_us = int(events.t[-1]) if events.n else not_before_us

    def imu(self) -> Iterator[Imu]:
        """All samples; see `Recording`. The axes are those of the unit, because the file does not give its mounting.

        DV writes deg/s and g. A stationary, upright DAVIS346 measures about -9.8 m/s2 in y, as in the optical frame.

        Raises:
            BrokenRecording: as `chunks`.
        """
        not_before_us = None
        for start, packet in self._packets("imu"):
            rows = packet["imus"]
            t = rows["t"].astype(np.int64)
            not_before_us = self._ordered(start, t, not_before_us)
            accel, gyro = (np.stack([rows[f"{kind}_{axis}"] for axis in "xyz"], -1) for kind in _UNITS)
            if t.size:
                yield Imu(t, accel.astype(np.float64) * G_M_S2, np.radians(gyro.astype(np.float64)))

    def triggers(self) -> Iterator[Triggers]:
        """All edges; see `Recording`. DV writes edges of the camera's input (channel EXTERNAL) and also of the frames.

        The edges of a packet are sorted by time. Entries for a reset of the clock are skipped.

        Raises:
            BrokenRecording: as `chunks`.
        """
        not_before_us = None
        for start, packet in self._packets("triggers"):
            rows = packet["triggers"][np.isin(packet["triggers"]["source"], list(_EDGES))]
            rows = rows[np.argsort(rows["t"], kind="stable")]
            t = rows["t"].astype(np.int64)
            not_before_us = self._ordered(start, t, not_before_us)
            edges = np.array([_EDGES[source] for source in rows["source"].tolist()], np.uint8).reshape(-1, 2)
            if t.size:
                yield Triggers(t, edges[:, 0].copy(), edges[:, 1].copy())

    def frames(self) -> Iterator[Frame]:
        """All images; see `Recording`. A frame smaller than the sensor is not padded.

        Raises:
            BrokenRecording: as `chunks`.
        """
        not_before_us = None
        for start, packet in self._packets("frames"):
            frame = packet["frame"]
            t_us = int(frame["exposure_begin_t"])
            not_before_us = self._ordered(start, np.array([t_us]), not_before_us)
            yield Frame(
                t_us, np.ascontiguousarray(frame["pixels"][..., :3] if frame["pixels"].ndim == 3 else frame["pixels"])
            )

    def _ordered(self, start: int, t: NDArray[np.int64], not_before_us: int | None) -> int | None:
        """Check that these times [us] do not decrease. Return the last one, or `not_before_us` without times."""
        if not t.size:
            return not_before_us
        if (np.diff(t) < 0).any() or (not_before_us is not None and t[0] < not_before_us):
            raise BrokenRecording(self.path, f"byte {start}", "time runs backwards in this packet")
        return int(t[-1])

    def _packets(self, kind: str) -> Iterator[tuple[int, Any]]:
        """The first byte and the decoded content of each packet of the stream of this kind.

        The decoder does not report its position or the place of an error, and it does not check the lengths. So this
        method reads and checks each packet header before the decoder does.
        """
        wanted = self.numbers.get(kind)
        if wanted is None:
            return
        with self.path.open("rb") as file:
            at, end = _read_header(self.path, file)
            size = file.seek(0, 2)
            decoder = _guarded(lambda: aedat.Decoder(self.path))
            while at != end:
                if _packet(file, at, size) is None:
                    if end < 0 and at == size:  # the recorder stopped between two packets
                        return
                    raise BrokenRecording(
                        self.path, f"byte {at}", f"the file ends at byte {size}, before its packets do"
                    )
                try:
                    decoded = _guarded(lambda: next(decoder, None))
                except _Fault as fault:
                    raise BrokenRecording(self.path, f"byte {at}", f"this packet cannot be read: {fault}") from None
                packet = decoded and _find(file, at, size, decoded["stream_id"])
                if not decoded or not packet:  # only frames remain, of a kind that the decoder skips
                    return
                at = packet.stop
                if packet.stream == wanted:
                    yield packet.start, decoded


def _read_header(path: Path, file: BinaryIO) -> tuple[int, int]:
    """The bytes where the packets begin and end. The end is -1 if the recorder did not write it.

    The text of the header is checked too, because the decoder ends the whole process on invalid UTF-8.

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
        # a flatbuffer: a table of fields, preceded by their offsets, which are 0 for a field with its default
        (table,) = struct.unpack_from("<I", header)
        fields = table - struct.unpack_from("<i", header, table)[0]
        known, _, _, position, text = struct.unpack_from("<5H", header, fields)
        end = struct.unpack_from("<q", header, table + position)[0] if known >= 8 and position else -1
        text += table
        text += struct.unpack_from("<I", header, text)[0]
        (characters,) = struct.unpack_from("<I", header, text)
        struct.unpack_from(f"{characters}s", header, text + 4)[0].decode()
    except (struct.error, UnicodeDecodeError) as error:
        raise BrokenRecording(path, f"byte {start}", f"the header cannot be read: {error}") from None
    return start + length, end


def _guarded(call: Callable[[], T]) -> T:
    """Result of a call of the decoder. Any error of the decoder becomes _Fault."""
    try:
        return call()
    except BaseException as error:  # a Rust panic is not an Exception, and its class cannot be imported
        if not isinstance(error, Exception) and type(error).__name__ != "PanicException":
            raise
        raise _Fault(str(error)) from None


def _packet(file: BinaryIO, at: int, size: int) -> _Packet | None:
    """The packet that begins at byte `at`, or None if the file of `size` bytes ends before it does."""
    file.seek(at)
    header = file.read(_PACKET_HEADER.size)
    if len(header) < _PACKET_HEADER.size:
        return None
    stream, length = _PACKET_HEADER.unpack(header)
    stop = at + _PACKET_HEADER.size + length
    return _Packet(at, stream, stop) if length >= 0 and stop <= size else None


def _find(file: BinaryIO, at: int, size: int, stream: int) -> _Packet | None:
    """The next packet of this stream from byte `at`. The decoder skips frames of an unknown kind."""
    packet = _packet(file, at, size)
    while packet is not None and packet.stream != stream:
        packet = _packet(file, packet.stop, size)
    return packet


def _open(path: Path, sensor: Sensor | None, topic: str | None) -> Aedat4Recording:
    refuse_topic(path, topic)
    return Aedat4Recording.open(path, sensor)


FORMAT = Format("FILE.aedat4 (DV)", _open, (".aedat4",), signature=b"#!AER-DAT4")
