"""Guard: an internal error costs the item in work, not the loop that serves the others; it is counted and logged."""

import threading
import time
from collections import Counter
from collections.abc import Callable
from types import TracebackType
from typing import Final, Self

from neurove_service import logs

log = logs.get(__name__)

RECENT_S: Final = 60.0
"""An internal error is part of the node's verdict for this time [s]; the log has one line per place in it."""


class Guard:
    """Counts internal errors by place; thread-safe.

    >>> guard = Guard()
    >>> with guard.at("status", stream="cam0"):
    ...     pass  # an exception here would be counted and logged
    >>> guard.counts
    {}

    Args:
        now_s: monotonic clock [s].
    """

    def __init__(self, now_s: Callable[[], float] = time.monotonic) -> None:
        self._now_s = now_s
        self._counts: Counter[str] = Counter()
        self._newest_s: dict[str, float] = {}
        self._logged_s: dict[str, float] = {}
        self._lock = threading.Lock()

    def at(self, place: str, **about: object) -> "Guarded":
        """A `with` block whose exceptions are counted and logged, and end there.

        Args:
            place: name of the code, one of a few; the counter's name.
            about: what it worked on, for the log.
        """
        return Guarded(self, place, about)

    def caught(self, place: str, error: BaseException, **about: object) -> None:
        """Count an exception; log it with its traceback unless the place had a line within the last minute."""
        now_s = self._now_s()
        with self._lock:
            self._counts[place] += 1
            self._newest_s[place] = now_s
            before = self._logged_s.get(place)
            if before is not None and now_s - before < RECENT_S:
                return
            self._logged_s[place] = now_s
            total = self._counts[place]
        log.error("internal error", place=place, total=total, **about, exc_info=error)

    @property
    def counts(self) -> dict[str, int]:
        """Number of internal errors by place, since the start."""
        with self._lock:
            return dict(sorted(self._counts.items()))

    @property
    def recent(self) -> list[str]:
        """The places that had an internal error within the last minute."""
        now_s = self._now_s()
        with self._lock:
            return sorted(place for place, newest_s in self._newest_s.items() if now_s - newest_s < RECENT_S)


class Guarded:
    """See Guard.at."""

    def __init__(self, guard: Guard, place: str, about: dict[str, object]) -> None:
        self._guard, self._place, self._about = guard, place, about

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> bool:
        if not isinstance(error, Exception):  # an exit or an interrupt of the process
            return False
        self._guard.caught(self._place, error, **self._about)
        return True
