"""Duty: what becomes of the estimates of one stream. Alone, a node publishes them all; `pair.Pair` stands by."""

from collections.abc import Callable
from typing import Protocol

from neurove_protocol import TwistEstimate
from neurove_protocol.control import StandbyStatus
from neurove_service.streams.stream import Stream


class Duty(Protocol):
    """Asked by the worker of a stream, on its thread."""

    @property
    def can_wait(self) -> bool:
        """Whether workers of other streams go first."""

    @property
    def retired(self) -> bool:
        """Whether the worker shall end, because other nodes answer the stream; any thread may ask."""

    def answer(self, estimate: TwistEstimate, /) -> list[TwistEstimate]:
        """The estimates to publish now that this one is there."""

    def turn(self, stream: Stream, /) -> list[TwistEstimate]:
        """The estimates to publish now; called in each turn of the worker's loop."""

    def wait_s(self, most_s: float, /) -> float:
        """How long the worker may wait before the next turn, at most `most_s` [s]."""

    def status(self) -> StandbyStatus | None:
        """For the status of the stream; any thread may ask."""

    def close(self) -> None:
        """The worker has ended."""


class Alone:
    """The duty of a node without standby: it publishes every estimate."""

    @property
    def can_wait(self) -> bool:
        """False."""
        return False

    @property
    def retired(self) -> bool:
        """False."""
        return False

    def answer(self, estimate: TwistEstimate) -> list[TwistEstimate]:
        """The estimate itself."""
        return [estimate]

    def turn(self, _: Stream) -> list[TwistEstimate]:
        """Nothing."""
        return []

    def wait_s(self, most_s: float) -> float:
        """As long as the worker wants."""
        return most_s

    def status(self) -> StandbyStatus | None:
        """None."""
        return None

    def close(self) -> None:
        """Nothing."""


OpenDuty = Callable[[str, Callable[[], None]], Duty]
"""Opens the duty of a stream, by its name; the callback wakes the worker. It must return at once."""


def alone(_stream: str, _wake: Callable[[], None]) -> Duty:
    """The duty of a node without standby."""
    return Alone()
