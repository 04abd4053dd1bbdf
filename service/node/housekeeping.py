"""Housekeeping: status messages, eviction of idle streams, and memory."""

import threading
import time
from collections.abc import Callable

from neurove_protocol.control import StreamStatus
from neurove_service import logs
from neurove_service.guard import Guard
from neurove_service.node.memory import CompilerPages
from neurove_service.streams.registry import StreamRegistry
from neurove_service.transport import Publisher

log = logs.get(__name__)

_TICK_S = 0.1


class Housekeeping:
    """Publishes the status of every stream on a change of its verdict and once per period; evicts idle streams.

    Once per period it also returns the pages of the compiler, see `memory.CompilerPages`.

    An internal error costs one stream one message.

    Args:
        registry: the streams.
        statuses: status of every stream.
        open_publisher: opens the publisher of a stream's status.
        period_s: of status messages and evictions [s].
        guard: counts internal errors.
    """

    def __init__(
        self,
        registry: StreamRegistry,
        statuses: Callable[[], list[StreamStatus]],
        open_publisher: Callable[[str], Publisher],
        period_s: float,
        guard: Guard,
    ) -> None:
        self._registry, self._statuses = registry, statuses
        self._open_publisher, self._period_s = open_publisher, period_s
        self._guard = guard
        self._publishers: dict[str, Publisher] = {}
        self._pages = CompilerPages()
        self._reported: dict[str, str] = {}  # stream -> verdict of its newest status message
        self._next_status_s = self.beat_s = time.monotonic()  # beat_s: when the loop turned last

    def run(self, stop: threading.Event) -> None:
        """Run until the event is set."""
        while not stop.wait(_TICK_S):
            with self._guard.at("housekeeping"):
                self.turn(time.monotonic())
            self.beat_s = time.monotonic()

    def turn(self, now_s: float) -> None:
        """Publish what is due, and evict."""
        due = now_s >= self._next_status_s
        if due:
            self._next_status_s = now_s + self._period_s
        for status in self._statuses():
            if due or self._reported.get(status.stream) != status.verdict:
                with self._guard.at("status message", stream=status.stream):
                    self._report(status)
        if due:
            self._evict()
            with self._guard.at("pages of the compiler"):
                self._pages.release()

    def _report(self, status: StreamStatus) -> None:
        name, before = status.stream, self._reported.get(status.stream)
        if name not in self._publishers:
            self._publishers[name] = self._open_publisher(name)
        if before not in (None, status.verdict):
            log.info("stream verdict changed", stream=name, before=before, now=status.verdict, why=status.why)
        self._reported[name] = status.verdict
        self._publishers[name].put(status.encode())

    def _evict(self) -> None:
        for name in self._registry.evict_idle():
            self._reported.pop(name, None)
            publisher = self._publishers.pop(name, None)
            if publisher is not None:
                with self._guard.at("end of a status publisher", stream=name):
                    publisher.close()
