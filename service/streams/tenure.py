"""Tenure: which node answers a stream, in which term, as far as this node knows; and when this node takes over."""

import hashlib
import threading
import time
import zlib
from collections.abc import Callable, Sequence
from typing import Final, Protocol

from neurove_protocol.duty import QUIET_NS, DutyReply, Role, StateReply
from neurove_service import logs

log = logs.get(__name__)

LATE_WINDOWS: Final = 1.5
"""A follower takes over if the estimate of the other node is so many windows later than its own."""

DRAINING: Final = 4.0
"""A node that is drained waits so many times longer before it takes over again."""

HASTY_WINDOWS: Final = 10
"""If the node before is heard again within so many windows, this node took over in haste: it waits longer then."""

_MAX_SLACK, _SLACK_NS = 8, 60_000_000_000  # times the patience at most; until half of it is taken back
_COLD: Final = 20  # times the patience of a node whose state is not that of the others
_RELUCTANT: Final = 2  # ranks behind the other nodes


class Peers(Protocol):
    """The other nodes that serve a stream."""

    def names(self, stream: str, /) -> Sequence[str]:
        """Their names, by their tokens."""

    def heard_ns(self, node: str, /) -> int:
        """When anything was heard of a node last, on a monotonic clock; 0 if nothing was [ns]."""

    def roles(self, stream: str, timeout_s: float, /) -> list[DutyReply]:
        """What they do on the stream, as far as they reply in time."""

    def state(self, stream: str, node: str, digest: str, after_us: int | None, /) -> StateReply | None:
        """The state of the stream on the node that answers it, after a window with this end or a later one."""

    def take(self, stream: str, node: str, term: int, last_us: int | None, timeout_s: float, /) -> bool:
        """Ask a node to answer after the window that begins at `last_us`; whether it replies."""


class Tenure:
    """The role of one node on one stream; only the worker of the stream changes it, and any thread may let it retire.

    A term is the time of taking over in microseconds since 1970, with the last three digits drawn from the name of the
    node, or one more than the newest term if that is later. So it rises when all nodes restart, too, and two nodes that
    take over in one millisecond have different terms.

    Args:
        node: name of this node.
        stream: name of the stream.
        peers: the other nodes.
        reluctant: whether other nodes take precedence where no node answers yet.
    """

    def __init__(self, node: str, stream: str, peers: Peers, *, reluctant: bool = False) -> None:
        self.node, self.stream, self._peers, self._reluctant = node, stream, peers, reluctant
        self.role: Role = "listens"
        self.term, self.leader = 0, ""
        self.draining = False
        self.retired = False  # the worker ends, so this node does not take over any more
        self._deciding = threading.Lock()  # between taking over and retiring
        self.heard_ns = 0  # when the newest estimate of the other node was heard
        self._wary = False  # another node may answer, though it is not known now
        self.unasked = True  # the other nodes were not asked yet whether one of them answers, since this node listens
        self._patience = 1.0
        self._slack, self._slack_ns = 1, 0  # times the patience, because of slow links, and since when
        self._window_ns, self._took_ns = 50_000_000, 0
        self.set_patience()

    @property
    def answers(self) -> bool:
        """Whether this node answers the stream."""
        return self.role == "answers"

    def patience_ns(self, window_ns: int, *, equal: bool) -> float:
        """How long the estimates of another node may be missing [ns]; longer unless the state is that of the others.

        A node that listens does not wait longer before it has asked the others: perhaps none of them answers.
        """
        unknown = not equal and not self.unasked
        cold = self._wary or (unknown and bool(self._peers.names(self.stream)))
        self._window_ns = window_ns
        return self._patience * LATE_WINDOWS * window_ns * (_COLD if cold else self._slack)

    def hear(self, sender: str, term: int, now_ns: int) -> bool:
        """Another node has published; False if it does not know yet that it was superseded."""
        known, quiet = (self.term, self.leader), now_ns - self.heard_ns > QUIET_NS
        if (term, sender) < known and (self.answers or (self.leader and not quiet)):
            if self.answers and 0 <= now_ns - self._took_ns < HASTY_WINDOWS * self._window_ns:
                self._took_ns -= HASTY_WINDOWS * self._window_ns  # once
                self._slack, self._slack_ns = min(_MAX_SLACK, 2 * self._slack), now_ns
            return False
        if self._slack > 1 and now_ns - self._slack_ns > _SLACK_NS:
            self._slack, self._slack_ns = self._slack // 2, now_ns
        if (term, sender) != known or self.role != "follows":
            self.follow(sender, term)
        self.heard_ns = now_ns
        return True

    def follow(self, leader: str, term: int) -> None:
        """Another node answers."""
        log.info("follows", stream=self.stream, leader=leader, term=term)
        self.role, self.leader, self.term, self._wary = "follows", leader, term, False
        self.unasked = False
        self.set_patience()

    def listen(self, why: str, *, at_once: bool = False, wary: bool = False) -> None:
        """No node is known to answer.

        Args:
            why: for the log.
            at_once: whether to take over with the next own estimate, instead of waiting for another node's.
            wary: whether another node is likely to answer: wait as long as with another state.
        """
        log.info("listens", stream=self.stream, why=why)
        self.role, self.leader, self._wary, self.unasked = "listens", "", wary, not wary
        self.set_patience()
        if at_once:
            self._patience = 0.0

    def take_over(
        self, why: str, now_ns: int = 0, *, unix_ms: Callable[[], int] = lambda: time.time_ns() // 1_000_000
    ) -> bool:
        """This node answers from now on, in a new term; False if it has retired."""
        with self._deciding:
            if self.retired:
                return False
            self._took_ns = now_ns
            self.term = max(self.term + 1, 1000 * unix_ms() + zlib.crc32(self.node.encode()) % 1000)
            self.role, self.leader, self._wary = "answers", self.node, False
        log.warning("answers the stream", stream=self.stream, term=self.term, why=why)
        return True

    def retire(self, *roles: Role) -> bool:
        """Never take over from now on, so that the worker can end; any thread may call this.

        Returns:
            False if the role is none of these, or if the node that this one follows has left: then nothing changes.
        """
        with self._deciding:
            alone = self.role == "follows" and self.leader not in self._peers.names(self.stream)
            self.retired = self.retired or (self.role in roles and not alone)
            return self.retired

    @property
    def at_once(self) -> bool:
        """Whether this node takes over with its next estimate."""
        return self._patience == 0.0

    def rank(self) -> int:
        """How many other nodes take over first."""
        names = {*self._peers.names(self.stream), self.node} - {self.leader if self.role == "follows" else ""}
        return ranked(self.stream, names | {self.node}).index(self.node)

    def set_patience(self) -> None:
        """Set how long to wait for other nodes, by this node's rank among them."""
        rank = self.rank() + (_RELUCTANT if self._reluctant and not self.term else 0)
        self._patience = (1.0 + rank) * (DRAINING if self.draining else 1.0)


def ranked(stream: str, nodes: set[str]) -> list[str]:
    """Nodes in the order in which they answer a stream: rendezvous hashing, the same on every node.

    >>> ranked("cam0", {"n1", "n2", "n3"})
    ['n3', 'n1', 'n2']
    >>> [one for one in ranked("cam0", {"n1", "n2", "n3", "n4"}) if one != "n4"]
    ['n3', 'n1', 'n2']
    """
    return sorted(nodes, key=lambda node: hashlib.sha256(f"{stream} {node}".encode()).digest())
