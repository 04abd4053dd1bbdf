"""Following: the estimates of the node that answers, beside those of this node; and the exchange of state."""

import threading
from collections import OrderedDict, deque
from collections.abc import Callable
from typing import Final, NamedTuple

from neurove_core import carried
from neurove_protocol import TwistEstimate
from neurove_protocol.duty import StateReply
from neurove_protocol.errors import NeuroVEError
from neurove_service import logs
from neurove_service.streams.stream import Stream

log = logs.get(__name__)

KEPT: Final = 256
"""Estimates that are kept, of this node and of the other one."""

_PASSED_US: Final = 5_000_000  # a clock that goes back further has begun anew
_RETRY_NS, _MAX_RETRY_NS = 200_000_000, 60_000_000_000  # between requests for the state


class Following:
    """Holds back the estimates of this node until those of the other node are heard, and compares both.

    The worker of the stream uses it; any thread may read `equal`, `digest` and `other_model`.
    """

    def __init__(self) -> None:
        self.equal = False  # the newest pair of estimates is the same, bit for bit
        self.digest = ""  # of the model of this node
        self.other_model = ""  # of the other node, where it is another one
        self._kept: deque[tuple[TwistEstimate, int]] = deque(maxlen=KEPT)  # with the time of finishing [ns]
        self._heard: OrderedDict[int, TwistEstimate] = OrderedDict()  # by start of the window, not yet compared
        self._newest: TwistEstimate | None = None  # that was heard
        self._seq_offset: int | None = None  # from this node's numbers to the ones on the wire
        self._left_out_us: int | None = None  # a window that the other node has answered, though it is not heard
        self._differs = False
        self._next_ns, self._retry_ns = 0, _RETRY_NS

    @property
    def since_ns(self) -> int | None:
        """When the oldest estimate that is kept was finished; None if there is none."""
        return self._kept[0][1] if self._kept else None

    def add(self, own: TwistEstimate, now_ns: int) -> None:
        """An estimate of this node is there."""
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
        self._newest, self._left_out_us = heard, None
        same = next((own for own, _ in self._kept if own.start_us == heard.start_us), None)
        if same is not None:
            self._compare(same, heard)
        else:
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
        """All that is kept, oldest first."""
        kept = [own for own, _ in self._kept]
        self._kept.clear()
        self._heard.clear()
        return kept

    def renew(self, now_ns: int) -> None:
        """Wait anew for what is kept: a long pause says nothing about the other node."""
        self._kept = deque(((own, now_ns) for own, _ in self._kept), maxlen=KEPT)

    def seq_of(self, own: TwistEstimate) -> int:
        """The number of an estimate on the wire: it goes on where the other node stopped."""
        if self._seq_offset is None:
            self._seq_offset = self._newest.seq + 1 - own.seq if self._newest else 0
        return own.seq + self._seq_offset

    def wants_state(self, now_ns: int) -> bool:
        """Whether to ask for the state now, because the estimates differ with the same model."""
        if not self._differs or now_ns < self._next_ns:
            return False
        self._differs = False
        self._next_ns, self._retry_ns = now_ns + self._retry_ns, min(_MAX_RETRY_NS, 2 * self._retry_ns)
        return True

    def _is_passed(self, own: TwistEstimate) -> bool:
        """Whether the other node has answered this window, or left it out."""
        return self._newest is not None and 0 <= self._newest.start_us - own.start_us < _PASSED_US

    def _compare(self, own: TwistEstimate, heard: TwistEstimate) -> None:
        self._seq_offset = heard.seq - own.seq
        self.other_model = heard.model if heard.digest != own.digest else ""
        self.equal = not self.other_model and all(
            getattr(own, name) == getattr(heard, name)
            for name in ("end_us", "twists", "covariance", "events", "source")
        )
        self._differs = not self.equal and not self.other_model
        if self.equal:
            self._retry_ns = _RETRY_NS


class Found(NamedTuple):
    """A state, and the end of the window after which it is."""

    end_us: int
    data: bytes


class _Asked(NamedTuple):
    digest: str
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

    def ask(self, digest: str, timeout_s: float, wake: Callable[[], None]) -> Found | None:
        """The state of this node for the model with this digest; called on another thread."""
        asked = _Asked(digest, [], threading.Event())
        self._asked.append(asked)
        wake()
        asked.done.wait(timeout_s)
        return asked.found[0] if asked.found else None

    def serve(self, stream: Stream) -> None:
        """Answer the other threads."""
        while self._asked:
            asked = self._asked.popleft()
            lane = stream.lanes.serving_lane
            if lane is not None and lane.state.end_us is not None and lane.estimator.bundle.digest == asked.digest:
                asked.found.append(Found(lane.state.end_us, carried.encode(lane.state)))
            asked.done.set()

    def fetch(self, stream: Stream, ask: Callable[[str], StateReply | None]) -> bool:
        """Ask the other node for its state, to go on with it where its next window begins; whether it came."""
        lane = stream.lanes.serving_lane
        if lane is None:
            return False
        reply = ask(lane.estimator.bundle.digest)
        if reply is None or reply.digest != lane.estimator.bundle.digest:
            return False
        try:
            lane.adopt(reply.end_us, carried.decode(reply.data, lane.state))
        except NeuroVEError as error:
            log.warning("state refused", stream=self._stream, leader=reply.node, why=error.message)
            return False
        log.info("state taken", stream=self._stream, leader=reply.node)
        return True
