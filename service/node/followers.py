"""Followers: how many streams of other nodes this node follows, so that this costs the streams that it answers nothing.

To follow a stream costs as much as to answer it. A node that cannot keep up ends followers first, half of them at a
time. While it keeps up, it follows more streams again, a few at a time. A node that joins does so too: each new
follower takes the state of its stream from another node, and a few such transfers disturb nobody.
"""

import itertools
import threading
import time
from collections.abc import Callable, Sequence
from typing import Final, Protocol

from neurove_protocol.duty import DutyReply
from neurove_service import logs
from neurove_service.streams.activity import IDLE_NS
from neurove_service.streams.overload import FAR_BEHIND_NS
from neurove_service.streams.stream import Stream

log = logs.get(__name__)

AT_ONCE: Final = 4
"""So many streams may be followed whose state is not equal yet; and so many more each second after an overload."""

LATE_S: Final = 1.0
"""A node whose packets wait `overload.FAR_BEHIND_NS` for this time cannot keep up."""

_LEFT_OUT: Final = ("shed_windows", "overload_packets")
_JOINING_S: Final = 10.0  # a stream whose state is not equal after this time does not keep others waiting
_PAUSE_S, _MAX_PAUSE_S = 4.0, 60.0  # from an overload to the next follower
_GROW_S: Final = 1.0
_SHOWN: Final = 4  # names in a sentence


class _Others(Protocol):
    """The other nodes, as `Fellows`."""

    def names(self, stream: str, /) -> Sequence[str]:
        """Those that serve a stream."""

    def duties(self) -> list[DutyReply]:
        """What this node does on each of its streams."""

    def retire(self, stream: str, /) -> bool:
        """Let the worker of a stream that this node follows end; False if it does not follow the stream any more."""


class Followers:
    """Decides which streams a node begins to follow, and which it follows no more; thread-safe.

    Args:
        owns: whether a stream is one of this node, by its name.
        others: the other nodes.
        now_s: monotonic clock [s].
    """

    def __init__(
        self, owns: Callable[[str], bool], others: _Others, now_s: Callable[[], float] = time.monotonic
    ) -> None:
        self._owns, self._others, self._now_s = owns, others, now_s
        self._free, self._most = AT_ONCE, float("inf")  # that may begin now; that may be followed
        self._began_s: dict[str, float] = {}  # stream -> when this node began to follow it
        self._left_out_s: dict[str, float] = {}  # stream -> when this node last did not begin to follow it
        self._late_s: float | None = None  # since when this node is late
        self._grow_s, self._pause_s = 0.0, _PAUSE_S
        self._lock = threading.Lock()

    def takes(self, stream: str) -> bool:
        """Whether to serve a stream now that this node does not serve: at once if no other node does."""
        if not self._owns(stream):
            return False
        if not self._others.names(stream):
            return True
        with self._lock:
            if self._free > 0:
                self._free -= 1
                self._began_s[stream] = self._now_s()
                self._left_out_s.pop(stream, None)
                return True
            self._left_out_s[stream] = self._now_s()
            return False

    @property
    def left_out(self) -> Sequence[str]:
        """The streams that this node does not follow because it could not keep up."""
        with self._lock:
            since_s = self._now_s() - IDLE_NS / 1e9
            limited = self._most < float("inf")
            return sorted(name for name, at_s in self._left_out_s.items() if at_s > since_s) if limited else ()

    def turn(self, streams: Sequence[Stream]) -> Sequence[str]:
        """Look at the load; to be called several times a second.

        Args:
            streams: those that this node serves.

        Returns:
            the streams that this node follows no more: their workers have retired. One that has taken over meanwhile
            is not among them.
        """
        now_s, duties = self._now_s(), self._others.duties()
        follows = [one for one in duties if one.role == "follows" and one.leader in self._others.names(one.stream)]
        late = any(_is_late(one, int(1e9 * now_s)) for one in streams)
        with self._lock:
            self._began_s = {name: at_s for name, at_s in self._began_s.items() if now_s - at_s < _JOINING_S}
            self._left_out_s = {name: at_s for name, at_s in self._left_out_s.items() if now_s - at_s < 2 * _GROW_S}
            self._late_s = (now_s if self._late_s is None else self._late_s) if late else None
            if self._late_s is not None and now_s - self._late_s > LATE_S:
                return self._shrink(follows, now_s)
            if not late and now_s > self._grow_s:
                self._grow(now_s)
            joining = sum(not one.equal and one.stream in self._began_s for one in duties)
            self._free = 0 if late else int(max(0, min(AT_ONCE - joining, self._most - len(follows))))
            return ()

    def _shrink(self, follows: list[DutyReply], now_s: float) -> Sequence[str]:
        """Half of the streams that are followed: first those of other nodes, then those that are not ready."""
        self._free, self._late_s = 0, now_s
        if now_s > self._grow_s + _MAX_PAUSE_S:
            self._pause_s = _PAUSE_S
        self._grow_s, self._pause_s = now_s + self._pause_s, min(_MAX_PAUSE_S, 2 * self._pause_s)
        order = sorted(follows, key=lambda one: (self._owns(one.stream), one.equal, one.stream))
        candidates = (one.stream for one in order)
        ended = list(itertools.islice(filter(self._others.retire, candidates), (len(order) + 1) // 2))
        self._most = len(order) - len(ended)
        self._left_out_s |= dict.fromkeys(filter(self._owns, ended), now_s)
        if ended:
            log.warning("cannot keep up: follows fewer streams", follows=self._most, ended=len(ended))
        return ended

    def _grow(self, now_s: float) -> None:
        if self._most == float("inf"):
            return
        self._grow_s, self._most = now_s + _GROW_S, self._most + AT_ONCE
        if not any(now_s - at_s < _GROW_S for at_s in self._left_out_s.values()):
            self._most = float("inf")
            log.info("keeps up: follows all streams again")


def _is_late(stream: Stream, now_ns: int) -> bool:
    """Whether the packets of a stream wait too long, or windows were left out instead."""
    waits = stream.flowing and stream.activity.waited_ns > FAR_BEHIND_NS
    return waits or any(stream.activity.grew_within(name, LATE_S, now_ns) for name in _LEFT_OUT)


def unfollowed(streams: Sequence[str]) -> str:
    """The sentence for the health of a node.

    >>> unfollowed(["cam0", "cam1"])
    'this node cannot keep up and follows 2 streams no more, so they have one standby less: cam0, cam1'
    """
    named = ", ".join([*streams[:_SHOWN], *(["..."] if len(streams) > _SHOWN else [])])
    return (
        f"this node cannot keep up and follows {len(streams)} stream{'s' * (len(streams) > 1)} no more, "
        f"so {'they have' if len(streams) > 1 else 'it has'} one standby less: {named}"
    )
