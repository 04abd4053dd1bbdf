"""Pauses: for how long the work on a stream stood still, so that another node may have taken over; and lateness.

A worker that waits for its turn has not missed anything: what other nodes published is heard on other threads, and
comes before its next estimate. So on a node that is late all the time, a pause counts as far as the whole process did
not run, or no packet arrived. Elsewhere each pause counts: another node may have taken over a moment ago.
"""

from collections.abc import Callable
from typing import Final

from neurove_protocol import TwistEstimate
from neurove_service.streams.tenure import LATE_WINDOWS

LONG_PAUSE_NS: Final = 1_000_000_000
"""After a pause of so long, packets may be lost."""

LATE_RUN: Final = 8
"""A node that computed so many windows in a row late is late all the time."""


class Pauses:
    """The pauses of one worker, on its thread.

    Args:
        now_ns: monotonic clock [ns].
        suspended_ns: the longest time since then during which this process did not run, see `pulse.Pulse` [ns].
    """

    def __init__(self, now_ns: Callable[[], int], suspended_ns: Callable[[int], int]) -> None:
        self._now_ns, self._suspended_ns = now_ns, suspended_ns
        self._turned_ns = self._answered_ns = now_ns()
        self._longest_ns = 0  # between two turns since the last answer
        self._late_run = 0  # windows in a row that this node computed late
        self._received_ns: int | None = None  # when the packets of the last answer were complete

    @property
    def flows(self) -> bool:
        """Whether this node has computed a window recently; any thread may ask."""
        return self._now_ns() - self._answered_ns < LONG_PAUSE_NS

    @property
    def late(self) -> bool:
        """Whether this node computed its newest window late."""
        return self._late_run > 0

    def turn(self) -> None:
        """The worker turns."""
        now_ns = self._now_ns()
        self._longest_ns, self._turned_ns = max(self._longest_ns, now_ns - self._turned_ns), now_ns

    def skip(self) -> None:
        """What was since the last turn is no pause."""
        self._turned_ns = self._now_ns()

    def answer(self, estimate: TwistEstimate) -> int:
        """A window is computed; the pause before it [ns]."""
        self.turn()
        since_ns, now_ns = self._answered_ns, self._turned_ns
        self._answered_ns, longest_ns, self._longest_ns = now_ns, self._longest_ns, 0
        received_ns, window_ns = estimate.trace.received_ns, 1000 * (estimate.end_us - estimate.start_us)
        late = estimate.trace.computed_ns - received_ns > LATE_WINDOWS * window_ns
        self._late_run = self._late_run + 1 if late else 0
        before_ns, self._received_ns = self._received_ns, received_ns
        silent_ns = min(now_ns - since_ns, received_ns - before_ns) if before_ns is not None else now_ns - since_ns
        pause_ns = min(longest_ns, self._suspended_ns(since_ns)) if self._late_run > LATE_RUN else longest_ns
        return max(pause_ns, silent_ns) if silent_ns > LONG_PAUSE_NS else pause_ns
