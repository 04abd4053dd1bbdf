"""Bag files: messages as bytes, in recorded order. This module reads ROS 2 SQLite files and folders of several files.

`mcap.py` and `ros1.py` read the other two containers. The package does not use the existing bag libraries: they open
only complete files and read nothing from a damaged one.
"""

import re
import sqlite3
from collections.abc import Callable, Collection, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, BinaryIO, Final, NamedTuple, Protocol, TypeVar

from neurove_core.io.errors import BrokenRecording, UnknownSource
from neurove_core.io.faults import Reason, Tally
from neurove_core.io.recording import BLOCK_BYTES
from neurove_core.io.unpack import unpacked

T = TypeVar("T")

SQLITE_MAGIC: Final = b"SQLite format 3\0"
ZSTD_MAGIC: Final = b"\x28\xb5\x2f\xfd"
MAX_RECORD_BYTES: Final = 64 << 20
"""Maximum size of one message or chunk [bytes], compressed and decompressed."""

_CHUNK_HEAD_BYTES: Final = 256

_MAX_STEP: Final = 1 << 20  # messages that are passed over after a damaged page


class BagMessage(NamedTuple):
    """One message that is not decoded."""

    topic: str
    log_ns: int  # record time on the recorder's clock [ns]
    where: str  # readable position in the file
    data: bytes


class BagFile(Protocol):
    """Interface of every container."""

    @property
    def path(self) -> Path:
        """Path of the file or folder."""

    @property
    def topics(self) -> dict[str, str]:
        """Message type of each topic, as `package/Name`."""

    @property
    def cdr(self) -> bool:
        """True for CDR messages (ROS 2), False for ROS 1 messages."""

    def messages(
        self, topics: Collection[str], since_ns: int | None = None, tally: Tally | None = None
    ) -> Iterator[BagMessage]:
        """Yield the messages of these topics in recorded order.

        A damaged message or chunk is skipped.

        Args:
            topics: names of the topics.
            since_ns: log time [ns]. A container with an index may skip messages before it.
            tally: counts what is skipped.

        Raises:
            BrokenRecording: the file cannot be read beyond a place. It is raised after all messages before it.
        """


def type_name(ros: str) -> str:
    """Return a message type without the `msg` part that ROS 2 adds.

    >>> type_name("sensor_msgs/msg/Imu")
    'sensor_msgs/Imu'
    """
    return ros.replace("/msg/", "/")


@dataclass(frozen=True, slots=True)
class SqliteBag:
    """A .db3 file written by rosbag2."""

    path: Path
    topics: dict[str, str]
    cdr: bool = True

    @classmethod
    def open(cls, path: Path) -> "SqliteBag":
        """Open the bag in this file.

        Raises:
            UnknownSource: the file is not a ROS 2 bag.
        """
        try:
            with _ReadConnection(path) as connection:
                _Work(connection, path.stat().st_size)
                rows = connection.execute("SELECT name, type FROM topics").fetchall()
        except sqlite3.Error as error:
            raise UnknownSource(path, f"not a ROS 2 bag: {error}") from None
        return cls(path, {str(name): type_name(str(kind)) for name, kind in rows})

    def messages(
        self, topics: Collection[str], since_ns: int | None = None, tally: Tally | None = None
    ) -> Iterator[BagMessage]:
        """See `BagFile`.

        Rows are read by number. The index of times is at the end of the file and is missing in a truncated file.
        """
        first = 0
        with _ReadConnection(self.path) as connection:
            _Work(connection, self.path.stat().st_size)
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
            work = _Work(connection, self.path.stat().st_size)
            for row in self._rows(connection, work, query, first, topics, tally):
                number, topic, log_ns, data = row
                where = f"message {number}"
                if not isinstance(data, bytes) or not isinstance(log_ns, int):
                    damaged(tally, where, "this row is not a message")
                    continue
                plain, why = decompressed(data)
                if why:
                    damaged(tally, where, why)
                else:
                    yield BagMessage(topic, log_ns, where, plain)

    def _rows(
        self,
        connection: sqlite3.Connection,
        work: "_Work",
        query: str,
        first: int,
        topics: Collection[str],
        tally: Tally | None,
    ) -> Iterator[Any]:
        """Rows of the query. After a damaged page it continues with a later row, at growing distance."""
        last, step = first - 1, 1
        error: BrokenRecording | None = None
        while step < _MAX_STEP:
            found = False
            work.restart()
            try:
                rows = _checked(self.path, max(last, 0), partial(connection.execute, query, (last + step, *topics)))
                while (row := _checked(self.path, max(last, 0), rows.fetchone)) is not None:
                    if error is not None:
                        damaged(tally, error.where, error.why)
                    if not isinstance(row[0], int):
                        raise BrokenRecording(self.path, f"the message after message {last}", "it has no number")
                    if row[0] <= last:  # damaged pages can repeat
                        why = f"message {row[0]} follows message {last}: the numbers must increase"
                        raise BrokenRecording(self.path, f"the message after message {last}", why)
                    last, step, error, found = row[0], 1, None, True
                    work.restart()
                    yield row
            except BrokenRecording as broken:
                error = error or broken
                step = 1 if found else 2 * step
                continue
            break
        if error is not None:
            raise error


class _ReadConnection:
    """A read-only connection that closes at the end of the block."""

    def __init__(self, path: Path) -> None:
        # SQLite opens a file on a read-only disk only as immutable, but then it ignores the write-ahead log
        immutable = "" if path.with_name(path.name + "-wal").exists() else "&immutable=1"
        self._connection = sqlite3.connect(f"{path.absolute().as_uri()}?mode=ro{immutable}", uri=True)
        self._connection.execute("PRAGMA writable_schema=ON")  # without it SQLite reads nothing from a truncated file

    def __enter__(self) -> sqlite3.Connection:
        return self._connection

    def __exit__(self, *_: object) -> None:
        self._connection.close()


class _Work:
    """Interrupts SQLite where it searches a row for too long: damaged pages can repeat.

    Args:
        connection: the connection to watch.
        size: of the file [bytes]. A row takes more bytes than SQLite takes instructions to pass it.
    """

    _STEP = 10_000  # instructions between two looks

    def __init__(self, connection: sqlite3.Connection, size: int) -> None:
        self._limit, self._done = 1_000_000 + 2 * size, 0
        connection.set_progress_handler(self._look, self._STEP)

    def restart(self) -> None:
        """Begin again: a row was found."""
        self._done = 0

    def _look(self) -> int:
        self._done += self._STEP
        return int(self._done > self._limit)


def _checked(path: Path, last: int, call: Callable[[], T]) -> T:
    """Run an SQLite call; `last` is the number of the last message that was read."""
    try:
        return call()
    except sqlite3.Error as error:
        raise BrokenRecording(path, f"the message after message {last}", str(error)) from None


def damaged(tally: Tally | None, where: str, why: str) -> None:
    """Count a message or a chunk that is skipped."""
    if tally is not None:
        tally.add(Reason.DAMAGED, where, why)


def find_next(file: BinaryIO, pattern: re.Pattern[bytes], at: int, accept: Callable[[int], bool]) -> int:
    """Search a file for the next record that begins like a chunk.

    Args:
        file: the file.
        pattern: matches the beginning of a chunk, at most _CHUNK_HEAD_BYTES long.
        at: first byte to search.
        accept: whether a chunk can begin at this byte.

    Returns:
        Its byte; 0 if there is none.
    """
    while True:
        file.seek(at)
        block = file.read(BLOCK_BYTES)
        for match in pattern.finditer(block):
            if accept(at + match.start()):
                return at + match.start()
        if len(block) < BLOCK_BYTES:
            return 0
        at += len(block) - _CHUNK_HEAD_BYTES  # a match may lie across two blocks


def decompressed(data: bytes) -> tuple[bytes, str]:
    """Decompress a message that rosbag2 compressed on its own; return any other message unchanged.

    CDR begins with a zero and ROS 1 begins with a small number. Neither matches the first bytes of zstd.

    Returns:
        The message, and what is wrong with it: it cannot be decompressed, or it is larger than `MAX_RECORD_BYTES`.

    Raises:
        MissingExtra: zstandard is not installed.
    """
    if not data.startswith(ZSTD_MAGIC):
        return data, ""
    plain, why = unpacked("zstd", data, MAX_RECORD_BYTES + 1)
    if len(plain) > MAX_RECORD_BYTES:
        why = f"the message has more than {MAX_RECORD_BYTES} bytes"
    return plain, why


@dataclass(frozen=True, slots=True)
class BagFolder:
    """A rosbag2 folder, read one file after the other."""

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

    def messages(
        self, topics: Collection[str], since_ns: int | None = None, tally: Tally | None = None
    ) -> Iterator[BagMessage]:
        """See `BagFile`. A file that cannot be read to its end is damage; the next file follows."""
        for file in self.files:
            inner = None if tally is None else Tally(tally.stream)
            try:
                for message in file.messages(topics, since_ns, inner):
                    yield message._replace(where=f"{message.where} of {file.path.name}")
            except BrokenRecording as error:
                if file is self.files[-1]:
                    raise BrokenRecording(self.path, f"{error.where} of {file.path.name}", error.why) from None
                damaged(tally, f"{error.where} of {file.path.name}", error.why)
            if inner is not None and tally is not None:
                for fault in inner.faults:
                    tally.add(fault.reason, f"{fault.where} of {file.path.name}", fault.why, fault.count)


def in_recorded_order(folder: Path) -> list[Path]:
    """Return the .db3 or .mcap files of a rosbag2 folder, sorted by the number at the end of their names.

    The recorder writes that number. metadata.yaml is not used: it is missing if the recorder was killed, and it is
    wrong if a file was renamed.

    Raises:
        UnknownSource: the folder has no such file.
    """
    files = [path for path in folder.iterdir() if re.search(r"\.(db3|mcap)(\.zstd)?$", path.name)]
    if not files:
        raise UnknownSource(folder, "the folder has no .db3 or .mcap file")
    number = re.compile(r"_(\d+)\.(?:db3|mcap)")
    return sorted(files, key=lambda path: (int((number.findall(path.name) or [-1])[-1]), path.name))
