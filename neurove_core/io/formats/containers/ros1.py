"""ROS 1 bags, version 2.0: messages as bytes, of files that are whole or cut. Source: wiki.ros.org/Bags/Format/2.0.

Messages lie in chunks, in the order recorded; the index at the end tells which chunk has which time. The records are
walked here: the `rosbags` package opens only files that have their index, which a killed recorder never wrote.
"""

import bz2
import struct
from collections.abc import Collection, Iterator
from dataclasses import dataclass
from io import BufferedReader, RawIOBase
from pathlib import Path
from typing import Any, BinaryIO, Final, NamedTuple, Self

from neurove_core.extras import MissingExtra
from neurove_core.io.errors import BrokenRecording, UnknownSource
from neurove_core.io.formats.containers.bags import MAX_RECORD_BYTES, BagMessage

MAGIC: Final = b"#ROSBAG V2.0\n"
MAX_HEADER_BYTES: Final = 1 << 20
_MESSAGE, _BAG, _CHUNK, _CHUNK_INFO, _CONNECTION = 2, 3, 5, 6, 7


class _Connection(NamedTuple):
    topic: str
    type: str


class _Cut(Exception):
    """The bytes end within a record."""


class _Record(NamedTuple):
    op: int
    header: dict[str, bytes]
    head: int  # of all before the data [bytes]
    size: int  # of the data that follows [bytes]


@dataclass(frozen=True, slots=True)
class Ros1Bag:
    """A .bag file."""

    path: Path
    connections: dict[int, _Connection]
    chunk_ends: tuple[tuple[int, int], ...]  # byte of each chunk and the last time in it [ns]; empty without an index
    cdr: bool = False

    @classmethod
    def open(cls, path: Path) -> Self:
        """The bag in this file; where it has no index, it is read once to learn of its topics.

        Raises:
            UnknownSource: it is no ROS 1 bag of version 2.0.
        """
        with path.open("rb") as file:
            if file.read(len(MAGIC)) != MAGIC:
                raise UnknownSource(path, "the file does not begin as a ROS 1 bag of version 2.0 does")
            connections, chunk_ends = _index(file)
        if not connections:
            self = cls(path, connections, ())
            try:
                for _ in self._walk(frozenset(), len(MAGIC)):
                    pass
            except BrokenRecording:  # told when it is read
                pass
        return cls(path, connections, chunk_ends)

    @property
    def topics(self) -> dict[str, str]:
        """See `BagFile`."""
        return {connection.topic: connection.type for connection in self.connections.values()}

    def messages(self, topics: Collection[str], since_ns: int | None = None) -> Iterator[BagMessage]:
        """See `BagFile`."""
        start = len(MAGIC)
        if since_ns is not None and self.chunk_ends:
            later = [at for at, end_ns in self.chunk_ends if end_ns >= since_ns]
            if not later:
                return
            start = later[0]
        yield from self._walk(frozenset(topics), start)

    def _walk(self, wanted: frozenset[str], start: int) -> Iterator[BagMessage]:
        with self.path.open("rb") as file:
            at = file.seek(start)
            size = file.seek(0, 2)
            file.seek(at)
            while at < size:
                try:
                    record = _read_record(file)
                    after = file.tell() + record.size
                    if record.op == _CHUNK:
                        yield from self._in_chunk(file, record, at, wanted)
                    elif record.op == _CONNECTION:
                        self._note(record.header, _exactly(file, record.size))
                    elif record.op == _CHUNK_INFO:  # from here on there is the index alone
                        return
                except _Cut as cut:
                    raise BrokenRecording(
                        self.path, f"byte {at}", str(cut) or "the file ends within a record"
                    ) from None
                if after > size:
                    raise BrokenRecording(self.path, f"byte {at}", "the file ends within this record")
                at = file.seek(after)

    def _in_chunk(self, file: BinaryIO, chunk: _Record, at: int, wanted: frozenset[str]) -> Iterator[BagMessage]:
        """The messages of one chunk, read one by one: a chunk is as large as its recorder liked."""
        stream, stop, inside = _plain(file, chunk), _number(chunk.header, "size"), 0
        while inside < stop:
            record = _read_record(stream)
            data = _exactly(stream, record.size)
            if record.op == _CONNECTION:
                self._note(record.header, data)
            elif record.op == _MESSAGE:
                connection = self.connections.get(_number(record.header, "conn"))
                if connection is None:
                    raise _Cut("a message of a connection that was never described")
                if connection.topic in wanted:
                    seconds, nanoseconds = struct.unpack("<II", record.header.get("time", b"").ljust(8, b"\0")[:8])
                    where = f"byte {inside} of the chunk at byte {at}"
                    yield BagMessage(connection.topic, seconds * 1_000_000_000 + nanoseconds, where, data)
            inside += record.head + record.size

    def _note(self, header: dict[str, bytes], data: bytes) -> None:
        kind = _fields(data).get("type", b"").decode("utf-8", "replace")
        topic = header.get("topic", b"").decode("utf-8", "replace")
        self.connections.setdefault(_number(header, "conn"), _Connection(topic, kind))


class _Span(RawIOBase):
    """The next bytes of a file, and no more."""

    def __init__(self, file: BinaryIO, size: int) -> None:
        self._file, self._left = file, size

    def readable(self) -> bool:
        return True

    def readinto(self, buffer: Any) -> int:
        data = self._file.read(min(len(buffer), self._left))
        self._left -= len(data)
        buffer[: len(data)] = data
        return len(data)


def _plain(file: BinaryIO, chunk: _Record) -> Any:
    """A chunk's data as a stream of what it was before it was compressed."""
    span = BufferedReader(_Span(file, chunk.size))
    match compression := chunk.header.get("compression", b"none"):
        case b"none":
            return span
        case b"bz2":
            return bz2.BZ2File(span)
        case b"lz4":
            try:
                import lz4.frame
            except ModuleNotFoundError:
                raise MissingExtra("lz4", "recordings") from None
            return lz4.frame.LZ4FrameFile(span)
        case _:
            raise _Cut(f"compression {compression!r} is not known; none, bz2 and lz4 are")


def _exactly(stream: Any, size: int) -> bytes:
    if size > MAX_RECORD_BYTES:
        raise _Cut(f"a record of {size} bytes; at most {MAX_RECORD_BYTES} are read")
    try:
        data = bytes(stream.read(size)) if size else b""
    except (OSError, EOFError, RuntimeError, ValueError) as error:  # what the decompressors raise
        raise _Cut(f"the chunk can not be decompressed: {error}") from None
    if len(data) < size:
        raise _Cut
    return data


def _read_record(stream: Any) -> _Record:
    """The head of the next record; its data is the next to be read."""
    length = int.from_bytes(_exactly(stream, 4), "little")
    if length > MAX_HEADER_BYTES:
        raise _Cut(f"a header of {length} bytes")
    header = _fields(_exactly(stream, length))
    size = int.from_bytes(_exactly(stream, 4), "little")
    return _Record(header.get("op", b"\0")[0], header, 8 + length, size)


def _fields(data: bytes) -> dict[str, bytes]:
    fields, at = {}, 0
    while at < len(data):
        length = int.from_bytes(data[at : at + 4], "little")
        name, equals, value = data[at + 4 : at + 4 + length].partition(b"=")
        at += 4 + length
        if not equals or at > len(data):
            raise _Cut("a record's header is garbled")
        fields[name.decode("ascii", "replace")] = value
    if fields.get("op") == b"":
        raise _Cut("a record's header is garbled")
    return fields


def _number(header: dict[str, bytes], name: str) -> int:
    return int.from_bytes(header.get(name, b""), "little")


def _index(file: BinaryIO) -> tuple[dict[int, _Connection], tuple[tuple[int, int], ...]]:
    """What the index at the end tells: connections, and where each chunk is and when it ends; nothing without one."""
    connections: dict[int, _Connection] = {}
    ends: list[tuple[int, int]] = []
    try:
        bag = _read_record(file)
        at, size = _number(bag.header, "index_pos"), file.seek(0, 2)
        if bag.op != _BAG or not 0 < at < size:
            return {}, ()
        file.seek(at)
        while file.tell() < size:
            record = _read_record(file)
            data = _exactly(file, record.size)
            if record.op == _CONNECTION:
                topic, kind = record.header.get("topic", b""), _fields(data).get("type", b"")
                names = _Connection(topic.decode("utf-8", "replace"), kind.decode("utf-8", "replace"))
                connections[_number(record.header, "conn")] = names
            elif record.op == _CHUNK_INFO:
                seconds, nanoseconds = struct.unpack("<II", record.header.get("end_time", b"").ljust(8, b"\0")[:8])
                ends.append((_number(record.header, "chunk_pos"), seconds * 1_000_000_000 + nanoseconds))
    except _Cut:
        return {}, ()
    return connections, tuple(sorted(ends))
