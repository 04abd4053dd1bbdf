"""MCAP files: messages as bytes, from complete and from truncated files. Source: mcap.dev/spec.

This module reads the records itself. The `mcap` package reads a file without an end from memory or not at all, and it
does not report the byte at which it failed. The package parses only the few records of the index.
"""

import re
import zlib
from collections.abc import Collection, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO, NamedTuple, Self

from neurove_core.io.errors import BrokenRecording, UnknownSource
from neurove_core.io.faults import Tally
from neurove_core.io.formats.containers.bags import (
    MAX_RECORD_BYTES,
    BagMessage,
    damaged,
    decompressed,
    find_next,
    type_name,
)
from neurove_core.io.formats.containers.mcap_records import (
    CHANNEL,
    CHUNK,
    CHUNK_HEAD,
    DATA_END,
    FOOTER,
    HEADER,
    MAGIC,
    MESSAGE,
    MESSAGE_HEAD,
    METADATA,
    RECORD,
    SCHEMA,
    Channel,
    ChunkIndex,
    Definitions,
    NoSummary,
    add_definition,
    length_at,
    record_errors,
    summary,
)
from neurove_core.io.unpack import unpacked

_CHUNK_START = re.compile(rb"\x06.{36}(?:\x04\x00\x00\x00zstd|\x03\x00\x00\x00lz4)", re.DOTALL)
"""Beginning of a compressed chunk: its record, times, size and checksum, and the name of its compression."""


class Record(NamedTuple):
    """One message and its position in the file."""

    channel: Channel
    log_ns: int  # record time [ns]
    publish_ns: int  # publish time [ns]
    where: str  # readable position in the file
    data: bytes


@dataclass(frozen=True, slots=True)
class McapFile:
    """An .mcap file."""

    path: Path
    profile: str
    channels: dict[int, Channel]
    chunks: tuple[ChunkIndex, ...]  # in recorded order; empty if the file has no index
    metadata: dict[str, dict[str, str]]

    @classmethod
    def open(cls, path: Path) -> Self:
        """Open the file. A file without an index is read once to find its channels.

        Raises:
            UnknownSource: the file is not an MCAP file.
            MissingExtra: mcap, or the library of the file's compression, is not installed.
        """
        with path.open("rb") as file:
            if file.read(len(MAGIC)) != MAGIC:
                raise UnknownSource(path, "the file does not begin with the MCAP signature")
            head = RECORD.unpack(file.read(RECORD.size).ljust(RECORD.size, b"\0"))
            if head[0] != HEADER or not 4 <= head[1] <= 1 << 16:
                raise UnknownSource(path, "the file has no MCAP header")
            body = file.read(head[1])
            profile = body[4 : 4 + int.from_bytes(body[:4], "little")].decode("utf-8", "replace")
            try:
                found, chunks, metadata = summary(file)
            except NoSummary:
                found, chunks, metadata = Definitions(), (), {}
        if not found.channels:
            self = cls(path, profile, {}, (), {})
            try:
                for _ in self._walk(found, frozenset(), metadata):
                    pass
            except BrokenRecording:  # reading the messages raises it again
                pass
        return cls(path, profile, found.channels, chunks, metadata)

    @property
    def topics(self) -> dict[str, str]:
        """See `BagFile`."""
        return {channel.topic: type_name(channel.schema) for channel in self.channels.values()}

    @property
    def cdr(self) -> bool:
        """True for CDR messages (ROS 2), False for ROS 1 messages."""
        return not any(channel.encoding == "ros1" for channel in self.channels.values())

    def messages(
        self, topics: Collection[str], since_ns: int | None = None, tally: Tally | None = None
    ) -> Iterator[BagMessage]:
        """See `BagFile`."""
        skip = 0
        if since_ns is not None:
            while skip < len(self.chunks) and self.chunks[skip].end_ns < since_ns:
                skip += 1
        for record in self.records(topics, skip, tally):
            data, why = decompressed(record.data)
            if why:
                damaged(tally, record.where, why)
            else:
                yield BagMessage(record.channel.topic, record.log_ns, record.where, data)

    def records(self, topics: Collection[str], first_chunk: int = 0, tally: Tally | None = None) -> Iterator[Record]:
        """Yield the messages of these topics in recorded order. Damaged records and chunks are skipped.

        Args:
            topics: names of the topics.
            first_chunk: number in `chunks` of the first chunk to read.
            tally: counts what is skipped.

        Raises:
            BrokenRecording: the file cannot be read beyond the named byte. It is raised after all messages before it.
        """
        wanted = frozenset(topics)
        start = len(MAGIC)
        if first_chunk:
            last = first_chunk >= len(self.chunks)
            start = self.path.stat().st_size if last else self.chunks[first_chunk].start
            if last:
                return
        yield from self._walk(Definitions(dict(self.channels)), wanted, {}, start, tally)

    def first_in_chunk(self, topic: str, chunk: int) -> Record | None:
        """Return the first message of a topic in one chunk of the index; None if it has none or is damaged."""
        with self.path.open("rb") as file:
            at = self.chunks[chunk].start
            length = length_at(file, at)
            if length > MAX_RECORD_BYTES:
                return None
            walk = _Walk(self.path, Definitions(dict(self.channels)), {topic}, {}, None)
            return next(walk.in_chunk(at, file.read(length), complete=True), None)

    def chunks_of(self, topic: str) -> list[int]:
        """Return the numbers of the chunks that hold messages of a topic or whose index lists no channels."""
        ids = {key for key, channel in self.channels.items() if channel.topic == topic}
        return [i for i, chunk in enumerate(self.chunks) if not chunk.channels or ids & chunk.channels]

    def _walk(
        self,
        found: Definitions,
        wanted: Collection[str],
        metadata: dict[str, dict[str, str]],
        start: int = len(MAGIC),
        tally: Tally | None = None,
    ) -> Iterator[Record]:
        walk = _Walk(self.path, found, wanted, metadata, tally)
        with self.path.open("rb") as file:
            size = file.seek(0, 2)
            at = file.seek(start)
            while True:
                head = file.read(RECORD.size)
                if len(head) < RECORD.size:
                    raise BrokenRecording(self.path, f"byte {at}", "the file has no end record")
                opcode, length = RECORD.unpack(head)
                if opcode in (DATA_END, FOOTER):
                    return
                fault = _fault_of(length, size - file.tell())
                later = self._chunk_after(file, at, size) if fault else 0
                file.seek(at + RECORD.size)
                if not fault or (length <= MAX_RECORD_BYTES and not later):
                    yield from walk.record(at, opcode, file.read(min(length, MAX_RECORD_BYTES)), length)
                after = at + RECORD.size + length
                if fault:
                    after = later
                    if not after:
                        raise BrokenRecording(self.path, f"byte {at}", fault)
                    damaged(tally, f"byte {at}", fault)
                at = file.seek(after)

    def _chunk_after(self, file: BinaryIO, at: int, size: int) -> int:
        """The first byte of the next chunk: as the index says, or found in a file without one. 0 without a chunk."""
        if self.chunks:
            return next((chunk.start for chunk in self.chunks if chunk.start > at), 0)

        def accept(start: int) -> bool:
            return not _fault_of(length_at(file, start), size - start - RECORD.size)

        return find_next(file, _CHUNK_START, at + 1, accept)


def _fault_of(length: int, left: int) -> str:
    """What is wrong with the length of a record, if the file has `left` bytes after its head."""
    if length > left:
        return "the file ends within this record"
    if length > MAX_RECORD_BYTES:
        return f"a record has {length} bytes; the limit is {MAX_RECORD_BYTES}"
    return ""


@dataclass(frozen=True, slots=True)
class _Walk:
    """One pass over the records of a file."""

    path: Path
    found: Definitions
    wanted: Collection[str]
    metadata: dict[str, dict[str, str]]
    tally: Tally | None

    def record(self, at: int, opcode: int, body: bytes, length: int) -> Iterator[Record]:
        """Yield the messages of one record; of a truncated chunk, the complete messages."""
        complete = len(body) == length
        if opcode == CHUNK:
            yield from self.in_chunk(at, body, complete=complete)
        elif complete and (record := self._message(f"byte {at}", opcode, body)):
            yield record

    def in_chunk(self, at: int, body: bytes, *, complete: bool) -> Iterator[Record]:
        """Yield the messages of one chunk that can be read."""
        where = f"byte {at}"
        if len(body) < CHUNK_HEAD.size:
            damaged(self.tally if complete else None, where, "this chunk ends within its header")
            return
        _, _, size, crc, name = CHUNK_HEAD.unpack_from(body)
        start = CHUNK_HEAD.size + name + 8
        compression = body[CHUNK_HEAD.size : start - 8].decode("ascii", "replace")
        if size > MAX_RECORD_BYTES:
            damaged(self.tally, where, f"a chunk has {size} bytes; the limit is {MAX_RECORD_BYTES}")
            return
        data, why = unpacked(compression, body[start:], size) if compression else (body[start:], "")
        if not why and complete and len(data) != size:
            why = f"this chunk holds {len(data)} bytes instead of {size}"
        if not why and complete and crc and zlib.crc32(data) != crc:
            why = "this chunk's checksum is wrong"  # any of its messages may be corrupt
            data = b""
        inside = 0
        while inside + RECORD.size <= len(data):
            opcode, length = RECORD.unpack_from(data, inside)
            stop = inside + RECORD.size + length
            if stop > len(data):
                why = why or "a record extends past the end of this chunk"
                break
            place = f"byte {inside} of the chunk at {where}"
            record = self._message(place, opcode, data[inside + RECORD.size : stop])
            if record:
                yield record
            inside = stop
        if why and complete:
            damaged(self.tally, where, why)

    def _message(self, where: str, opcode: int, body: bytes) -> Record | None:
        """Return the message of this record if its topic is wanted; note a schema, channel or metadata record."""
        if opcode == MESSAGE:
            if len(body) < MESSAGE_HEAD.size:
                damaged(self.tally, where, "a message has no header")
                return None
            number, _, log_ns, publish_ns = MESSAGE_HEAD.unpack_from(body)
            channel = self.found.channels.get(number)
            if channel is None:
                damaged(self.tally, where, f"a message refers to channel {number}, which no record defines")
                return None
            if channel.topic not in self.wanted:
                return None
            return Record(channel, log_ns, publish_ns, where, body[MESSAGE_HEAD.size :])
        if opcode in (SCHEMA, CHANNEL, METADATA):
            try:
                add_definition(opcode, body, self.found, self.metadata)
            except record_errors() as error:
                damaged(self.tally, where, f"cannot read this record: {error}")
        return None
