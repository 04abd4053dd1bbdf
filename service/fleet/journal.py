"""The journal of a rollout: one JSON object a line, appended and synced before what it says is done."""

import fcntl
import json
import os
from collections.abc import Mapping
from datetime import UTC, datetime
from pathlib import Path
from types import TracebackType
from typing import Any, Final, Self

from neurove_protocol.errors import InvalidField

FORMAT: Final = 1
"""Version of the events of a journal, in its first line."""

MAX_BYTES: Final = 256 << 20
"""Largest journal that is read [bytes]."""

Event = Mapping[str, Any]
"""One line: `event` names its kind, `at` is its time (UTC, ISO 8601); the other fields depend on the kind."""


def check_new(path: Path) -> None:
    """Refuse a file that cannot become a new journal, before there is something to write.

    Raises:
        InvalidField: it exists, or its folder does not.
    """
    if path.exists():
        raise _exists(path)
    if not path.parent.is_dir():
        raise InvalidField("rollout", "--journal", str(path), "its folder does not exist")


def _exists(path: Path) -> InvalidField:
    return InvalidField("rollout", "--journal", str(path), "the file exists; --resume goes on with a journal")


class Journal:
    """An open journal; one process at a time has it.

    A line that a killed process left incomplete is not an event: it is removed when the journal is opened.

    Args:
        path: the file.
        new: whether to create it; it must not exist then.

    Raises:
        InvalidField: it exists though it is new; another process has it; it is no journal.
        OSError: it cannot be opened.
    """

    def __init__(self, path: Path, *, new: bool) -> None:
        self.path = path
        flags = os.O_RDWR | os.O_APPEND | (os.O_CREAT | os.O_EXCL if new else 0)
        try:
            self._file = os.open(path, flags, 0o644)
        except FileExistsError:
            raise _exists(path) from None
        try:
            self._lock()
            self.events = _read(path)
            _truncate(self._file, path)
        except BaseException:
            os.close(self._file)
            raise
        if new:
            _sync_folder(path)

    def _lock(self) -> None:
        try:
            fcntl.flock(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            raise InvalidField("rollout", "--resume", str(self.path), "another rollout uses this journal") from None

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        os.close(self._file)

    def append(self, event: str, fields: Event) -> dict[str, Any]:
        """Write an event and wait until the disk has it.

        Args:
            event: its kind.
            fields: its other fields.

        Returns:
            the event as it was written.

        Raises:
            OSError: it cannot be written.
        """
        line = {"at": datetime.now(UTC).isoformat(timespec="milliseconds"), "event": event, **fields}
        data = (json.dumps(line) + "\n").encode()
        while data:
            data = data[os.write(self._file, data) :]
        os.fsync(self._file)
        return line


def _complete(path: Path) -> bytes:
    """The content up to the last end of a line."""
    if path.stat().st_size > MAX_BYTES:
        raise InvalidField("rollout", "--resume", str(path), f"a journal has at most {MAX_BYTES >> 20} MiB")
    content = path.read_bytes()
    return content[: content.rfind(b"\n") + 1]


def _read(path: Path) -> list[Event]:
    events: list[Event] = []
    for number, line in enumerate(_complete(path).splitlines(), 1):
        try:
            event = json.loads(line)
            if not isinstance(event["event"], str):
                raise TypeError
        except (ValueError, TypeError, KeyError):
            raise InvalidField("rollout", "--resume", f"{path}, line {number}", "is not an event") from None
        events.append(event)
    return events


def _truncate(file: int, path: Path) -> None:
    complete = len(_complete(path))
    if complete < path.stat().st_size:
        os.ftruncate(file, complete)
        os.fsync(file)


def _sync_folder(path: Path) -> None:
    folder = os.open(path.parent, os.O_RDONLY)
    try:
        os.fsync(folder)
    finally:
        os.close(folder)
