"""Turns: how many workers of a node work at once, each in the order in which it asked."""

import threading
from collections import deque
from types import TracebackType


class Turns:
    """A semaphore that is fair: a worker with a long queue cannot pass those that wait.

    Args:
        at_once: workers that have their turn at the same time.
    """

    def __init__(self, at_once: int) -> None:
        self._free = max(1, at_once)
        self._waiting: deque[threading.Lock] = deque()
        self._lock = threading.Lock()

    @property
    def waiting(self) -> int:
        """Number of workers that wait for their turn."""
        return len(self._waiting)

    def __enter__(self) -> None:
        with self._lock:
            if self._free and not self._waiting:
                self._free -= 1
                return
            mine = threading.Lock()
            mine.acquire()
            self._waiting.append(mine)
        mine.acquire()  # until the turn is handed over

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        with self._lock:
            if self._waiting:
                self._waiting.popleft().release()
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
