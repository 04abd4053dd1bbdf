"""Condition: what is wrong with a node as a whole, apart from its streams and its models."""

import time
from collections.abc import Callable, Mapping, Sequence
from types import MappingProxyType
from typing import NamedTuple

from neurove_protocol.control import StreamStatus
from neurove_service import logs
from neurove_service.guard import Guard
from neurove_service.node.followers import unfollowed
from neurove_service.node.health import stream_status
from neurove_service.streams.activity import IDLE_NS
from neurove_service.streams.registry import StreamRegistry


class Condition(NamedTuple):
    """What a node knows about itself."""

    refused_streams: int = 0  # because max_streams is reached
    internal_errors: Mapping[str, int] = MappingProxyType({})  # place -> number since the start
    recent_errors: tuple[str, ...] = ()  # the places that had one within the last minute
    dropped_log_lines: int = 0  # not read in time
    stuck_streams: tuple[str, ...] = ()  # their worker has not turned for 10 s

    missing_streams: tuple[str, ...] = ()  # expected, and without packets now
    namesakes: int = 0  # other nodes of this name on the network
    other_models: Mapping[str, str] = MappingProxyType({})  # stream -> model of the node that answers it, or did before
    unfollowed: Sequence[str] = ()  # streams that it follows no more, because it cannot keep up

    def reasons(self) -> list[str]:
        """Why the node is not ok, each as the part of a sentence."""
        reasons = [f"the loop of stream {name} is stuck" for name in self.stuck_streams]
        if self.recent_errors:
            counted = ", ".join(f"{place} {self.internal_errors.get(place, 0)}" for place in self.recent_errors)
            reasons.append(f"internal errors within a minute, total by place: {counted}; see the log of the node")
        reasons += [f"expected stream {name} is missing" for name in self.missing_streams]
        if self.namesakes:
            reasons.append(f"{self.namesakes} other nodes of this name on the network: every estimate comes twice")
        reasons += [
            f"the standby of stream {stream} is not warm: the other node has the model {model}, this one another"
            for stream, model in self.other_models.items()
        ]
        if self.unfollowed:
            reasons.append(unfollowed(self.unfollowed))
        if self.refused_streams:
            reasons.append(f"{self.refused_streams} streams refused: max_streams reached")
        return reasons


class Watch:
    """Tells the state of a node and of its streams.

    Args:
        node: its name.
        registry: its streams.
        guard: its internal errors.
        expected: the streams that it must serve.
        namesakes: number of other nodes of its name.
        left_out: the streams that it follows no more.
    """

    def __init__(
        self,
        node: str,
        registry: StreamRegistry,
        guard: Guard,
        expected: tuple[str, ...] = (),
        namesakes: Callable[[], int] = lambda: 0,
        left_out: Callable[[], Sequence[str]] = tuple,
    ) -> None:
        self._node, self._registry, self._guard = node, registry, guard
        self._expected, self._namesakes, self._left_out = expected, namesakes, left_out

    def statuses(self) -> list[StreamStatus]:
        """Status of every stream; one that cannot be told is left out."""
        statuses = []
        for stream in self._registry.streams():
            with self._guard.at("stream status", stream=stream.name):
                statuses.append(stream_status(self._node, stream, standby=self._registry.standby_of(stream.name)))
        return statuses

    def condition(self) -> Condition:
        """Of the node as a whole."""
        now_ns = time.monotonic_ns()
        present = {
            stream.name for stream in self._registry.streams() if now_ns - stream.activity.newest_packet_ns < IDLE_NS
        }
        return Condition(
            refused_streams=self._registry.refused,
            internal_errors=self._guard.counts,
            recent_errors=tuple(self._guard.recent),
            dropped_log_lines=logs.dropped(),
            stuck_streams=tuple(self._registry.stuck()),
            missing_streams=tuple(name for name in self._expected if name not in present),
            namesakes=self._namesakes(),
            unfollowed=self._left_out(),
            other_models={
                stream.name: standby.other_model
                for stream in self._registry.streams()
                if (standby := self._registry.standby_of(stream.name)) is not None and standby.other_model
            },
        )
