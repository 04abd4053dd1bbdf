"""Following: the estimates of the node that answers, beside those of this node; and the exchange of state."""

import threading
from collections import OrderedDict, deque
from collections.abc import Callable
from typing import Final, NamedTuple

from neurove_core import carried
from neurove_protocol import Flag, TwistEstimate
from neurove_protocol.duty import StateReply
from neurove_protocol.errors import NeuroVEError
from neurove_service import logs
from neurove_service.streams.stream import Stream

log = logs.get(__name__)

KEPT: Final = 256
"""Estimates that are kept, of this node and of the other one."""

BEHIND: Final = 8
"""A node that is so many windows behind the other one, or that catches up so many, is not ready to answer."""

MAX_AHEAD_US: Final = 500_000
"""A node that is further behind is not asked for the state: it waits at most so long before it replies."""

_INCOMPLETE: Final = frozenset({Flag.GAP.value, Flag.OVERLOAD.value})
_ANEW_US: Final = 5_000_000  # a clock that goes back further has begun anew
_RETRY_NS, _MAX_RETRY_NS = 200_000_000, 60_000_000_000  # between requests for the state


class Following:
    """Holds back the estimates of this node until those of the other node are heard, and compares both.

    The worker of the stream uses it; any thread may read `equal`, `missed_us`, `digest` and `other_model`.
    """

    def __init__(self) -> None:
        self.digest = ""  # of the model of this node
        self.other_model = ""  # of the other node, where it is another one
        self.missed_us: int | None = None  # start of the newest window of which this node missed packets
        self._equal = False  # the newest pair of estimates is the same, bit for bit
        self._ages_ns: deque[int] = deque(maxlen=2 * BEHIND)  # of the newest windows of this node when they ended
        self._catches_up = False  # packets arrive quicker than the driver sends them, such as after a pause
        self._own: OrderedDict[int, TwistEstimate] = OrderedDict()  # of this node, by start of the window
        self._own_us = -(2**63)  # start of the newest one
        self._kept: deque[tuple[TwistEstimate, int]] = deque(maxlen=KEPT)  # with the time of finishing [ns]
        self._heard: OrderedDict[int, TwistEstimate] = OrderedDict()  # of windows that this node has still to compute
        self._newest: TwistEstimate | None = None  # that was heard
        self._seq_offset: int | None = None  # from this node's numbers to the ones on the wire
        self._left_out_us: int | None = None  # a window that the other node has answered, though it is not heard
        self._differs = False
        self._next_ns, self._retry_ns = 0, _RETRY_NS
        self._taken_us: int | None = None  # the state after the window with this end was taken

    @property
    def equal(self) -> bool:
        """Whether this node can go on with the estimates of the other one, bit for bit: it is equal and not behind."""
        return self._equal and not self._catches_up and len(self._heard) <= BEHIND

    @property
    def ahead_us(self) -> int:
        """How far this node is ahead of the other one [us]; 0 if nothing was heard."""
        return self._own_us - self._newest.start_us if self._newest is not None else 0

    @property
    def since_ns(self) -> int | None:
        """When the oldest estimate that is kept was finished; None if there is none."""
        return self._kept[0][1] if self._kept else None

    def note(self, own: TwistEstimate) -> bool:
        """An estimate of this node is there, published or not; whether it lacks packets."""
        self.digest = own.digest
        if own.start_us <= self._own_us:  # the sensor clock has begun anew
            self._own.clear()
            self._heard.clear()
            self.missed_us = self._taken_us = None
            if self._newest is not None and self._newest.start_us - own.start_us > _ANEW_US:
                self._newest = None
        self._own_us = own.start_us
        self._own[own.start_us] = own
        while len(self._own) > KEPT:
            self._own.popitem(last=False)
        self._ages_ns.append(own.host.age_ns if own.host else 0)
        spread_ns = max(self._ages_ns) - min(self._ages_ns)
        self._catches_up = spread_ns > 1000 * BEHIND * (own.end_us - own.start_us)
        lacks = not _INCOMPLETE.isdisjoint(own.flags)
        if lacks:
            self.missed_us = own.start_us
            self._equal = False
            self._next_ns, self._retry_ns = 0, _RETRY_NS
        return lacks

    def add(self, own: TwistEstimate, now_ns: int) -> None:
        """Keep an estimate of this node until the other node has answered the window."""
        for start_us in [start_us for start_us in self._heard if start_us < own.start_us]:
            del self._heard[start_us]
        if own.start_us == self._left_out_us:
            self._left_out_us = None
            return
        heard = self._heard.pop(own.start_us, None)
        if heard is not None:
            self._compare(own, heard)
        elif not self._is_passed(own):
            self._kept.append((own, now_ns))

    def hear(self, heard: TwistEstimate) -> None:
        """The other node has published an estimate: what this node has kept up to it is answered."""
        if self._newest is not None and self._newest.start_us - heard.start_us > _ANEW_US:
            self._kept = deque((one for one in self._kept if one[0].start_us <= heard.start_us), maxlen=KEPT)
        self._newest, self._left_out_us = heard, None
        own = self._own.get(heard.start_us)
        if own is not None:
            self._compare(own, heard)
        elif heard.start_us > self._own_us:
            self._heard[heard.start_us] = heard
            while len(self._heard) > KEPT:
                self._heard.popitem(last=False)
        while self._kept and self._is_passed(self._kept[0][0]):
            self._kept.popleft()

    def leave_out(self, start_us: int | None) -> None:
        """The other node has answered the window that begins here, and those before."""
        found = [index for index, (own, _) in enumerate(self._kept) if own.start_us == start_us]
        for _ in range(found[0] + 1 if found else 0):
            self._kept.popleft()
        self._left_out_us = None if found else start_us

    def release(self) -> list[TwistEstimate]:
        """All that is kept, oldest first; the state of this node counts from here on."""
        kept = [own for own, _ in self._kept]
        self._kept.clear()
        self._heard.clear()
        self._equal = True
        return kept

    def renew(self, now_ns: int, *, doubt: bool) -> None:
        """Wait anew for what is kept: a pause of this node says nothing about the other one.

        Args:
            now_ns: monotonic clock [ns].
            doubt: whether packets may be lost, so that the estimates may not be equal any more.
        """
        self._kept = deque(((own, now_ns) for own, _ in self._kept), maxlen=KEPT)
        self._equal = self._equal and not doubt

    def seq_of(self, own: TwistEstimate) -> int:
        """The number of an estimate on the wire: it goes on where the other node stopped."""
        if self._seq_offset is None:
            self._seq_offset = self._newest.seq + 1 - own.seq if self._newest else 0
        return own.seq + self._seq_offset

    def wants_state(self, now_ns: int, *, used: bool) -> bool:
        """Whether to ask for the state now, because the estimates differ with the same model.

        Args:
            now_ns: monotonic clock [ns].
            used: whether this node has gone on with the state that it took before; then the pauses become longer.
        """
        if not self._differs or now_ns < self._next_ns:
            return False
        self._differs = False
        self._next_ns = now_ns + self._retry_ns
        if used:
            self._retry_ns = min(_MAX_RETRY_NS, 2 * self._retry_ns)
        return True

    def took(self, end_us: int | None) -> None:
        """The state after the window with this end was taken; None: the other node did not give it."""
        self._taken_us = end_us
        self._differs = end_us is None

    def _is_passed(self, own: TwistEstimate) -> bool:
        """Whether the other node has answered this window, or left it out."""
        return self._newest is not None and own.start_us <= self._newest.start_us

    def _compare(self, own: TwistEstimate, heard: TwistEstimate) -> None:
        self._seq_offset = heard.seq - own.seq
        self.other_model = heard.model if heard.digest != own.digest else ""
        if self.missed_us is not None and own.start_us < self.missed_us:
            return  # it says nothing about the state after the loss
        self._equal = not self.other_model and all(
            getattr(own, name) == getattr(heard, name)
            for name in ("end_us", "twists", "covariance", "events", "source")
        )
        expected = self._taken_us is None or own.start_us >= self._taken_us
        self._differs = not self._equal and not self.other_model and expected
        if self._equal:
            self._retry_ns, self._taken_us = _RETRY_NS, None


class Found(NamedTuple):
    """A state, and the end of the window after which it is."""

    end_us: int
    data: bytes


class _Asked(NamedTuple):
    digest: str
    after_us: int | None
    found: list[Found]
    done: threading.Event


class Sync:
    """Gives the state of a stream to another node, and takes it from there, on the thread of the worker.

    Args:
        stream: its name.
    """

    def __init__(self, stream: str) -> None:
        self._stream = stream
        self._asked: deque[_Asked] = deque()
        self._end_us: int | None = None  # of the state that was fetched last

    def ask(
        self, node: str, digest: str, after_us: int | None, timeout_s: float, wake: Callable[[], None]
    ) -> StateReply | None:
        """The state of this node for the model with this digest, from `after_us` on; called on another thread."""
        asked = _Asked(digest, after_us, [], threading.Event())
        self._asked.append(asked)
        wake()
        asked.done.wait(timeout_s)
        asked.done.set()
        if not asked.found:
            return None
        end_us, data = asked.found[0]
        return StateReply(node=node, stream=self._stream, digest=digest, end_us=end_us, data=data)

    def serve(self, stream: Stream) -> None:
        """Answer the other threads, each once the stream has reached the window that it wants."""
        for asked in [self._asked.popleft() for _ in range(len(self._asked))]:
            if asked.done.is_set():
                continue  # it has waited long enough
            lane = stream.lanes.serving_lane
            if lane is not None and lane.state.end_us is not None and lane.estimator.bundle.digest == asked.digest:
                if asked.after_us is not None and lane.state.end_us < asked.after_us:
                    self._asked.append(asked)
                    continue
                asked.found.append(Found(lane.state.end_us, carried.encode(lane.state, stream.inertial.learned)))
            asked.done.set()

    def is_used(self, stream: Stream) -> bool:
        """Whether the stream went on with the state that was fetched last."""
        lane = stream.lanes.serving_lane
        return lane is not None and self._end_us is not None and lane.adopted_us == self._end_us

    def renew(
        self,
        stream: Stream,
        following: Following,
        ask: Callable[[str, int | None], StateReply | None],
        now_ns: int,
    ) -> bool:
        """Take the state of the other node if the estimates differ, and if that node keeps up; whether it was asked."""
        if following.ahead_us > MAX_AHEAD_US or not following.wants_state(now_ns, used=self.is_used(stream)):
            return False
        following.took(self.fetch(stream, ask))
        return True

    def fetch(self, stream: Stream, ask: Callable[[str, int | None], StateReply | None]) -> int | None:
        """Ask the other node for its state, to go on with it where its next window begins, which is returned.

        If this node is ahead, the other one replies when it has reached the window that is open here.

        Returns:
            the end of the window after which the state is [us]; None if none came.
        """
        lane = stream.lanes.serving_lane
        if lane is None:
            return None
        reply = ask(lane.estimator.bundle.digest, lane.next_us)
        if reply is None or reply.digest != lane.estimator.bundle.digest:
            return None
        try:
            found = carried.decode(reply.data, lane.state)
        except NeuroVEError as error:
            log.warning("state refused", stream=self._stream, leader=reply.node, why=error.message)
            return None
        lane.adopt(reply.end_us, found)
        stream.inertial.adopt(reply.end_us, found.inertial)
        log.info("state taken", stream=self._stream, leader=reply.node)
        self._end_us = reply.end_us
        return reply.end_us
