"""ROS 1 bags of version 2.0: messages as bytes, from complete and from truncated files.

Messages are stored in chunks, in recorded order. The index at the end of the file gives the times of each chunk. This
module reads the records itself: the `rosbags` package opens only files with an index, and a recorder that was killed
did not write one. Source: wiki.ros.org/Bags/Format/2.0.
"""

import bz2
import re
import struct
from collections.abc import Collection, Iterator
from dataclasses import dataclass
from io import BufferedReader, RawIOBase
from pathlib import Path
from typing import Any, BinaryIO, Final, NamedTuple, Self

from neurove_core.extras import MissingExtra
from neurove_core.io.errors import BrokenRecording, UnknownSource
from neurove_core.io.faults import Tally
from neurove_core.io.formats.containers.bags import MAX_RECORD_BYTES, BagMessage, damaged, find_next
from neurove_core.io.unpack import ERRORS, bounded

MAGIC: Final = b"#ROSBAG V2.0\n"
MAX_HEADER_BYTES: Final = 1 << 20
_MESSAGE, _BAG, _CHUNK, _CHUNK_INFO, _CONNECTION = 2, 3, 5, 6, 7


_CHUNK_START: Final = re.compile(rb".{4}(?:.{4}(?:compression=(?:none|bz2|lz4)|op=\x05|size=.{4})){3}", re.DOTALL)
"""Beginning of a chunk: the length of its header, and the three fields of the header in any order."""


class _Connection(NamedTuple):
    topic: str
    type: str


class _BadRecord(Exception):
    """A record is truncated or corrupt. Without a text it is truncated."""


class _Record(NamedTuple):
    op: int
    header: dict[str, bytes]
    head: int  # size of everything before the data [bytes]
    size: int  # size of the data [bytes]


@dataclass(frozen=True, slots=True)
class Ros1Bag:
    """A .bag file."""

    path: Path
    connections: dict[int, _Connection]
    chunk_ends: tuple[tuple[int, int], ...]  # offset [bytes] and last time [ns] of each chunk; empty without an index
    cdr: bool = False

    @classmethod
    def open(cls, path: Path) -> Self:
        """Open the bag in this file. A file without an index is read once to find its topics.

        Raises:
            UnknownSource: the file is not a ROS 1 bag of version 2.0. MissingExtra: lz4 is not installed.
        """
        with path.open("rb") as file:
            if file.read(len(MAGIC)) != MAGIC:
                raise UnknownSource(path, "the file does not begin with the signature of a ROS 1 bag of version 2.0")
            connections, chunk_ends = _index(file)
        if not connections:
            self = cls(path, connections, ())
            try:
                for _ in self._walk(frozenset(), len(MAGIC)):
                    pass
            except BrokenRecording:  # reading the messages raises it again
                pass
        return cls(path, connections, chunk_ends)

    @property
    def topics(self) -> dict[str, str]:
        """See `BagFile`."""
        return {connection.topic: connection.type for connection in self.connections.values()}

    def messages(
        self, topics: Collection[str], since_ns: int | None = None, tally: Tally | None = None
    ) -> Iterator[BagMessage]:
        """See `BagFile`."""
        start = len(MAGIC)
        if since_ns is not None and self.chunk_ends:
            later = [at for at, end_ns in self.chunk_ends if end_ns >= since_ns]
            if not later:
                return
            start = later[0]
        yield from self._walk(frozenset(topics), start, tally)

    def _walk(self, wanted: frozenset[str], start: int, tally: Tally | None = None) -> Iterator[BagMessage]:
        with self.path.open("rb") as file:
            at = file.seek(start)
            size = file.seek(0, 2)
            file.seek(at)
            while at < size:
                after = 0  # unknown
                try:
                    record = _read_record(file)
                    after = file.tell() + record.size
                    if record.op == _CHUNK:
                        yield from self._in_chunk(file, record, at, wanted, tally)
                    elif record.op == _CONNECTION:
                        self._add_connection(record.header, _read_exactly(file, record.size))
                    elif record.op == _CHUNK_INFO:  # only the index follows
                        return
                    why = "the file ends within this record" if after > size else ""
                except _BadRecord as error:
                    why = str(error) or "the file ends within a record"
                if why:
                    after = after if 0 < after < size else self._chunk_after(file, at, size)
                    if not after:
                        raise BrokenRecording(self.path, f"byte {at}", why)
                    damaged(tally, f"byte {at}", why)
                at = file.seek(after)

    def _chunk_after(self, file: BinaryIO, at: int, size: int) -> int:
        """The first byte of the next chunk: as the index says, or found in a file without one. 0 without a chunk."""
        if self.chunk_ends:
            return next((start for start, _ in self.chunk_ends if start > at), 0)

        def accept(start: int) -> bool:
            file.seek(start)
            try:
                return _read_record(file).size <= size - file.tell()
            except _BadRecord:
                return False

        return find_next(file, _CHUNK_START, at + 1, accept)

    def _in_chunk(
        self, file: BinaryIO, chunk: _Record, at: int, wanted: frozenset[str], tally: Tally | None
    ) -> Iterator[BagMessage]:
        """Yield the messages of one chunk. They are read one by one, because a chunk may have any size."""
        stream, stop, inside = _decompressed_chunk(file, chunk), _integer(chunk.header, "size"), 0
        while inside < stop:
            record = _read_record(stream)
            data = _read_exactly(stream, record.size)
            if record.op == _CONNECTION:
                self._add_connection(record.header, data)
            elif record.op == _MESSAGE:
                connection = self.connections.get(_integer(record.header, "conn"))
                where = f"byte {inside} of the chunk at byte {at}"
                if connection is None:
                    damaged(tally, where, "a message refers to a connection that no record defines")
                elif connection.topic in wanted:
                    seconds, nanoseconds = struct.unpack("<II", record.header.get("time", b"").ljust(8, b"\0")[:8])
                    yield BagMessage(connection.topic, seconds * 1_000_000_000 + nanoseconds, where, data)
            inside += record.head + record.size

    def _add_connection(self, header: dict[str, bytes], data: bytes) -> None:
        kind = _fields(data).get("type", b"").decode("utf-8", "replace")
        topic = header.get("topic", b"").decode("utf-8", "replace")
        self.connections.setdefault(_integer(header, "conn"), _Connection(topic, kind))


class _LimitedStream(RawIOBase):
    """Stream of the next `size` bytes of a file."""

    def __init__(self, file: BinaryIO, size: int) -> None:
        self._file, self._left = file, size

    def readable(self) -> bool:
        return True

    def readinto(self, buffer: Any) -> int:
        data = self._file.read(min(len(buffer), self._left))
        self._left -= len(data)
        buffer[: len(data)] = data
        return len(data)


def _decompressed_chunk(file: BinaryIO, chunk: _Record) -> Any:
    """Return the decompressed data of a chunk as a stream."""
    limited = BufferedReader(_LimitedStream(file, chunk.size))
    match compression := chunk.header.get("compression", b"none"):
        case b"none":
            return limited
        case b"bz2":
            return bounded(bz2.BZ2File(limited), chunk.size)
        case b"lz4":
            try:
                import lz4.frame
            except ModuleNotFoundError:
                raise MissingExtra("lz4", "recordings") from None
            return bounded(lz4.frame.LZ4FrameFile(limited), chunk.size)
        case _:
            raise _BadRecord(f"unknown compression {compression!r}; supported: none, bz2, lz4")


def _read_exactly(stream: Any, size: int) -> bytes:
    """Read `size` bytes or raise _BadRecord."""
    if size > MAX_RECORD_BYTES:
        raise _BadRecord(f"a record has {size} bytes; the limit is {MAX_RECORD_BYTES}")
    try:
        data = bytes(stream.read(size)) if size else b""
    except ERRORS as error:
        raise _BadRecord(f"cannot decompress the chunk: {error}") from None
    if len(data) < size:
        raise _BadRecord
    return data


def _read_record(stream: Any) -> _Record:
    """Read the header of the next record; its data is next in the stream."""
    length = int.from_bytes(_read_exactly(stream, 4), "little")
    if length > MAX_HEADER_BYTES:
        raise _BadRecord(f"a record header has {length} bytes; the limit is {MAX_HEADER_BYTES}")
    header = _fields(_read_exactly(stream, length))
    size = int.from_bytes(_read_exactly(stream, 4), "little")
    return _Record(header.get("op", b"\0")[0], header, 8 + length, size)


def _fields(data: bytes) -> dict[str, bytes]:
    fields, at = {}, 0
    while at < len(data):
        length = int.from_bytes(data[at : at + 4], "little")
        name, equals, value = data[at + 4 : at + 4 + length].partition(b"=")
        at += 4 + length
        if not equals or at > len(data):
            raise _BadRecord("a record header is corrupt")
        fields[name.decode("ascii", "replace")] = value
    if fields.get("op") == b"":
        raise _BadRecord("a record header is corrupt")
    return fields


def _integer(header: dict[str, bytes], name: str) -> int:
    return int.from_bytes(header.get(name, b""), "little")


def _index(file: BinaryIO) -> tuple[dict[int, _Connection], tuple[tuple[int, int], ...]]:
    """Read the index at the end of the file: connections, and offset [bytes] and last time [ns] of each chunk.

    Both are empty if the file has no index or the index is corrupt.
    """
    connections: dict[int, _Connection] = {}
    ends: list[tuple[int, int]] = []
    try:
        bag = _read_record(file)
        at, size = _integer(bag.header, "index_pos"), file.seek(0, 2)
        if bag.op != _BAG or not 0 < at < size:
            return {}, ()
        file.seek(at)
        while file.tell() < size:
            record = _read_record(file)
            data = _read_exactly(file, record.size)
            if record.op == _CONNECTION:
                topic, kind = record.header.get("topic", b""), _fields(data).get("type", b"")
                names = _Connection(topic.decode("utf-8", "replace"), kind.decode("utf-8", "replace"))
                connections[_integer(record.header, "conn")] = names
            elif record.op == _CHUNK_INFO:
                seconds, nanoseconds = struct.unpack("<II", record.header.get("end_time", b"").ljust(8, b"\0")[:8])
                ends.append((_integer(record.header, "chunk_pos"), seconds * 1_000_000_000 + nanoseconds))
    except _BadRecord:
        return {}, ()
    return connections, tuple(sorted(ends))
