"""MCAP files: messages as bytes, from complete and from truncated files. Source: mcap.dev/spec.

This module reads the records itself. The `mcap` package reads a file without an end from memory or not at all, and it
does not report the byte at which it failed. The package parses only the few records of the index.
"""

import zlib
from collections.abc import Collection, Iterator
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple, Self

from neurove_core.extras import MissingExtra
from neurove_core.io.errors import BrokenRecording, UnknownSource
from neurove_core.io.formats.containers.bags import MAX_RECORD_BYTES, BagMessage, decompressed, type_name
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

    def messages(self, topics: Collection[str], since_ns: int | None = None) -> Iterator[BagMessage]:
        """See `BagFile`."""
        skip = 0
        if since_ns is not None:
            while skip < len(self.chunks) and self.chunks[skip].end_ns < since_ns:
                skip += 1
        for record in self.records(topics, skip):
            data = decompressed(self.path, record.where, record.data)
            yield BagMessage(record.channel.topic, record.log_ns, record.where, data)

    def records(self, topics: Collection[str], first_chunk: int = 0) -> Iterator[Record]:
        """Yield the messages of these topics in recorded order.

        Args:
            topics: names of the topics.
            first_chunk: number in `chunks` of the first chunk to read.

        Raises:
            BrokenRecording: the file is damaged at the named byte. It is raised after all complete messages.
        """
        wanted = frozenset(topics)
        start = len(MAGIC)
        if first_chunk:
            last = first_chunk >= len(self.chunks)
            start = self.path.stat().st_size if last else self.chunks[first_chunk].start
            if last:
                return
        return (yield from self._walk(Definitions(dict(self.channels)), wanted, {}, start))

    def first_in_chunk(self, topic: str, chunk: int) -> Record | None:
        """Return the first message of a topic in one chunk of the index, or None if the chunk has none."""
        with self.path.open("rb") as file:
            at = self.chunks[chunk].start
            file.seek(at + RECORD.size)
            body, complete = _body(self.path, file, at, length_at(file, at))
            return next(_in_chunk(self.path, at, body, Definitions(dict(self.channels)), {topic}, complete), None)

    def chunks_of(self, topic: str) -> list[int]:
        """Return the numbers of the chunks that hold messages of a topic or whose index lists no channels."""
        ids = {key for key, channel in self.channels.items() if channel.topic == topic}
        return [i for i, chunk in enumerate(self.chunks) if not chunk.channels or ids & chunk.channels]

    def _walk(
        self, found: Definitions, wanted: Collection[str], metadata: dict[str, dict[str, str]], start: int = len(MAGIC)
    ) -> Iterator[Record]:
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
                if opcode in (CHUNK, MESSAGE, SCHEMA, CHANNEL, METADATA):
                    body, complete = _body(self.path, file, at, length)
                    if opcode == CHUNK:
                        yield from _in_chunk(self.path, at, body, found, wanted, complete)
                    elif complete and (
                        record := _message_of(self.path, f"byte {at}", opcode, body, found, wanted, metadata)
                    ):
                        yield record
                    if not complete:
                        raise BrokenRecording(self.path, f"byte {at}", "the file ends within this record")
                after = at + RECORD.size + length
                if after > size:
                    raise BrokenRecording(self.path, f"byte {at}", "the file ends within this record")
                at = file.seek(after)


def _body(path: Path, file: BinaryIO, at: int, length: int) -> tuple[bytes, bool]:
    """Return the bytes of a record that the file holds, and whether the record is complete."""
    if length > MAX_RECORD_BYTES:
        raise BrokenRecording(path, f"byte {at}", f"a record has {length} bytes; the limit is {MAX_RECORD_BYTES}")
    body = file.read(length)
    return body, len(body) == length


def _in_chunk(
    path: Path, at: int, body: bytes, found: Definitions, wanted: Collection[str], complete: bool
) -> Iterator[Record]:
    """Yield the messages of one chunk; of a truncated chunk, the complete messages."""
    where = f"byte {at}"
    if len(body) < CHUNK_HEAD.size:
        raise BrokenRecording(path, where, "the file ends within the header of this chunk")
    _, _, size, crc, name = CHUNK_HEAD.unpack_from(body)
    start = CHUNK_HEAD.size + name + 8
    compression = body[CHUNK_HEAD.size : start - 8].decode("ascii", "replace")
    if size > MAX_RECORD_BYTES:
        raise BrokenRecording(path, where, f"a chunk has {size} bytes; the limit is {MAX_RECORD_BYTES}")
    data, why = _decompressed_chunk(compression, body[start:], size)
    if not why and len(data) != size and complete:
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
        record = _message_of(path, place, opcode, data[inside + RECORD.size : stop], found, wanted, {})
        if record:
            yield record
        inside = stop
    if not complete:
        why = "the file ends within this chunk"
    if why:
        raise BrokenRecording(path, where, why)


def _decompressed_chunk(compression: str, data: bytes, size: int) -> tuple[bytes, str]:
    """Decompress a chunk up to the first fault; return the data and the fault, which is empty if there is none."""
    if compression == "":
        return data, ""
    try:
        if compression == "zstd":
            import zstandard

            with zstandard.ZstdDecompressor().stream_reader(data) as reader:
                return _read(reader, size)
        if compression == "lz4":
            import lz4.frame

            with lz4.frame.LZ4FrameFile(BytesIO(data)) as reader:
                return _read(reader, size)
    except ModuleNotFoundError as error:
        raise MissingExtra(str(error.name).partition(".")[0], "recordings") from None
    return b"", f"unknown compression {compression!r}; supported: zstd, lz4"


def _read(reader: Any, size: int) -> tuple[bytes, str]:
    """Read at most `size` bytes in parts, so that the data before a fault is kept."""
    parts, left = [], size
    try:
        while left and (part := reader.read(min(left, 1 << 16))):
            parts.append(part)
            left -= len(part)
    except (RuntimeError, EOFError, OSError, ValueError) as error:
        return b"".join(parts), f"cannot decompress this chunk: {error}"
    except Exception as error:  # ZstdError has no other base class
        if type(error).__name__ != "ZstdError":
            raise
        return b"".join(parts), f"cannot decompress this chunk: {error}"
    return b"".join(parts), ""


def _message_of(
    path: Path,
    where: str,
    opcode: int,
    body: bytes,
    found: Definitions,
    wanted: Collection[str],
    metadata: dict[str, dict[str, str]],
) -> Record | None:
    """Return the message of this record if its topic is wanted; add a schema, channel or metadata record to `found`."""
    if opcode == MESSAGE:
        if len(body) < MESSAGE_HEAD.size:
            raise BrokenRecording(path, where, "a message has no header")
        number, _, log_ns, publish_ns = MESSAGE_HEAD.unpack_from(body)
        channel = found.channels.get(number)
        if channel is None:
            raise BrokenRecording(path, where, f"a message refers to channel {number}, which no record defines")
        if channel.topic not in wanted:
            return None
        return Record(channel, log_ns, publish_ns, where, body[MESSAGE_HEAD.size :])
    if opcode in (SCHEMA, CHANNEL, METADATA):
        try:
            add_definition(opcode, body, found, metadata)
        except record_errors() as error:
            raise BrokenRecording(path, where, f"cannot read this record: {error}") from None
    return None
