"""Condition: what is wrong with a node as a whole, apart from its streams and its models."""

from collections.abc import Mapping
from types import MappingProxyType
from typing import NamedTuple

from neurove_protocol.control import StreamStatus
from neurove_service import logs
from neurove_service.guard import Guard
from neurove_service.node.health import stream_status
from neurove_service.streams.registry import StreamRegistry


class Condition(NamedTuple):
    """What a node knows about itself."""

    refused_streams: int = 0  # because max_streams is reached
    internal_errors: Mapping[str, int] = MappingProxyType({})  # place -> number since the start
    recent_errors: tuple[str, ...] = ()  # the places that had one within the last minute
    dropped_log_lines: int = 0  # not read in time
    stuck_streams: tuple[str, ...] = ()  # their worker has not turned for 10 s

    def reasons(self) -> list[str]:
        """Why the node is not ok, each as the part of a sentence."""
        reasons = [f"the loop of stream {name} is stuck" for name in self.stuck_streams]
        if self.recent_errors:
            counted = ", ".join(f"{place} {self.internal_errors.get(place, 0)}" for place in self.recent_errors)
            reasons.append(f"internal errors within a minute, total by place: {counted}; see the log of the node")
        if self.refused_streams:
            reasons.append(f"{self.refused_streams} streams refused: max_streams reached")
        return reasons


class Watch:
    """Tells the state of a node and of its streams.

    Args:
        node: its name.
        registry: its streams.
        guard: its internal errors.
    """

    def __init__(self, node: str, registry: StreamRegistry, guard: Guard) -> None:
        self._node, self._registry, self._guard = node, registry, guard

    def statuses(self) -> list[StreamStatus]:
        """Status of every stream; one that cannot be told is left out."""
        statuses = []
        for stream in self._registry.streams():
            with self._guard.at("stream status", stream=stream.name):
                statuses.append(stream_status(self._node, stream))
        return statuses

    def condition(self) -> Condition:
        """Of the node as a whole."""
        return Condition(
            refused_streams=self._registry.refused,
            internal_errors=self._guard.counts,
            recent_errors=tuple(self._guard.recent),
            dropped_log_lines=logs.dropped(),
            stuck_streams=tuple(self._registry.stuck()),
        )
