"""Contents of AEDAT4 packets: compressed flatbuffers, read with every offset checked.

Each packet is a flatbuffer that begins with its size. Its root is a table; field 0 of a packet of events, inertial
samples or triggers is a vector. Sources: https://flatbuffers.dev (internals), and the schemas of DV (events.fbs,
imus.fbs, triggers.fbs, frame.fbs in https://gitlab.com/inivation/dv/dv-processing). No library reads them here: the
existing ones do not check offsets, and end in a panic on a damaged packet.
"""

from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from neurove_core.io.unpack import unpacked

MAX_PACKET_BYTES: Final = 64 << 20
"""Limit for one packet, compressed and decompressed."""

_EVENT = np.dtype([("t", "<i8"), ("x", "<i2"), ("y", "<i2"), ("p", "u1"), ("_", "V3")])
_COMPRESSION = {b"\x04\x22\x4d\x18": "lz4", b"\x28\xb5\x2f\xfd": "zstd"}  # by the first bytes of the packet


class BadPacket(Exception):
    """The packet cannot be decoded."""


class Table:
    """A table in the bytes of a flatbuffer.

    Args:
        data: the bytes.
        at: place of the table.

    Raises:
        BadPacket: from every method, an offset leads out of the bytes.
    """

    def __init__(self, data: bytes, at: int) -> None:
        self._data, self._at = data, at
        self._fields = at - int(_number(data, at, "<i4"))
        self._size = int(_number(data, self._fields, "<u2"))

    def place(self, field: int) -> int:
        """The place of a field, 0 if the field is not stored."""
        offset = 4 + 2 * field
        if offset + 2 > self._size:
            return 0
        stored = int(_number(self._data, self._fields + offset, "<u2"))
        return self._at + stored if stored else 0

    def number(self, field: int, kind: str) -> float | int:
        """A field that is a number; 0 if it is not stored."""
        at = self.place(field)
        return _number(self._data, at, kind) if at else 0

    def vector(self, field: int) -> tuple[int, int]:
        """The place of the first element of a field that is a vector, and the number of elements."""
        at = self.place(field)
        if not at:
            return 0, 0
        at += int(_number(self._data, at, "<u4"))
        return at + 4, int(_number(self._data, at, "<u4"))


def root(packet: bytes, identifier: bytes) -> tuple[bytes, Table]:
    """Decompress a packet and find its root table.

    Args:
        packet: the bytes after the packet's header.
        identifier: of the packet's type, such as b"EVTS".

    Raises:
        BadPacket: it cannot be decompressed, is too large, or is of another type.
        MissingExtra: lz4 or zstandard is not installed.
    """
    compression, data = _COMPRESSION.get(packet[:4]), packet
    if compression is not None:
        data, why = unpacked(compression, packet, MAX_PACKET_BYTES)
        if why:
            raise BadPacket(f"it cannot be decompressed: {why}")
    if data[8:12] != identifier:
        raise BadPacket(f"its type is {data[8:12]!r}, expected {identifier!r}")
    return data, Table(data, 4 + int(_number(data, 4, "<u4")))


def events_of(packet: bytes) -> NDArray[np.void]:
    """Events of a packet: t [us], x, y, p.

    Raises:
        BadPacket: the packet is corrupt.
    """
    data, table = root(packet, b"EVTS")
    return _rows(data, *table.vector(0), _EVENT)


def tables_of(packet: bytes, identifier: bytes, fields: tuple[tuple[int, str], ...]) -> list[NDArray[Any]]:
    """Numbers in a packet whose root holds a vector of tables.

    Args:
        packet: the bytes after the packet's header.
        identifier: of the packet's type.
        fields: number and type of the fields to read.

    Returns:
        For each field one column (N,), of its type.

    Raises:
        BadPacket: the packet is corrupt.
    """
    data, table = root(packet, identifier)
    at, n = table.vector(0)
    offsets = _rows(data, at, n, np.dtype("<u4")).tolist()
    tables = [Table(data, at + 4 * i + offset) for i, offset in enumerate(offsets)]
    return [np.array([one.number(field, kind) for one in tables], kind) for field, kind in fields]


def frame_of(packet: bytes) -> tuple[int, NDArray[np.uint8]]:
    """Start of exposure [us] and image of a packet with a frame: grey (H, W) or RGB (H, W, 3).

    Raises:
        BadPacket: the packet is corrupt, or its pixels are of another type.
    """
    data, table = root(packet, b"FRME")
    t_us, kind = int(table.number(3, "<i8")), int(table.number(5, "<i1"))
    width, height = int(table.number(6, "<i2")), int(table.number(7, "<i2"))
    if kind not in _CHANNELS:
        raise BadPacket(f"its pixels are of the type {kind}; supported: {', '.join(map(str, _CHANNELS))}")
    channels = _CHANNELS[kind]
    at, n = table.vector(10)
    if min(width, height) < 0 or n != width * height * channels:
        raise BadPacket(f"{n} bytes are not an image of {width}x{height}x{channels}")
    pixels = _rows(data, at, n, np.dtype("u1"))
    if channels == 1:
        return t_us, pixels.reshape(height, width)
    return t_us, pixels.reshape(height, width, channels)[:, :, 2::-1]  # stored as blue, green, red, alpha


_CHANNELS: Final = {0: 1, 16: 3, 24: 4}
"""Channels by the type of pixels, in the numbers of OpenCV: CV_8UC1, CV_8UC3, CV_8UC4."""


def _rows(data: bytes, at: int, n: int, dtype: np.dtype[Any]) -> NDArray[Any]:
    if at < 0 or at + n * dtype.itemsize > len(data):
        raise BadPacket(f"{n} elements from byte {at} on do not fit into its {len(data)} bytes")
    return np.frombuffer(data, dtype, n, at)


def _number(data: bytes, at: int, kind: str) -> float | int:
    """A number in little-endian bytes."""
    dtype = np.dtype(kind)
    if at < 0 or at + dtype.itemsize > len(data):
        raise BadPacket(f"byte {at} lies outside its {len(data)} bytes")
    value: float | int = np.frombuffer(data, dtype, 1, at)[0].item()
    return value
