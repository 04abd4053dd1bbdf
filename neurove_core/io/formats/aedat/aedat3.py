"""AEDAT 3.1 files of cAER and jAER: a text header, then packets of events, inertial samples and special events.

All numbers are little-endian. A packet has a header of 28 bytes and `number` items of `size` bytes:

| packet | bytes of an item |
| --- | --- |
| 0 special | 0-3 valid (bit 0), type (bits 1-7); 4-7 time [us] |
| 1 polarity | 0-3 valid (bit 0), polarity (bit 1), y (bits 2-16), x (bits 17-31); 4-7 time [us] |
| 3 IMU, 6 axes | 0-3 valid (bit 0); 4-7 time [us]; 8-35 float32: accel x y z [g], gyro x y z [deg/s], temperature |

The origin of x and y is the upper left corner. A time has 31 bits; the header of its packet gives the bits above.

Source: docs.inivation.com/software/software-advanced-usage/file-formats/aedat-3.1.html; types of special events:
gitlab.com/inivation/dv/libcaer, include/libcaer/events/special.h.
"""

import re
import struct
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, BinaryIO, Final, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from neurove_core.io.axes import optical_samples
from neurove_core.io.checked import Piece, as_recorded, cleaned, ordered
from neurove_core.io.errors import BrokenRecording, MissingGeometry, UnknownSource
from neurove_core.io.faults import Faults, Reason, Tally
from neurove_core.io.format import Format
from neurove_core.io.order import Where
from neurove_core.io.recording import BLOCK_BYTES, EventsOnly, Triggers
from neurove_protocol.events import Events, Sensor
from neurove_protocol.imu import Imu

MAX_HEADER_BYTES: Final = 4 << 20
MAX_PACKET_BYTES: Final = 64 << 20
"""Largest content of a packet. Packets of cAER have about 50 kB."""

SPECIAL, POLARITY, IMU6 = 0, 1, 3
EXTERNAL, GENERATOR, READOUT, EXPOSURE, EXTERNAL_1, EXTERNAL_2 = range(6)
"""Channels of the triggers, the first four as in AEDAT4: inputs, the camera's generator, and the stages of a frame."""

CHIPS: Final = {
    "DVS128": Sensor(128, 128),
    "EDVS": Sensor(128, 128),
    "DVS132": Sensor(132, 104),
    "DAVIS128": Sensor(128, 128),
    "DAVIS208": Sensor(208, 192),
    "DAVIS240": Sensor(240, 180),
    "DAVIS346": Sensor(346, 260),
    "DAVIS640": Sensor(640, 480),
    "DAVISHET640": Sensor(640, 480),
    "DVXPLORER LITE": Sensor(320, 240),
    "DVXPLORER": Sensor(640, 480),
}
"""Size of the pixel array by the first part of the name of a source."""


_ITEMS: Final = {
    SPECIAL: np.dtype([("data", "<u4"), ("t", "<i4")]),
    POLARITY: np.dtype([("data", "<u4"), ("t", "<i4")]),
    IMU6: np.dtype([("data", "<u4"), ("t", "<i4"), ("accel", "<f4", 3), ("gyro", "<f4", 3), ("temperature", "<f4")]),
}
_EDGES: Final = {  # type of a special event -> channel and level; a pulse is one rising edge
    2: (EXTERNAL, 1),
    3: (EXTERNAL, 0),
    4: (EXTERNAL, 1),
    6: (EXTERNAL_1, 1),
    7: (EXTERNAL_1, 0),
    8: (EXTERNAL_1, 1),
    9: (EXTERNAL_2, 1),
    10: (EXTERNAL_2, 0),
    11: (EXTERNAL_2, 1),
    12: (GENERATOR, 1),
    13: (GENERATOR, 0),
    14: (READOUT, 1),
    15: (READOUT, 0),
    16: (EXPOSURE, 1),
    17: (EXPOSURE, 0),
}

_HEAD = struct.Struct("<hhiiiiii")  # type, source, size, offset of the time, time overflow, capacity, number, valid
_PACKET_START = re.compile(rb"[\0\x01]\0..\x08\0\0\0\x04\0\0\0|\x03\0..\x24\0\0\0\x04\0\0\0", re.DOTALL)
_VERSION = re.compile(rb"#!AER-DAT(\d\.\d)\r?\n")
_LINE = re.compile(rb"#([^\r\n]*)\r?\n")
_END = b"!END-HEADER"


class Header(NamedTuple):
    """Content of the text header."""

    format: str
    sources: dict[int, str]  # name of the camera by number
    size: int  # [bytes]


class Packet(NamedTuple):
    """One packet of the file."""

    kind: int
    source: int
    size: int  # of an item [bytes]
    overflow: int  # bits of the time above the lower 31
    number: int  # of items
    start: int  # byte of its first item

    @property
    def stop(self) -> int:
        """The byte after it."""
        return self.start + self.number * self.size


def parse_header(path: Path, head: bytes) -> Header:
    r"""Read the lines that begin with '#', up to `#!END-HEADER`.

    >>> parse_header(Path("a"), b"#!AER-DAT3.1\r\n#Format: RAW\r\n#Source 1: DVS128\r\n#!END-HEADER\r\n").sources
    {1: 'DVS128'}

    Raises:
        UnknownSource: it is of another version of AEDAT. BrokenRecording: the header has no end.
    """
    version = _VERSION.match(head)
    if version is None or version[1] != b"3.1":
        found = f"AEDAT {version[1].decode()}" if version else "not AEDAT"
        raise UnknownSource(path, f"it is {found}; the supported versions are 2.0, 3.1 and 4.0")
    format_, at = "RAW", 0
    sources: dict[int, str] = {}
    while line := _LINE.match(head, at):
        at = line.end()
        if line[1] == _END:
            return Header(format_, sources, at)
        text = line[1].decode("latin-1")
        if text.startswith("Format:"):
            format_ = text.removeprefix("Format:").strip()
        elif source := re.fullmatch(r"Source (\d{1,5}): *(.*)", text):
            sources[int(source[1])] = source[2].strip()
    raise BrokenRecording(path, f"byte {at}", "the header has no line #!END-HEADER")


@dataclass(frozen=True, slots=True)
class Aedat3Recording(EventsOnly):
    """One camera of an .aedat file of version 3.1; see `Recording`. Frames are not read."""

    path: Path
    name: str
    sensor: Sensor
    source: int
    start: int  # byte of the first packet
    endless: bool = False
    faults: Faults = field(default_factory=Faults, compare=False, repr=False)

    @classmethod
    def open(cls, path: Path, sensor: Sensor | None = None, topic: str | None = None) -> Self:
        """Open one camera of the recording.

        Args:
            path: the .aedat file.
            sensor: its pixel array. The default is that of the camera that the header names.
            topic: number of the source, if the file has several. The default is the first one.

        Raises:
            UnknownSource: the file is not AEDAT 3.1 with the format RAW, or has no such source.
            MissingGeometry: `sensor` is not given, and the header names no known camera.
            BrokenRecording: its header has no end.
        """
        with path.open("rb") as file:
            header = parse_header(path, file.read(MAX_HEADER_BYTES))
        if header.format != "RAW":
            raise UnknownSource(path, f"the format of its packets is {header.format}; the supported format is RAW")
        sources = header.sources or {0: ""}
        chosen = str(min(sources)) if topic is None else topic
        if chosen not in map(str, sources):
            known = ", ".join(f"{number} ({name})" for number, name in sorted(sources.items()))
            raise UnknownSource(path, f"it has no source {chosen!r}; its sources are {known}")
        camera = sources[int(chosen)].upper()
        sensor = sensor or next((size for start, size in CHIPS.items() if camera.startswith(start)), None)
        if sensor is None:
            raise MissingGeometry(path)
        several = f" (source {chosen} of {len(sources)}: {sources[int(chosen)]})" if len(sources) > 1 else ""
        return cls(path, path.name + several, sensor, int(chosen), header.size)

    @property
    def streams(self) -> tuple[str, ...]:
        """Events, imu and triggers. Only reading shows whether there are samples and triggers."""
        return ("events", "imu", "triggers")

    def chunks(self) -> Iterator[Events]:
        """All events from the beginning; see `Recording`. Times are on the camera's clock."""
        tally = self.faults.begin("events")
        return cleaned(self._events(tally), self.sensor, tally)

    def imu(self) -> Iterator[Imu]:
        """All samples in the optical frame; see `Recording` and `axes.OPTICAL`."""
        tally = self.faults.begin("imu")
        return ordered(self._samples(tally), tally)

    def triggers(self) -> Iterator[Triggers]:
        """All edges of the camera's inputs and generator, and of its frames; see `Recording`."""
        tally = self.faults.begin("triggers")
        return ordered(self._edges(tally), tally)

    def _events(self, tally: Tally) -> Iterator[Piece]:
        for where, t, rows in self._items(POLARITY, tally):
            data = rows["data"]
            yield where, as_recorded(t, data >> 17, data >> 2 & 0x7FFF, (data >> 1 & 1).astype(np.uint8))

    def _samples(self, tally: Tally) -> Iterator[tuple[Where, Imu]]:
        for where, t, rows in self._items(IMU6, tally):
            accel, gyro = rows["accel"].astype(np.float64), rows["gyro"].astype(np.float64)
            finite = np.isfinite(accel).all(axis=1) & np.isfinite(gyro).all(axis=1)
            if not finite.all():
                first = int(finite.argmin())
                why = f"accel {accel[first].tolist()} g, gyro {gyro[first].tolist()} deg/s: not finite"
                tally.add(Reason.INVALID, where(first), why, int(np.count_nonzero(~finite)))
                accel, gyro, t, where = accel[finite], gyro[finite], t[finite], _of(where, np.flatnonzero(finite))
            yield where, optical_samples(t, accel, gyro)

    def _edges(self, tally: Tally) -> Iterator[tuple[Where, Triggers]]:
        for where, t, rows in self._items(SPECIAL, tally):
            kinds = rows["data"] >> 1 & 0x7F
            index = np.flatnonzero(np.isin(kinds, list(_EDGES)))
            edges = np.array([_EDGES[kind] for kind in kinds[index].tolist()], np.uint8).reshape(-1, 2)
            yield _of(where, index), Triggers(t[index], edges[:, 0].copy(), edges[:, 1].copy())

    def _items(self, kind: int, tally: Tally) -> Iterator[tuple[Where, NDArray[np.int64], NDArray[Any]]]:
        """Places, times [us] and rows of the valid items in each packet of this kind and of this source."""
        dtype = _ITEMS[kind]
        with self.path.open("rb") as file:
            size = file.seek(0, 2)
            for packet in self._packets(file, size, tally):
                if (packet.kind, packet.source, packet.size) != (kind, self.source, dtype.itemsize):
                    continue
                file.seek(packet.start)
                data = file.read(packet.stop - packet.start)
                rows = np.frombuffer(data, dtype, len(data) // dtype.itemsize)
                index = np.flatnonzero((rows["data"] & 1 == 1) & (rows["t"] >= 0))
                negative = np.flatnonzero(rows["t"] < 0)
                where = _place(packet)
                if negative.size:
                    first = int(negative[0])
                    why = f"its time is {int(rows['t'][first])} us; the bound is 0"
                    tally.add(Reason.INVALID, where(first), why, negative.size)
                rows = rows[index]
                yield _of(where, index), (packet.overflow << 31) + rows["t"].astype(np.int64), rows
                if packet.stop > size:
                    raise BrokenRecording(self.path, f"byte {packet.start}", "the file ends within this packet")

    def _packets(self, file: BinaryIO, size: int, tally: Tally) -> Iterator[Packet]:
        """All packets. After damage the next packet is searched."""
        at = self.start
        while at < size:
            packet = _packet_at(file, at)
            if packet is None:
                found = _search(file, at + 1, size)
                if found is None:
                    raise BrokenRecording(self.path, f"byte {at}", "this is no packet, and no packet follows")
                tally.add(Reason.DAMAGED, f"byte {at}", f"this is no packet; the next one is at byte {found}")
                at = found
                continue
            yield packet
            at = packet.stop


def _packet_at(file: BinaryIO, at: int) -> Packet | None:
    """The packet whose header begins at byte `at`, or None if no valid header is there."""
    file.seek(at)
    head = file.read(_HEAD.size)
    if len(head) < _HEAD.size:
        return None
    kind, source, size, offset, overflow, capacity, number, valid = _HEAD.unpack(head)
    plausible = kind >= 0 and source >= 0 and 0 <= valid <= number <= capacity and 0 <= overflow < 1 << 31
    if not (plausible and 8 <= size <= MAX_PACKET_BYTES and 0 <= offset <= size - 4):
        return None
    if number * size > MAX_PACKET_BYTES or (kind in _ITEMS and size != _ITEMS[kind].itemsize):
        return None
    return Packet(kind, source, size, overflow, number, at + _HEAD.size)


def _search(file: BinaryIO, at: int, size: int) -> int | None:
    """The byte of the next packet of a known kind that ends in the file, before another packet or its end."""
    while at < size:
        file.seek(at)
        block = file.read(BLOCK_BYTES)
        for match in _PACKET_START.finditer(block):
            packet = _packet_at(file, at + match.start())
            if packet is None or packet.stop > size:
                continue
            if packet.stop == size or _packet_at(file, packet.stop) is not None:
                return at + match.start()
        if at + len(block) >= size:
            return None
        at += len(block) - _HEAD.size
    return None


def _place(packet: Packet) -> Where:
    """The byte of item i of a packet."""
    return lambda i: f"byte {packet.start + i * packet.size}"


def _of(where: Where, index: NDArray[np.intp]) -> Where:
    """The place of item i of a selection."""
    return lambda i: where(int(index[i]))


FORMAT = Format("FILE.aedat (AEDAT 3.1 of cAER and jAER)", Aedat3Recording.open, (".aedat",), signature=b"#!AER-DAT3")
