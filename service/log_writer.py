"""LogWriter: log lines to a descriptor on a thread of its own. A reader that stops reading costs lines, never time."""

import os
import threading
import time
from collections import deque
from collections.abc import Callable
from typing import Final, NamedTuple, TextIO

MAX_LINES: Final = 1000
MAX_BYTES: Final = 1 << 20
"""Bounds of the queue; further lines are dropped and counted."""

_IDLE_S = 5.0
_PAUSE_S = 0.05  # where a descriptor does not block


class LogWriter:
    """Writes lines in order; any thread may add one and never waits for the descriptor.

    Args:
        stream: where to write to; its descriptor is used if it has one.
        tell: makes the line that says how many lines were dropped.
        idle: lines to write while nothing else is logged; asked every few seconds.
    """

    def __init__(self, stream: TextIO, tell: Callable[[int], str], idle: Callable[[], list[str]] = list) -> None:
        self._stream, self._tell, self._idle = stream, tell, idle
        self._encoding = getattr(stream, "encoding", None) or "utf-8"
        self._descriptor = _descriptor(stream)
        self._lines: deque[bytes] = deque()
        self._bytes = self._dropped = self._told = 0
        self._writing = False
        self._changed = threading.Condition()
        self._thread: threading.Thread | None = None

    @property
    def dropped(self) -> int:
        """Number of lines that were dropped since the start."""
        return self._dropped

    def add(self, line: str) -> None:
        """Queue a line, without its end."""
        data = self._encoded(line)
        with self._changed:
            if len(self._lines) >= MAX_LINES or self._bytes + len(data) > MAX_BYTES:
                self._dropped += 1
                return
            self._lines.append(data)
            self._bytes += len(data)
            if self._thread is None:
                self._thread = threading.Thread(target=self._run, name="log writer", daemon=True)
                self._thread.start()
            self._changed.notify_all()

    def flush(self, timeout_s: float) -> bool:
        """Wait until everything is written; False if it takes longer than this time [s]."""
        with self._changed:
            return self._changed.wait_for(lambda: not self._lines and not self._writing, timeout_s)

    def _run(self) -> None:
        while True:
            with self._changed:
                self._writing = False
                self._changed.notify_all()
                self._changed.wait_for(lambda: bool(self._lines), _IDLE_S)
                data = self._lines.popleft() if self._lines else b""
                self._bytes -= len(data)
                lost = self._dropped - self._told
                self._told += lost
                self._writing = True
            if lost:
                data += self._encoded(self._tell(lost))
            elif not data:
                data = b"".join(map(self._encoded, self._idle()))
            if not self._write(data):
                with self._changed:
                    self._dropped += 1

    def _encoded(self, line: str) -> bytes:
        return line.encode(self._encoding, "replace") + b"\n"

    def _write(self, data: bytes) -> bool:
        try:
            if self._descriptor is None:
                self._stream.write(data.decode(self._encoding))
                return True
            while data:
                try:
                    data = data[os.write(self._descriptor, data) :]
                except BlockingIOError:
                    time.sleep(_PAUSE_S)
        except (OSError, ValueError):  # it is closed, or its reader has left
            return False
        return True


def _descriptor(stream: TextIO) -> int | None:
    try:
        return stream.fileno()
    except (OSError, ValueError, AttributeError):
        return None


class Quiet(NamedTuple):
    """Lines of one kind that were left out."""

    kind: str
    stream: str
    lines: int


class Limiter:
    """Admits a bounded number of lines of each kind, and of each kind about one stream, in a period.

    Args:
        of_stream: most lines of one kind about one stream.
        of_kind: most lines of one kind.
        period_s: length of the period [s].
        now_s: monotonic clock [s].
    """

    def __init__(
        self,
        of_stream: int = 10,
        of_kind: int = 60,
        period_s: float = 10.0,
        now_s: Callable[[], float] = time.monotonic,
    ) -> None:
        self._of_stream, self._of_kind, self._period_s, self._now_s = of_stream, of_kind, period_s, now_s
        self._began_s = now_s()
        self._admitted: dict[tuple[str, str], int] = {}
        self._kinds: dict[str, int] = {}
        self._left_out: dict[tuple[str, str], int] = {}
        self._lock = threading.Lock()

    def admit(self, kind: str, stream: str) -> bool:
        """Whether to write this line."""
        with self._lock:
            key = (kind, stream)
            if self._admitted.get(key, 0) >= self._of_stream or self._kinds.get(kind, 0) >= self._of_kind:
                key = key if key in self._admitted else (kind, "")  # bounded: a name that had no line gets no entry
                self._left_out[key] = self._left_out.get(key, 0) + 1
                return False
            self._admitted[key] = self._admitted.get(key, 0) + 1
            self._kinds[kind] = self._kinds.get(kind, 0) + 1
            return True

    def ended(self) -> list[Quiet]:
        """What was left out in the period, if it has ended; a new one begins."""
        with self._lock:
            if self._now_s() - self._began_s < self._period_s:
                return []
            self._began_s = self._now_s()
            found = [Quiet(kind, stream, lines) for (kind, stream), lines in self._left_out.items()]
            for counts in (self._admitted, self._kinds, self._left_out):
                counts.clear()
            return found
