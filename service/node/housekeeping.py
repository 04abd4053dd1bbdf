"""Housekeeping: status messages, eviction of idle streams, and the watchdog of the supervisor."""

import threading
import time
from collections.abc import Callable

from neurove_protocol.control import StreamStatus
from neurove_service import logs
from neurove_service.lifecycle import notify
from neurove_service.streams.registry import StreamRegistry
from neurove_service.transport import Publisher

log = logs.get(__name__)

_TICK_S = 0.1
_WATCHDOG_S = 1.0


class Housekeeping:
    """Publishes the status of every stream on a change of its verdict and once per period; evicts idle streams.

    Args:
        registry: the streams.
        statuses: status of every stream.
        open_publisher: opens the publisher of a stream's status.
        period_s: of status messages and evictions [s].
    """

    def __init__(
        self,
        registry: StreamRegistry,
        statuses: Callable[[], list[StreamStatus]],
        open_publisher: Callable[[str], Publisher],
        period_s: float,
    ) -> None:
        self._registry, self._statuses = registry, statuses
        self._open_publisher, self._period_s = open_publisher, period_s
        self._publishers: dict[str, Publisher] = {}
        self._reported: dict[str, str] = {}  # stream -> verdict of its newest status message

    def run(self, stop: threading.Event) -> None:
        """Run until the event is set."""
        next_status = next_watchdog = time.monotonic()
        while not stop.wait(_TICK_S):
            now = time.monotonic()
            due = now >= next_status
            for status in self._statuses():
                if due or self._reported.get(status.stream) != status.verdict:
                    self._report(status)
            if due:
                next_status = now + self._period_s
                self._evict()
            if now >= next_watchdog and self._registry.alive():
                next_watchdog = now + _WATCHDOG_S
                notify("WATCHDOG=1")

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
            if name in self._publishers:
                self._publishers.pop(name).close()
