"""Standby: a model that runs on a stream but does not answer it."""

from collections import deque
from collections.abc import Sequence

from neurove_protocol.events import Packet
from neurove_service.streams.lane import Lane, TimedEstimate
from neurove_service.streams.ring import PackedWindow

MAX_BACKLOG_WINDOWS, MAX_BACKLOG_PACKETS, MAX_BACKLOG_EVENTS = 128, 4096, 4_000_000
"""A standby lane with a larger backlog stops: the node cannot run two models."""


class Standby:
    """A lane that does not answer: the candidate in shadow, or the proven model during probation.

    Its windows wait in a backlog until the stream has spare time for them.

    Args:
        lane: the model.
        same_windows: whether it uses the windows of the serving lane; otherwise it splits the packets itself.
        replayed: past windows to prime it with first.
    """

    def __init__(self, lane: Lane, *, same_windows: bool, replayed: Sequence[PackedWindow] = ()) -> None:
        self.lane, self.same_windows = lane, same_windows
        self._backlog: deque[PackedWindow | Packet] = deque(replayed)
        self._max_windows = MAX_BACKLOG_WINDOWS + len(replayed)
        self._backlog_events = 0  # of packets, which wait unprocessed
        self.fault = ""  # why the model failed; empty if it did not
        self.stopped = False  # the backlog was too large, or the model failed

    @property
    def has_backlog(self) -> bool:
        """Whether work waits."""
        return bool(self._backlog)

    @property
    def behind(self) -> int:
        """Number of windows or packets in the backlog."""
        return len(self._backlog)

    def add(self, packet: Packet, windows: list[PackedWindow]) -> None:
        """Append a packet, or the windows that it completed, to the backlog."""
        if self.stopped:
            return
        self._backlog.extend(windows if self.same_windows else [packet])
        self._backlog_events += 0 if self.same_windows else packet.events.n
        bound = self._max_windows if self.same_windows else MAX_BACKLOG_PACKETS
        if len(self._backlog) > bound or self._backlog_events > MAX_BACKLOG_EVENTS:
            self.stop()

    def stop(self) -> None:
        """Drop the backlog and accept no more work; if the model is needed again, it is primed again."""
        self._backlog.clear()
        self.stopped = True

    def step(self) -> list[TimedEstimate]:
        """Process the oldest entry of the backlog.

        Raises:
            NotFinite: the model computed values that are not finite.
        """
        oldest = self._backlog.popleft()
        if isinstance(oldest, PackedWindow):
            return self.lane.follow([oldest.window()], checked=True)
        self._backlog_events -= oldest.events.n
        state = self.lane.state
        pushed = self.lane.estimator.to_windows(oldest.events, state, oldest.t0_us)
        self.lane.state = state._replace(windows=pushed.state)
        return self.lane.follow(pushed.windows, checked=True)
