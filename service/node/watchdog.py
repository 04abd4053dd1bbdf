"""Watchdog: tells the supervisor that the node lives, on a thread of its own, whatever a stream does."""

import threading
import time
from collections.abc import Callable

from neurove_service import logs
from neurove_service.guard import Guard
from neurove_service.lifecycle import notify

log = logs.get(__name__)

STOPPED_LOOP_S = 10.0
"""A loop of the node that has not turned for this time has stopped."""

_PERIOD_S = 1.0


class Watchdog:
    """Pings the supervisor while the housekeeping loop turns, which reaches every stream and the session.

    Args:
        beat_s: when the housekeeping loop turned last (monotonic) [s].
        ping: tells the supervisor.
        guard: counts internal errors.
    """

    def __init__(
        self,
        beat_s: Callable[[], float],
        guard: Guard,
        ping: Callable[[], None] = lambda: notify("WATCHDOG=1"),
    ) -> None:
        self._beat_s, self._guard, self._ping = beat_s, guard, ping
        self._late = False

    def start(self, stop: threading.Event) -> None:
        """Run on a daemon thread until the event is set."""
        threading.Thread(target=self._run, args=(stop,), name="watchdog", daemon=True).start()

    def turn(self, now_s: float) -> bool:
        """Ping if the node lives; return whether it does."""
        late_s = now_s - self._beat_s()
        if late_s < STOPPED_LOOP_S:
            self._late = False
            self._ping()
            return True
        if not self._late:
            self._late = True
            log.error("housekeeping has stopped: no ping to the supervisor", since_s=round(late_s, 1))
        return False

    def _run(self, stop: threading.Event) -> None:
        while not stop.wait(_PERIOD_S):
            with self._guard.at("watchdog"):
                self.turn(time.monotonic())
