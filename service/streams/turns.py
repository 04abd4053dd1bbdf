"""Turns: how many workers of a node work at once, each in the order in which it asked; workers that answer go first."""

import contextlib
import threading
from collections import deque
from collections.abc import Iterator
from typing import Final

LAST_S: Final = 0.02
"""A worker that lets others go first waits so long for its turn; then it can see whether its duty has changed."""


class Turns:
    """A semaphore that is fair: a worker with a long queue cannot pass those that wait.

    Args:
        at_once: workers that have their turn at the same time.
    """

    def __init__(self, at_once: int) -> None:
        self._free = max(1, at_once)
        self._waiting: deque[threading.Lock] = deque()
        self._last: deque[threading.Lock] = deque()
        self._lock = threading.Lock()

    @property
    def waiting(self) -> int:
        """Number of workers that wait for their turn."""
        return len(self._waiting) + len(self._last)

    @contextlib.contextmanager
    def turn(self, *, last: bool = False) -> Iterator[bool]:
        """A turn of one worker; gives whether there is one.

        Args:
            last: whether the workers that ask without it go first; then there may be no turn within `LAST_S`.
        """
        begun = self._begin(self._last, LAST_S) if last else self._begin(self._waiting, -1)
        try:
            yield begun
        finally:
            if begun:
                self._end()

    def _begin(self, queue: deque[threading.Lock], timeout_s: float) -> bool:
        with self._lock:
            if self._free and not self.waiting:
                self._free -= 1
                return True
            mine = threading.Lock()
            mine.acquire()
            queue.append(mine)
        if mine.acquire(timeout=timeout_s):  # until the turn is handed over
            return True
        with self._lock:
            if mine in queue:
                queue.remove(mine)
                return False
        return True  # it was handed over a moment ago

    def _end(self) -> None:
        with self._lock:
            if self._waiting:
                self._waiting.popleft().release()
            elif self._last:
                self._last.popleft().release()
            else:
                self._free += 1


class Slots:
    """The turns of the workers of a node. More at once would only compete, and Zenoh's threads would wait for them.

    Args:
        cores: that the workers may use.
    """

    def __init__(self, cores: int = 1) -> None:
        self.serving = Turns(cores)
        self.standby = threading.Semaphore(max(1, cores // 2))  # the rest is for serving models
