"""MCAP files: messages as bytes, of files that are whole or cut. Source: mcap.dev/spec.

The records are walked here, for the `mcap` package reads a file without an end from memory, or not at all, and does not
say at which byte it failed; the few records of the index are parsed by it.
"""

import zlib
from collections.abc import Collection, Iterator
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple, Self

from neurove_core.extras import MissingExtra
from neurove_core.io.errors import BrokenRecording, UnknownSource
from neurove_core.io.formats.containers.bags import MAX_RECORD_BYTES, BagMessage, type_name, unpacked
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
    Found,
    NoSummary,
    bad_record,
    length_at,
    note,
    summary,
)


class Record(NamedTuple):
    """One message and where it stands."""

    channel: Channel
    log_ns: int
    publish_ns: int
    where: str
    data: bytes


@dataclass(frozen=True, slots=True)
class McapFile:
    """An .mcap file."""

    path: Path
    profile: str
    channels: dict[int, Channel]
    chunks: tuple[ChunkIndex, ...]  # in the order recorded; empty where the file has no index
    metadata: dict[str, dict[str, str]]

    @classmethod
    def open(cls, path: Path) -> Self:
        """The file; where it has no index at its end, it is read once to learn of its channels.

        Raises:
            UnknownSource: it is no MCAP file. MissingExtra: the package that parses its index is not here.
        """
        with path.open("rb") as file:
            if file.read(len(MAGIC)) != MAGIC:
                raise UnknownSource(path, "the file does not begin as MCAP does")
            head = RECORD.unpack(file.read(RECORD.size).ljust(RECORD.size, b"\0"))
            if head[0] != HEADER or not 4 <= head[1] <= 1 << 16:
                raise UnknownSource(path, "the file has no MCAP header")
            body = file.read(head[1])
            profile = body[4 : 4 + int.from_bytes(body[:4], "little")].decode("utf-8", "replace")
            try:
                found, chunks, metadata = summary(file)
            except NoSummary:
                found, chunks, metadata = Found(), (), {}
        if not found.channels:
            self = cls(path, profile, {}, (), {})
            try:
                for _ in self._walk(found, frozenset(), metadata):
                    pass
            except BrokenRecording:  # told when it is read
                pass
        return cls(path, profile, found.channels, chunks, metadata)

    @property
    def topics(self) -> dict[str, str]:
        """See `BagFile`."""
        return {channel.topic: type_name(channel.schema) for channel in self.channels.values()}

    @property
    def cdr(self) -> bool:
        """Whether messages are CDR; else ROS 1's."""
        return not any(channel.encoding == "ros1" for channel in self.channels.values())

    def messages(self, topics: Collection[str], since_ns: int | None = None) -> Iterator[BagMessage]:
        """See `BagFile`."""
        skip = 0
        if since_ns is not None:
            while skip < len(self.chunks) and self.chunks[skip].end_ns < since_ns:
                skip += 1
        for record in self.records(topics, skip):
            data = unpacked(self.path, record.where, record.data)
            yield BagMessage(record.channel.topic, record.log_ns, record.where, data)

    def records(self, topics: Collection[str], first_chunk: int = 0) -> Iterator[Record]:
        """The messages of these topics, in the order recorded.

        Args:
            topics: which.
            first_chunk: number in `chunks` of the one to begin with.

        Raises:
            BrokenRecording: after everything whole was handed out; it names the byte.
        """
        wanted = frozenset(topics)
        start = len(MAGIC)
        if first_chunk:
            last = first_chunk >= len(self.chunks)
            start = self.path.stat().st_size if last else self.chunks[first_chunk].start
            if last:
                return
        return (yield from self._walk(Found(dict(self.channels)), wanted, {}, start))

    def first_in_chunk(self, topic: str, chunk: int) -> Record | None:
        """The first message of a topic in one chunk of the index."""
        with self.path.open("rb") as file:
            at = self.chunks[chunk].start
            file.seek(at + RECORD.size)
            body, whole = _body(self.path, file, at, length_at(file, at))
            return next(_in_chunk(self.path, at, body, Found(dict(self.channels)), {topic}, whole), None)

    def chunks_of(self, topic: str) -> list[int]:
        """Numbers of the chunks that hold messages of a topic; all, where the index does not tell."""
        ids = {key for key, channel in self.channels.items() if channel.topic == topic}
        return [i for i, chunk in enumerate(self.chunks) if not chunk.channels or ids & chunk.channels]

    def _walk(
        self, found: Found, wanted: Collection[str], metadata: dict[str, dict[str, str]], start: int = len(MAGIC)
    ) -> Iterator[Record]:
        with self.path.open("rb") as file:
            size = file.seek(0, 2)
            at = file.seek(start)
            while True:
                head = file.read(RECORD.size)
                if len(head) < RECORD.size:
                    raise BrokenRecording(self.path, f"byte {at}", "the file ends before its records do")
                opcode, length = RECORD.unpack(head)
                if opcode in (DATA_END, FOOTER):
                    return
                if opcode in (CHUNK, MESSAGE, SCHEMA, CHANNEL, METADATA):
                    body, whole = _body(self.path, file, at, length)
                    if opcode == CHUNK:
                        yield from _in_chunk(self.path, at, body, found, wanted, whole)
                    elif whole and (record := _taken(self.path, f"byte {at}", opcode, body, found, wanted, metadata)):
                        yield record
                    if not whole:
                        raise BrokenRecording(self.path, f"byte {at}", "the file ends within this record")
                after = at + RECORD.size + length
                if after > size:
                    raise BrokenRecording(self.path, f"byte {at}", "the file ends within this record")
                at = file.seek(after)


def _body(path: Path, file: BinaryIO, at: int, length: int) -> tuple[bytes, bool]:
    """What of a record's bytes the file has, and whether that is all of them."""
    if length > MAX_RECORD_BYTES:
        raise BrokenRecording(path, f"byte {at}", f"a record of {length} bytes; at most {MAX_RECORD_BYTES} are read")
    body = file.read(length)
    return body, len(body) == length


def _in_chunk(path: Path, at: int, body: bytes, found: Found, wanted: Collection[str], whole: bool) -> Iterator[Record]:
    """The messages of one chunk; of one that was cut, those that are whole."""
    where = f"byte {at}"
    if len(body) < CHUNK_HEAD.size:
        raise BrokenRecording(path, where, "the file ends within this chunk's head")
    _, _, size, crc, name = CHUNK_HEAD.unpack_from(body)
    start = CHUNK_HEAD.size + name + 8
    compression = body[CHUNK_HEAD.size : start - 8].decode("ascii", "replace")
    if size > MAX_RECORD_BYTES:
        raise BrokenRecording(path, where, f"a chunk of {size} bytes; at most {MAX_RECORD_BYTES} are read")
    data, why = _plain(compression, body[start:], size)
    if not why and len(data) != size and whole:
        why = f"this chunk holds {len(data)} bytes instead of {size}"
    if not why and whole and crc and zlib.crc32(data) != crc:
        why = "this chunk's checksum is wrong"  # which of its messages is bad nobody knows
        data = b""
    inside = 0
    while inside + RECORD.size <= len(data):
        opcode, length = RECORD.unpack_from(data, inside)
        stop = inside + RECORD.size + length
        if stop > len(data):
            why = why or "a record reaches over the end of this chunk"
            break
        place = f"byte {inside} of the chunk at {where}"
        record = _taken(path, place, opcode, data[inside + RECORD.size : stop], found, wanted, {})
        if record:
            yield record
        inside = stop
    if not whole:
        why = "the file ends within this chunk"
    if why:
        raise BrokenRecording(path, where, why)


def _plain(compression: str, data: bytes, size: int) -> tuple[bytes, str]:
    """What a chunk's bytes decompress to, as far as they do, and what is wrong where they do not."""
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
    return b"", f"compression {compression!r} is not known; zstd and lz4 are"


def _read(reader: Any, size: int) -> tuple[bytes, str]:
    """At most this many bytes, piece by piece: what came before a fault is kept."""
    parts, left = [], size
    try:
        while left and (part := reader.read(min(left, 1 << 16))):
            parts.append(part)
            left -= len(part)
    except (RuntimeError, EOFError, OSError, ValueError) as error:
        return b"".join(parts), f"this chunk can not be decompressed: {error}"
    except Exception as error:  # zstandard's own has no other base
        if type(error).__name__ != "ZstdError":
            raise
        return b"".join(parts), f"this chunk can not be decompressed: {error}"
    return b"".join(parts), ""


def _taken(
    path: Path,
    where: str,
    opcode: int,
    body: bytes,
    found: Found,
    wanted: Collection[str],
    metadata: dict[str, dict[str, str]],
) -> Record | None:
    """The message of this record, if it is one of a wanted topic; of another kind what it tells is noted."""
    if opcode == MESSAGE:
        if len(body) < MESSAGE_HEAD.size:
            raise BrokenRecording(path, where, "a message without a head")
        number, _, log_ns, publish_ns = MESSAGE_HEAD.unpack_from(body)
        channel = found.channels.get(number)
        if channel is None:
            raise BrokenRecording(path, where, f"a message of channel {number}, which was never described")
        if channel.topic not in wanted:
            return None
        return Record(channel, log_ns, publish_ns, where, body[MESSAGE_HEAD.size :])
    if opcode in (SCHEMA, CHANNEL, METADATA):
        try:
            note(opcode, body, found, metadata)
        except bad_record() as error:
            raise BrokenRecording(path, where, f"this record can not be read: {error}") from None
    return None
