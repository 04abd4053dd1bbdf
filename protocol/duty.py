"""Messages of nodes that stand by for each other: role, state, take; drain; and the rule that a consumer follows."""

from typing import Annotated, ClassVar, Literal

from pydantic import Field

from neurove_protocol.codec import Count, Int64, Message, Name
from neurove_protocol.control import Digest, Request

MAX_STATE_BYTES = 33 << 20
"""Cap of a StateReply."""

QUIET_NS = 10_000_000_000
"""After this time without an estimate a consumer accepts any term: the nodes may have restarted with another clock."""

AGAIN_US = 20_000_000
"""At the begin of a term, windows up to this much before the newest one are not taken again.

After an interruption of a link, an estimate that arrives can be as old as the lease of the link (10 s)."""

Role = Literal["answers", "follows", "listens", "absent"]
"""A node publishes the estimates of a stream; it keeps its own and hears those of another node; it knows no node that
answers; or it does not serve the stream."""


class DutyRequest(Request):
    """Ask what a node does on a stream."""

    what: ClassVar[str] = "duty request"

    stream: Name


class DutyReply(Message):
    """What a node does on a stream."""

    what: ClassVar[str] = "duty reply"

    node: Name
    stream: Name
    role: Role
    term: Count = 0  # the newest that it knows
    leader: Name | None = None  # the node that answers; None if it knows none
    equal: bool = False  # its newest estimates were those of the leader, bit for bit, and it is not behind
    missed_us: Int64 | None = None  # start of the newest window of which it missed packets; None if it missed none
    draining: bool = False
    digest: str = ""  # of its model; empty before the first window


class StateRequest(Request):
    """Ask for the state of a stream after its newest window."""

    what: ClassVar[str] = "state request"

    stream: Name
    digest: Digest  # of the model of the asking node
    after_us: Int64 | None = None  # reply once the state is that after a window with this end, or a later one


class StateReply(Message):
    """The state of a stream after a window, for the same model on another node."""

    what: ClassVar[str] = "state reply"
    max_bytes: ClassVar[int] = MAX_STATE_BYTES

    node: Name
    stream: Name
    digest: Digest
    end_us: Int64  # the state is that after the window with this end, sensor clock
    data: Annotated[bytes, Field(max_length=MAX_STATE_BYTES)]


class TakeRequest(Request):
    """Ask a node that follows a stream to answer it from the next window on."""

    what: ClassVar[str] = "take request"

    stream: Name
    node: Name  # that answered until now
    term: Count  # its term
    start_us: Int64 | None  # start of the last window that it answered; None if there is none


class DrainRequest(Request):
    """Ask a node to hand over its streams."""

    what: ClassVar[str] = "drain request"

    resume: bool = False  # instead: end the draining, so that the node may answer again


class DrainReply(Message):
    """The result of a drain."""

    what: ClassVar[str] = "drain reply"

    node: Name
    handed: dict[str, str]  # stream -> the node that answers it now
    kept: dict[str, str]  # stream -> why this node still answers it


class Newest:
    """The rule of a consumer of one stream: which estimates it takes where several nodes may answer.

    It takes none of an earlier term than the newest one. At the begin of a new term it takes no window again.

    >>> newest = Newest()
    >>> [newest.takes(term, start_us, 0) for term, start_us in ((7, 0), (7, 50), (9, 50), (9, 100), (7, 100))]
    [True, True, False, True, False]
    """

    def __init__(self) -> None:
        self._term = -1
        self._at_ns = 0
        self._newest_us = 0  # start of the newest window that was taken
        self._begins = False  # no new window of the term was taken yet

    def takes(self, term: int | None, start_us: int, now_ns: int) -> bool:
        """Whether to take an estimate.

        Args:
            term: of the estimate; one without a term is always taken.
            start_us: of the estimate.
            now_ns: when it arrived, on a monotonic clock.
        """
        if term is None:
            return True
        if term < self._term and now_ns - self._at_ns < QUIET_NS:
            return False
        if term != self._term:
            self._begins = self._term >= 0
            self._term = term
        if self._begins and 0 <= self._newest_us - start_us < AGAIN_US:
            return False
        self._at_ns, self._begins, self._newest_us = now_ns, False, start_us
        return True
