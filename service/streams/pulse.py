"""Pulse: for how long a process did not run, so that it may have missed what others did meanwhile."""

import threading
import time
from collections import deque
from collections.abc import Callable
from typing import Final

BEAT_S: Final = 0.01
"""The pulse beats so often; a process that was suspended for longer has a gap in it."""

_KEPT = 256


class Pulse:
    """Beats on a thread of its own; any thread may ask.

    Args:
        now_ns: monotonic clock [ns].
    """

    def __init__(self, now_ns: Callable[[], int] = time.monotonic_ns) -> None:
        self._now_ns, self._beat_ns = now_ns, now_ns()
        self._gaps: deque[tuple[int, int]] = deque(maxlen=_KEPT)  # end and length of each [ns]

    def start(self, stop: threading.Event) -> None:
        """Beat until the event is set."""

        def run() -> None:
            while not stop.wait(BEAT_S):
                self.beat()

        threading.Thread(target=run, name="pulse", daemon=True).start()

    def beat(self) -> None:
        """The process runs now."""
        now_ns = self._now_ns()
        if now_ns - self._beat_ns > 1.5e9 * BEAT_S:
            self._gaps.append((now_ns, now_ns - self._beat_ns))  # first: `longest_ns` reads in the other order
        self._beat_ns = now_ns

    def longest_ns(self, since_ns: int) -> int:
        """The longest time without a beat that ended after `since_ns` or still lasts [ns]."""
        lasts_ns = self._now_ns() - self._beat_ns
        return max([lasts_ns, *(length_ns for end_ns, length_ns in list(self._gaps) if end_ns > since_ns)])
