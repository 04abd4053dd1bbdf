"""Pair: the duty of a node on a stream that several nodes can answer. One answers, the others follow with warm state.

Every node computes every window. The node that answers publishes its estimates with its term; the others hear them and
keep their own answers to the windows that they have not heard yet. If the token of the answering node disappears, or
its estimate is `LATE_WINDOWS` late, a follower takes the next term and publishes what it kept, in order.

A node that was suspended may have been superseded without having heard of it. So a node that answers and finds a pause
of `DOUBT_WINDOWS` in its own work asks the others before it publishes.

A node that is late itself, or whose state is not equal, does not take over from a node that replies: on machines that
are overloaded all nodes are late, and each change would make them later.
"""

import math
import sys
import threading
import time
from collections import deque
from collections.abc import Callable
from functools import partial
from typing import Final, NamedTuple

from neurove_protocol import TwistEstimate
from neurove_protocol.control import StandbyStatus
from neurove_protocol.duty import DutyReply, Role, StateReply
from neurove_service import logs
from neurove_service.streams.asking import Asking, is_long
from neurove_service.streams.following import Following, Sync
from neurove_service.streams.pauses import Pauses
from neurove_service.streams.stream import Stream
from neurove_service.streams.tenure import Peers, Tenure

log = logs.get(__name__)

DOUBT_WINDOWS: Final = 1.25
"""A node that answers asks the others after a pause of so many windows in its work; less than `LATE_WINDOWS`."""


class Resigned(NamedTuple):
    """How a node stopped to answer."""

    term: int
    start_us: int | None  # of the last window that it published


class Pair:
    """The duty of one node on one stream; `answer`, `turn`, `wait_s`, `close` are the worker's, others for any thread.

    Args:
        tenure: the role of this node.
        peers: the other nodes.
        wake: lets the worker of the stream turn at once.
        now_ns: monotonic clock [ns].
        on_close: called when the worker ends.
        suspended_ns: see `Pauses`; without it the process counts as suspended in every pause of the worker.
    """

    def __init__(
        self,
        tenure: Tenure,
        peers: Peers,
        wake: Callable[[], None],
        now_ns: Callable[[], int] = time.monotonic_ns,
        on_close: Callable[["Pair"], None] = lambda _: None,
        suspended_ns: Callable[[int], int] = lambda _: sys.maxsize,
    ) -> None:
        self._tenure, self._peers, self._wake, self._now_ns, self._on_close = tenure, peers, wake, now_ns, on_close
        self._stream, self._asking = tenure.stream, Asking(tenure, peers, now_ns)
        self._following, self._sync = Following(), Sync(tenure.stream)
        self._calls: deque[Callable[[], None]] = deque()  # from other threads, for the worker
        self._last_us: int | None = None  # start of the window that was published last
        self.pauses, self._window_ns, self._renewed = Pauses(now_ns, suspended_ns), 50_000_000, False

    @property
    def can_wait(self) -> bool:
        """Whether other workers go first: no consumer waits for a node that follows."""
        return self._tenure.role == "follows"

    @property
    def retired(self) -> bool:
        """Whether the worker shall end, and never takes over again."""
        return self._tenure.retired

    def retire(self, *roles: Role) -> bool:
        """Let the worker end, unless this node has another role than these; see `Tenure.retire`."""
        return self._tenure.retire(*roles)

    def heard(self, estimate: TwistEstimate) -> None:
        """Another node has published an estimate."""
        self._call(lambda: self._hear(estimate))

    def gone(self, node: str) -> None:
        """The token of another node has disappeared."""
        self._call(lambda: self._lose(node))

    def drain(self, *, draining: bool) -> None:
        """Let other nodes take precedence from now on, or no more."""
        self._tenure.draining = draining
        self._call(self._tenure.set_patience)

    def take(self, node: str, term: int, start_us: int | None) -> None:
        """Take over from a node that hands over; `start_us` is the last window that it answered."""
        self._call(lambda: self._take(node, term, start_us))

    def resign(self, timeout_s: float) -> Resigned | None:
        """Stop to answer, after the estimate that is on its way; None if this node does not answer, or is stuck."""
        done, resigned = threading.Event(), list[Resigned]()

        def stop() -> None:
            if self._tenure.answers:
                resigned.append(Resigned(self._tenure.term, self._last_us))
                self._tenure.listen("hands over")
            done.set()

        self._call(stop)
        done.wait(timeout_s)
        return resigned[0] if resigned else None

    def reply(self) -> DutyReply:
        """What this node does on the stream."""
        return _reply_of(self._tenure, self._following)

    def state(self, digest: str, after_us: int | None, timeout_s: float) -> StateReply | None:
        """The state of the stream for a follower; None if this node has no such state in time."""
        return self._sync.ask(self._tenure.node, digest, after_us, timeout_s, self._wake)

    def status(self) -> StandbyStatus:
        """For the status of the stream."""
        followers = len(self._peers.names(self._stream)) if self._tenure.answers else 0
        return _status_of(self._tenure, self._following, followers)

    def answer(self, estimate: TwistEstimate) -> list[TwistEstimate]:
        """The estimates to publish now that this one is there."""
        self._window_ns = (estimate.end_us - estimate.start_us) * 1000
        pause_ns = self.pauses.answer(estimate)
        self._run_calls()
        lacks = self._following.note(estimate)
        if self._tenure.answers and pause_ns > DOUBT_WINDOWS * self._window_ns:
            self._asking.after_pause(pause_ns, self._window_ns)
            self._asked()
        elif not self._tenure.answers and is_long(pause_ns, self._window_ns):
            self._following.renew(self._now_ns(), doubt=True)
            self._tenure.set_patience()
        if self._tenure.answers and lacks:
            self._asking.after_loss(estimate.start_us, self._last_us, self._window_ns)
            self._asked()
        if self._tenure.answers:
            return [self._stamped(estimate)]
        self._following.add(estimate, self._now_ns())
        return self._due()

    def turn(self, stream: Stream) -> list[TwistEstimate]:
        """The estimates to publish now; also gives and takes the state of the stream."""
        self.pauses.turn()
        self._run_calls()
        self._sync.serve(stream)
        self._take_state(stream)
        return [] if self._tenure.answers else self._due()

    def wait_s(self, most_s: float) -> float:
        """Until the oldest estimate that is kept is late."""
        fixed = self._tenure.answers or self._tenure.retired
        return most_s if fixed else min(most_s, max(0.0, self._due_in_s))

    def close(self) -> None:
        """The worker has ended."""
        self._on_close(self)

    def _call(self, call: Callable[[], None]) -> None:
        self._calls.append(call)
        self._wake()

    def _run_calls(self) -> None:
        while self._calls:
            self._calls.popleft()()

    def _asked(self) -> None:
        """Go on after a question to other nodes, which is no pause, with what was heard meanwhile."""
        self.pauses.skip()
        self._run_calls()

    @property
    def _due_in_s(self) -> float:
        """When this node takes over, unless another estimate is heard; infinite if nothing is kept [s]."""
        since_ns = self._following.since_ns
        patience_ns = self._tenure.patience_ns(self._window_ns, equal=self._following.equal)
        return math.inf if since_ns is None else (since_ns + patience_ns - self._now_ns()) / 1e9

    def _due(self) -> list[TwistEstimate]:
        """All that is kept, if this node takes over now. If it is late itself, it waits once more."""
        tenure, late_ns = self._tenure, -1e9 * self._due_in_s
        if late_ns < 0:
            return []
        if late_ns > DOUBT_WINDOWS * self._window_ns and not tenure.at_once and not self._renewed:
            self._renewed = True
            self._following.renew(self._now_ns(), doubt=is_long(late_ns, self._window_ns))
            return []
        if not tenure.at_once and (self.pauses.late or not self._following.equal):
            answered = self._asking.is_answered(self._window_ns, patient=not self._following.equal)
            self._asked()
            if answered:
                self._following.renew(self._now_ns(), doubt=False)
            if self._due_in_s > 0:
                return []
        why = f"{tenure.leader} is late" if tenure.leader else "no other node answers"
        if not tenure.take_over(why, self._now_ns()):
            return []
        if self._following.other_model:
            log.warning("another model than before answers", stream=self._stream, before=self._following.other_model)
        return [self._stamped(estimate) for estimate in self._following.release()]

    def _stamped(self, estimate: TwistEstimate) -> TwistEstimate:
        self._last_us = estimate.start_us
        return estimate.model_copy(update={"seq": self._following.seq_of(estimate), "term": self._tenure.term})

    def _take_state(self, stream: Stream) -> None:
        """Ask for the state if it differs, unless this node cannot keep up."""
        if self._tenure.role == "follows" and self._tenure.leader and not self.pauses.late:
            ask = partial(self._peers.state, self._stream, self._tenure.leader)
            if self._sync.renew(stream, self._following, ask, self._now_ns()):
                self.pauses.turn()

    def _hear(self, estimate: TwistEstimate) -> None:
        if self._tenure.hear(estimate.node or "", estimate.term or 0, self._now_ns()):
            self._renewed = False
            self._following.hear(estimate)

    def _lose(self, node: str) -> None:
        if node == self._tenure.leader:
            ready = self._following.equal or not self._peers.names(self._stream)
            at_once = self.pauses.flows and not self._tenure.draining and self._tenure.rank() == 0 and ready
            self._tenure.listen(f"{node} has left", at_once=at_once)

    def _take(self, node: str, term: int, start_us: int | None) -> None:
        if not self._tenure.answers and term >= self._tenure.term:
            self._tenure.term = term
            self._following.leave_out(start_us)
            self._tenure.listen(f"{node} hands over", at_once=True)


def _reply_of(tenure: Tenure, following: Following) -> DutyReply:
    return DutyReply(
        node=tenure.node,
        stream=tenure.stream,
        role=tenure.role,
        term=tenure.term,
        leader=tenure.leader or None,
        equal=tenure.answers or following.equal,
        missed_us=following.missed_us,
        draining=tenure.draining or tenure.retired,  # no node hands over to it
        digest=following.digest,
    )


def _status_of(tenure: Tenure, following: Following, followers: int) -> StandbyStatus:
    return StandbyStatus(
        role=tenure.role,
        leader=tenure.leader or None,
        term=tenure.term,
        equal=following.equal and not tenure.answers,
        other_model=following.other_model,
        draining=tenure.draining,
        followers=followers,
    )
