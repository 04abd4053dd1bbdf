"""Bag files: messages as bytes in the order they were recorded, of ROS 2 SQLite files and of folders of several files.

`mcap_file.py` and `ros1_file.py` give the same for the other two containers. No library reads the files: those there
are open a file only as a whole, so of a broken one they give nothing.
"""

import re
import sqlite3
from collections.abc import Callable, Collection, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Final, NamedTuple, Protocol, TypeVar

from neurove_core.extras import MissingExtra
from neurove_core.io.errors import BrokenRecording, UnknownSource

T = TypeVar("T")

ZSTD_MAGIC: Final = b"\x28\xb5\x2f\xfd"
MAX_RECORD_BYTES: Final = 64 << 20
"""Cap of one message or chunk, before and after it is decompressed."""


class BagMessage(NamedTuple):
    """One message, not decoded."""

    topic: str
    log_ns: int  # when it was recorded: the recorder's clock [ns]
    where: str  # in the file, for people
    data: bytes


class BagFile(Protocol):
    """What every container answers."""

    @property
    def path(self) -> Path:
        """Where it lies."""

    @property
    def topics(self) -> dict[str, str]:
        """Type of each topic, as `package/Name`."""

    @property
    def cdr(self) -> bool:
        """Whether messages are CDR, as in ROS 2, or ROS 1."""

    def messages(self, topics: Collection[str], since_ns: int | None = None) -> Iterator[BagMessage]:
        """The messages of these topics, in the order recorded.

        Args:
            topics: which.
            since_ns: messages logged before this may be left out, where the container has an index.

        Raises:
            BrokenRecording: after everything whole was handed out.
        """


def type_name(ros: str) -> str:
    """A message type without the `msg` that ROS 2 puts in its middle.

    >>> type_name("sensor_msgs/msg/Imu")
    'sensor_msgs/Imu'
    """
    return ros.replace("/msg/", "/")


@dataclass(frozen=True, slots=True)
class SqliteBag:
    """A .db3 file of rosbag2."""

    path: Path
    topics: dict[str, str]
    cdr: bool = True

    @classmethod
    def open(cls, path: Path) -> "SqliteBag":
        """The bag in this file.

        Raises:
            UnknownSource: it is no such file.
        """
        try:
            with _connected(path) as connection:
                rows = connection.execute("SELECT name, type FROM topics").fetchall()
        except sqlite3.Error as error:
            raise UnknownSource(path, f"not a ROS 2 bag: {error}") from None
        return cls(path, {str(name): type_name(str(kind)) for name, kind in rows})

    def messages(self, topics: Collection[str], since_ns: int | None = None) -> Iterator[BagMessage]:
        """See `BagFile`. By row, not by the index of times, which lies at the end and is lost when the file is cut."""
        first, done = 0, 0
        with _connected(self.path) as connection:
            if since_ns is not None:
                query = "SELECT min(id) FROM messages WHERE timestamp >= ?"
                (found,) = _checked(
                    self.path, 0, lambda: connection.execute(query, (min(since_ns, (1 << 63) - 1),)).fetchone()
                )
                first = found if found is not None else 1 << 62
            query = (
                "SELECT m.id, t.name, m.timestamp, m.data FROM messages m JOIN topics t ON t.id = m.topic_id "
                f"WHERE m.id >= ? AND t.name IN ({','.join('?' * len(topics))}) ORDER BY m.id"
            )
            rows = _checked(self.path, 0, lambda: connection.execute(query, (first, *topics)))
            while (row := _checked(self.path, done, rows.fetchone)) is not None:
                number, topic, log_ns, data = row
                done = int(number)
                where = f"message {number}"
                if not isinstance(data, bytes) or not isinstance(log_ns, int):
                    raise BrokenRecording(self.path, where, "it is no message")
                yield BagMessage(topic, log_ns, where, unpacked(self.path, where, data))


class _connected:  # noqa: N801  # reads as the verb that it is
    """A connection for reading, closed with the block."""

    def __init__(self, path: Path) -> None:
        # a file on a disk that can not be written must be told immutable, but then changes in its log are not seen
        alone = "" if path.with_name(path.name + "-wal").exists() else "&immutable=1"
        self._connection = sqlite3.connect(f"{path.absolute().as_uri()}?mode=ro{alone}", uri=True)
        self._connection.execute("PRAGMA writable_schema=ON")  # else SQLite gives nothing at all of a file that was cut

    def __enter__(self) -> sqlite3.Connection:
        return self._connection

    def __exit__(self, *_: object) -> None:
        self._connection.close()


def _checked(path: Path, done: int, call: Callable[[], T]) -> T:
    try:
        return call()
    except sqlite3.Error as error:
        raise BrokenRecording(path, f"the message after message {done}", str(error)) from None


def unpacked(path: Path, where: str, data: bytes) -> bytes:
    """A message that rosbag2 compressed by itself, as it was before; others as they are.

    CDR begins with a zero and ROS 1 with a small number, so that the first bytes of zstd are neither.

    Raises:
        BrokenRecording: it can not be decompressed. MissingExtra: the library for it is not here.
    """
    if not data.startswith(ZSTD_MAGIC):
        return data
    try:
        import zstandard
    except ModuleNotFoundError:
        raise MissingExtra("zstandard", "recordings") from None
    try:
        reader = zstandard.ZstdDecompressor().stream_reader(data)
        plain = reader.read(MAX_RECORD_BYTES + 1)
    except zstandard.ZstdError as error:
        raise BrokenRecording(path, where, str(error)) from None
    if len(plain) > MAX_RECORD_BYTES:
        raise BrokenRecording(path, where, f"a message has at most {MAX_RECORD_BYTES} bytes")
    return plain


@dataclass(frozen=True, slots=True)
class BagFolder:
    """A folder of rosbag2: one file after the other."""

    path: Path
    files: tuple[BagFile, ...]

    @property
    def topics(self) -> dict[str, str]:
        """See `BagFile`."""
        return {name: kind for file in self.files for name, kind in file.topics.items()}

    @property
    def cdr(self) -> bool:
        """See `BagFile`."""
        return self.files[0].cdr

    def messages(self, topics: Collection[str], since_ns: int | None = None) -> Iterator[BagMessage]:
        """See `BagFile`."""
        for file in self.files:
            for message in file.messages(topics, since_ns):
                yield message._replace(where=f"{message.where} of {file.path.name}")


def in_recorded_order(folder: Path) -> list[Path]:
    """The .db3 or .mcap files of a rosbag2 folder, by the number that the recorder put at the end of their names.

    Not by metadata.yaml, which is missing where the recorder was killed and wrong where a file was renamed.

    Raises:
        UnknownSource: there are none.
    """
    files = [path for path in folder.iterdir() if path.suffix in (".db3", ".mcap")]
    if not files:
        packed = any(path.suffix == ".zstd" for path in folder.iterdir())
        why = "its files are compressed as a whole: `zstd -d` them" if packed else "the folder has no .db3 or .mcap"
        raise UnknownSource(folder, why)
    return sorted(files, key=lambda path: (int((re.findall(r"_(\d+)$", path.stem) or [-1])[0]), path.name))
