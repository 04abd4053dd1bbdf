"""McapWriter: an MCAP file that gets its name when it is complete."""

import contextlib
import os
from collections.abc import Iterator, Mapping
from pathlib import Path
from types import TracebackType
from typing import Any, Final, NamedTuple, Self

from neurove_core.extras import MissingExtra
from neurove_protocol.errors import InvalidField

CHUNK_BYTES: Final = 1 << 20
"""Size of one compressed chunk [bytes]; at most this much is lost if the machine fails."""

PART: Final = ".part"
"""Suffix of the file name until the file is complete."""


class ChannelKind(NamedTuple):
    """What the messages of a channel are."""

    schema: str
    encoding: str  # of the messages
    schema_encoding: str = ""
    definition: str = ""


class McapWriter:
    """Writes one file atomically. Use it in a `with` block: an error in the block removes the partial file.

    Memory holds one chunk, and about 100 bytes of index for each chunk written.

    Args:
        path: the file, with suffix .mcap; an existing file of this name is replaced.
        profile: of the file.

    Raises:
        InvalidField: the file cannot be written; also raised while writing. MissingExtra: mcap is not installed.
    """

    def __init__(self, path: Path, profile: str) -> None:
        try:
            from mcap.writer import CompressionType, Writer
        except ModuleNotFoundError:
            raise MissingExtra("mcap", "recordings") from None
        if path.suffix != ".mcap":
            raise InvalidField("recording", "FILE", str(path), "its name must end in .mcap")
        self.path, self._part = path, path.with_name(path.name + PART)
        with self._os_errors_as_invalid():
            try:
                self._file = self._part.open("xb")
            except FileExistsError:
                why = "an incomplete recording, or one that is being written, has this name: rename or remove it"
                raise InvalidField("recording", "FILE", str(self._part), why) from None
        self._writer: Any = Writer(self._file, CHUNK_BYTES, CompressionType.ZSTD)
        self._writer.start(profile, "neurove")
        self._channels: dict[str, int] = {}
        self._schemas: dict[str, int] = {}
        self._count: dict[int, int] = {}

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if kind is None:
            self.close()
        else:
            self.abandon()

    def message(self, topic: str, kind: ChannelKind, payload: bytes, log_ns: int) -> None:
        """Add a message.

        Args:
            topic: name of the channel.
            kind: of its messages; of each topic always the same.
            payload: bytes of the message; they are not checked.
            log_ns: log time [ns]; a negative time is stored as 0.
        """
        with self._os_errors_as_invalid():
            if topic not in self._channels:
                self._channels[topic] = self._registered(topic, kind)
            channel = self._channels[topic]
            number = self._count[channel] = self._count.get(channel, 0) + 1
            log_ns = max(0, log_ns)
            self._writer.add_message(channel, log_ns, payload, log_ns, number & 0xFFFFFFFF)

    def _registered(self, topic: str, kind: ChannelKind) -> int:
        if kind.schema not in self._schemas:
            made = self._writer.register_schema(kind.schema, kind.schema_encoding, kind.definition.encode())
            self._schemas[kind.schema] = made
        return int(self._writer.register_channel(topic, kind.encoding, self._schemas[kind.schema]))

    def metadata(self, name: str, entries: Mapping[str, object]) -> None:
        """Add a metadata record; values are stored as text."""
        with self._os_errors_as_invalid():
            self._writer.add_metadata(name, {key: str(value) for key, value in entries.items()})

    @property
    def bytes_written(self) -> int:
        """Current size of the file [bytes]."""
        return self._file.tell()

    def close(self) -> None:
        """Complete the file and rename it to its final name."""
        try:
            with self._os_errors_as_invalid():
                self._writer.finish()
                self._file.flush()
                os.fsync(self._file.fileno())
                self._file.close()
                self._part.replace(self.path)
        except BaseException:
            self.abandon()
            raise

    def abandon(self) -> None:
        """Close and remove the incomplete file."""
        with contextlib.suppress(OSError):
            self._file.close()
        self._part.unlink(missing_ok=True)

    @contextlib.contextmanager
    def _os_errors_as_invalid(self) -> Iterator[None]:
        """Raise InvalidField instead of OSError in the block."""
        try:
            yield
        except OSError as error:
            raise InvalidField("recording", "FILE", str(self.path), error.strerror or str(error)) from None
