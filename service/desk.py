"""Desk: requests that wait for one thread, bounded in number and in rate, so that many of them do not stop the rest."""

import threading
import time
from collections import deque
from collections.abc import Callable, Iterator
from typing import Final, Generic, TypeVar

MOST_WAITING: Final = 64
PER_SECOND: Final = 200.0

T = TypeVar("T")


class Desk(Generic[T]):
    """A queue of requests; any thread may offer one and never waits.

    Args:
        most: requests that wait at once.
        per_second: requests that are handed out in a second, after a burst of `most`.
        now_s: monotonic clock [s].
        pause: waits so many seconds.
    """

    def __init__(
        self,
        most: int = MOST_WAITING,
        per_second: float = PER_SECOND,
        now_s: Callable[[], float] = time.monotonic,
        pause: Callable[[float], None] = time.sleep,
    ) -> None:
        self.most, self._per_second = most, per_second
        self._now_s, self._pause = now_s, pause
        self._waiting: deque[T] = deque()
        self._allowance, self._counted_s = float(most), now_s()
        self._closed = False
        self._changed = threading.Condition()

    def offer(self, request: T) -> bool:
        """Queue a request; False if too many wait."""
        with self._changed:
            if self._closed or len(self._waiting) >= self.most:
                return False
            self._waiting.append(request)
            self._changed.notify()
            return True

    def close(self) -> None:
        """End the iteration; what still waits is not handed out."""
        with self._changed:
            self._closed = True
            self._changed.notify_all()

    def __iter__(self) -> Iterator[T]:
        """The requests in order, at the pace of the desk, until it is closed."""
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._waiting or self._closed)
                if self._closed:
                    return
                request = self._waiting.popleft()
            self._take_allowance()
            yield request

    def _take_allowance(self) -> None:
        now_s = self._now_s()
        self._allowance = min(float(self.most), self._allowance + (now_s - self._counted_s) * self._per_second)
        self._counted_s = now_s
        self._allowance -= 1
        if self._allowance < 0:
            self._pause(-self._allowance / self._per_second)
