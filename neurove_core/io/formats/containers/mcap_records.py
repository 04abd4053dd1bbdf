"""MCAP records that describe other records: schemas, channels, metadata, and the index at the end of the file.

The `mcap` package parses them. A file has few of them. Source: mcap.dev/spec.
"""

import struct
from dataclasses import dataclass, field
from io import BytesIO
from typing import Any, BinaryIO, Final, NamedTuple

from neurove_core.extras import MissingExtra
from neurove_core.io.formats.containers.bags import MAX_RECORD_BYTES

MAGIC: Final = b"\x89MCAP0\r\n"
HEADER, FOOTER, SCHEMA, CHANNEL, MESSAGE, CHUNK, _CHUNK_INDEX, METADATA, DATA_END = 1, 2, 3, 4, 5, 6, 8, 0xC, 15
RECORD = struct.Struct("<BQ")  # opcode, length of the content [bytes]
MESSAGE_HEAD = struct.Struct("<HIQQ")  # channel, sequence, log time, publish time [ns]
CHUNK_HEAD = struct.Struct("<QQQII")  # first and last log time [ns], size [bytes], CRC, length of compression name
_FOOTER_BYTES = RECORD.size + 20 + len(MAGIC)


class Channel(NamedTuple):
    """Topic, schema and encoding of one channel."""

    topic: str
    schema: str
    encoding: str  # of the messages, for example `cdr`


class ChunkIndex(NamedTuple):
    """One chunk, as the index at the end of the file lists it."""

    start: int  # byte offset of its record
    end_ns: int  # last log time in the chunk [ns]
    channels: frozenset[int]


@dataclass(slots=True)
class Definitions:
    """Channels and schemas that were read so far."""

    channels: dict[int, Channel] = field(default_factory=dict)
    schemas: dict[int, str] = field(default_factory=dict)


class NoSummary(Exception):
    """The file has no index at its end."""


def length_at(file: BinaryIO, at: int) -> int:
    """Return the content length [bytes] of the record at this offset, and move the file to its first content byte."""
    file.seek(at)
    return int(RECORD.unpack(file.read(RECORD.size))[1])


def add_definition(opcode: int, body: bytes, found: Definitions, metadata: dict[str, dict[str, str]]) -> None:
    """Add the content of a schema or channel record to `found`, or that of a metadata record to `metadata`.

    Raises:
        Any of `record_errors()`: the record is corrupt. MissingExtra: mcap is not installed.
    """
    records, stream = _parser(body)
    if opcode == SCHEMA:
        schema = records.Schema.read(stream)
        found.schemas[schema.id] = schema.name
    elif opcode == CHANNEL:
        channel = records.Channel.read(stream)
        schema_name = found.schemas.get(channel.schema_id, "")
        found.channels.setdefault(channel.id, Channel(channel.topic, schema_name, channel.message_encoding))
    else:
        one = records.Metadata.read(stream)
        metadata[one.name] = dict(one.metadata)


def _parser(body: bytes) -> tuple[Any, Any]:
    try:
        from mcap import records
        from mcap.data_stream import ReadDataStream
    except ModuleNotFoundError:
        raise MissingExtra("mcap", "recordings") from None
    return records, ReadDataStream(BytesIO(body))


def record_errors() -> tuple[type[Exception], ...]:
    """Return the errors that the `mcap` package raises for corrupt records."""
    from mcap.exceptions import McapError

    return (McapError, struct.error, ValueError, IndexError, OSError, OverflowError)


def summary(file: BinaryIO) -> tuple[Definitions, tuple[ChunkIndex, ...], dict[str, dict[str, str]]]:
    """Read the index at the end of the file.

    Returns:
        Definitions, chunks in recorded order, and metadata by name.

    Raises:
        NoSummary: the file has no index, or the index is corrupt.
    """
    size = file.seek(0, 2)
    file.seek(max(0, size - _FOOTER_BYTES))
    tail = file.read()
    if len(tail) < _FOOTER_BYTES or not tail.endswith(MAGIC) or tail[0] != FOOTER:
        raise NoSummary
    (start,) = struct.unpack_from("<Q", tail, RECORD.size)
    stop = size - _FOOTER_BYTES
    if not 0 < start <= stop or stop - start > MAX_RECORD_BYTES:
        raise NoSummary
    file.seek(start)
    data = file.read(stop - start)
    found, chunks, offsets = Definitions(), [], []
    at = 0
    while at + RECORD.size <= len(data):
        opcode, length = RECORD.unpack_from(data, at)
        body = data[at + RECORD.size : at + RECORD.size + length]
        at += RECORD.size + length
        try:
            if opcode in (SCHEMA, CHANNEL):
                add_definition(opcode, body, found, {})
            elif opcode == _CHUNK_INDEX:
                records, stream = _parser(body)
                chunk = records.ChunkIndex.read(stream)
                ids = frozenset(chunk.message_index_offsets)
                chunks.append(ChunkIndex(chunk.chunk_start_offset, chunk.message_end_time, ids))
            elif opcode == METADATA + 1:
                records, stream = _parser(body)
                offsets.append(records.MetadataIndex.read(stream).offset)
        except record_errors():
            raise NoSummary from None
    if any(chunk.start >= start for chunk in chunks):
        raise NoSummary
    return found, tuple(sorted(chunks)), _metadata(file, offsets)


def _metadata(file: BinaryIO, offsets: list[int]) -> dict[str, dict[str, str]]:
    metadata: dict[str, dict[str, str]] = {}
    for at in offsets:
        try:
            length = length_at(file, at)
            if length <= MAX_RECORD_BYTES:
                add_definition(METADATA, file.read(length), Definitions(), metadata)
        except record_errors():
            raise NoSummary from None
    return metadata
