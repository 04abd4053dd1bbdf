"""Records of MCAP files that describe others: schemas, channels, metadata, and the index at the end.

The `mcap` package parses them; they are few. Source: mcap.dev/spec.
"""

import struct
from dataclasses import dataclass, field
from io import BytesIO
from typing import Any, BinaryIO, Final, NamedTuple

from neurove_core.extras import MissingExtra
from neurove_core.io.formats.containers.bags import MAX_RECORD_BYTES

MAGIC: Final = b"\x89MCAP0\r\n"
HEADER, FOOTER, SCHEMA, CHANNEL, MESSAGE, CHUNK, _CHUNK_INDEX, METADATA, DATA_END = 1, 2, 3, 4, 5, 6, 8, 0xC, 15
RECORD = struct.Struct("<BQ")  # opcode, length of what follows
MESSAGE_HEAD = struct.Struct("<HIQQ")  # channel, sequence, log time, publish time [ns]
CHUNK_HEAD = struct.Struct("<QQQII")  # first and last log time [ns], size [bytes], crc, length of compression's name
_FOOTER_BYTES = RECORD.size + 20 + len(MAGIC)


class Channel(NamedTuple):
    """What the messages of one channel are."""

    topic: str
    schema: str
    encoding: str  # of messages, such as `cdr`


class ChunkIndex(NamedTuple):
    """One chunk, as the index at the end of the file tells it."""

    start: int  # byte of its record
    end_ns: int  # last log time in it
    channels: frozenset[int]


@dataclass(slots=True)
class Found:
    """What a walk has learned so far."""

    channels: dict[int, Channel] = field(default_factory=dict)
    schemas: dict[int, str] = field(default_factory=dict)


class NoSummary(Exception):
    """The file has no index at its end."""


def length_at(file: BinaryIO, at: int) -> int:
    """How many bytes follow the head of the record at this byte; the file then stands at the first of them."""
    file.seek(at)
    return int(RECORD.unpack(file.read(RECORD.size))[1])


def note(opcode: int, body: bytes, found: Found, metadata: dict[str, dict[str, str]]) -> None:
    """Take in what a schema, channel or metadata record tells; see `bad_record` for what this raises."""
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


def bad_record() -> tuple[type[Exception], ...]:
    """What the package raises over records that are garbled."""
    from mcap.exceptions import McapError

    return (McapError, struct.error, ValueError, IndexError, OSError, OverflowError)


def summary(file: BinaryIO) -> tuple[Found, tuple[ChunkIndex, ...], dict[str, dict[str, str]]]:
    """What the index at the end of the file tells.

    Raises:
        NoSummary: there is none, or it is garbled.
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
    found, chunks, metadata = Found(), [], []
    at = 0
    while at + RECORD.size <= len(data):
        opcode, length = RECORD.unpack_from(data, at)
        body = data[at + RECORD.size : at + RECORD.size + length]
        at += RECORD.size + length
        try:
            if opcode in (SCHEMA, CHANNEL):
                note(opcode, body, found, {})
            elif opcode == _CHUNK_INDEX:
                records, stream = _parser(body)
                chunk = records.ChunkIndex.read(stream)
                ids = frozenset(chunk.message_index_offsets)
                chunks.append(ChunkIndex(chunk.chunk_start_offset, chunk.message_end_time, ids))
            elif opcode == METADATA + 1:
                records, stream = _parser(body)
                metadata.append(records.MetadataIndex.read(stream).offset)
        except bad_record():
            raise NoSummary from None
    if any(chunk.start >= start for chunk in chunks):
        raise NoSummary
    return found, tuple(sorted(chunks)), _metadata(file, metadata)


def _metadata(file: BinaryIO, places: list[int]) -> dict[str, dict[str, str]]:
    told: dict[str, dict[str, str]] = {}
    for at in places:
        try:
            length = length_at(file, at)
            if length <= MAX_RECORD_BYTES:
                note(METADATA, file.read(length), Found(), told)
        except bad_record():
            raise NoSummary from None
    return told
