"""Asking: what a node asks the others before it publishes, after a pause or a loss of its own, or while it is late."""

import time
from collections.abc import Callable
from typing import Final

from neurove_protocol.duty import DutyReply
from neurove_service import logs
from neurove_service.streams.pauses import LONG_PAUSE_NS
from neurove_service.streams.tenure import Peers, Tenure

log = logs.get(__name__)

LONG_WINDOWS: Final = 10
"""After a pause of so many windows, at most `LONG_PAUSE_NS`, packets may be lost, and another node may answer."""

_REPLY_WINDOWS: Final = 2  # how long to wait for replies
_LONG_REPLY_WINDOWS: Final = 8  # after a long pause
_SILENT_NS: Final = 2_000_000_000  # how long a node that did not reply is not asked again after a short pause
_ALIVE_NS: Final = 300_000_000  # a node that was heard within this time is not asked whether it is there
_STUCK_NS: Final = 5_000_000_000  # a node that replies, but publishes nothing for this time, does not answer
_LOSS_NS: Final = 1_000_000_000  # between two questions because of lost packets


def is_long(pause_ns: float, window_ns: int) -> bool:
    """Whether a pause is so long that packets may be lost.

    >>> is_long(300e6, 20_000_000), is_long(300e6, 50_000_000), is_long(1.1e9, 500_000_000)
    (True, False, True)
    """
    return pause_ns > min(LONG_PAUSE_NS, LONG_WINDOWS * window_ns)


class Asking:
    """Asks the other nodes of a stream, on the thread of its worker; what they reply may end this node's tenure.

    Args:
        tenure: the role of this node.
        peers: the other nodes.
        now_ns: monotonic clock [ns].
    """

    def __init__(self, tenure: Tenure, peers: Peers, now_ns: Callable[[], int] = time.monotonic_ns) -> None:
        self._tenure, self._peers, self._now_ns = tenure, peers, now_ns
        self._silent: dict[str, int] = {}  # nodes that did not reply, and until when they are not asked again [ns]
        self._next_loss_ns = self._followed_ns = 0

    def after_pause(self, pause_ns: int, window_ns: int) -> None:
        """This node has paused: another node may have taken over.

        After a short pause a node that does not reply costs nothing more: if it had taken over, it would be heard by
        now. After a long pause this node follows any node that answers, or else listens before it goes on.
        """
        tenure, long = self._tenure, is_long(pause_ns, window_ns)
        names = set(self._peers.names(tenure.stream))
        if not long:
            names -= self._silent_now()
            if not names:
                return
        replies = self._ask(names, (_LONG_REPLY_WINDOWS if long else _REPLY_WINDOWS) * window_ns)
        if self._is_superseded(replies, by_any=long):
            log.warning("superseded in a pause", stream=tenure.stream, pause_ms=pause_ns // 1_000_000)
        elif long and not (replies and names <= {one.node for one in replies}):
            tenure.listen("no reply from another node after a pause", wary=True)

    def after_loss(self, start_us: int, last_us: int | None, window_ns: int) -> None:
        """This node missed packets: a node that has all of them answers from here on, if there is one.

        Args:
            start_us: of the first window without all packets.
            last_us: start of the last window that this node published; None if there is none.
            window_ns: duration of a window.
        """
        tenure, now_ns = self._tenure, self._now_ns()
        names = set(self._peers.names(tenure.stream)) - self._silent_now()
        if not names or now_ns < self._next_loss_ns:
            return
        self._next_loss_ns = now_ns + _LOSS_NS
        replies = self._ask(names, _LONG_REPLY_WINDOWS * window_ns)
        if self._is_superseded(replies):
            return
        complete = sorted(
            one.node
            for one in replies
            if one.role in {"answers", "follows"}
            and one.equal
            and not one.draining
            and (one.missed_us is None or one.missed_us < start_us)
        )
        if complete and self._peers.take(tenure.stream, complete[0], tenure.term, last_us, window_ns / 1e9):
            tenure.listen(f"packets are missing here, not on {complete[0]}", wary=True)

    def is_answered(self, window_ns: int, *, patient: bool) -> bool:
        """Whether another node answers the stream, though its estimates are late; then this node follows it.

        The first time that a node asks since it listens, a node that does not reply counts as one that answers, and so
        does one whose state is equal: it takes over in a moment.

        Args:
            window_ns: duration of a window.
            patient: whether to wait longer for replies, because nothing is lost by it.
        """
        tenure, now_ns = self._tenure, self._now_ns()
        names, leader = set(self._peers.names(tenure.stream)), tenure.leader
        if not names or (leader and now_ns - max(tenure.heard_ns, self._followed_ns) > _STUCK_NS):
            return False
        if leader and now_ns - self._peers.heard_ns(leader) < _ALIVE_NS:
            return True
        replies = self._ask(names, (_LONG_REPLY_WINDOWS if patient else _REPLY_WINDOWS) * window_ns)
        found = [(one.term, one.node) for one in replies if one.role == "answers" and one.term >= tenure.term]
        if found and max(found) != (tenure.term, leader):
            self._followed_ns = self._now_ns()
            tenure.follow(max(found)[1], max(found)[0])
        if tenure.unasked and (any(one.equal for one in replies) or not names <= {one.node for one in replies}):
            tenure.unasked = False
            return True
        return bool(found)

    def _ask(self, names: set[str], timeout_ns: int) -> list[DutyReply]:
        replies = self._peers.roles(self._tenure.stream, timeout_ns / 1e9)
        until_ns = self._now_ns() + _SILENT_NS
        heard = {one.node for one in replies}
        self._silent |= dict.fromkeys(names - heard, until_ns)
        for name in heard:
            self._silent.pop(name, None)
        return replies

    def _silent_now(self) -> set[str]:
        now_ns = self._now_ns()
        return {name for name, until_ns in self._silent.items() if now_ns < until_ns}

    def _is_superseded(self, replies: list[DutyReply], *, by_any: bool = False) -> bool:
        """Whether another node answers in a later term, or `by_any` in any term; then this node follows it."""
        tenure = self._tenure
        term, leader = max(((one.term, one.node) for one in replies if one.role == "answers"), default=(-1, ""))
        if not leader or (not by_any and (term, leader) <= (tenure.term, tenure.node)):
            return False
        tenure.follow(leader, term)
        return True
