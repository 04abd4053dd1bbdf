"""The interface between a stream and the part of the node that decides which models serve.

`neurove_service.models.slot.ModelSlot` implements `ModelSource`; this package does not import it.
"""

from typing import Protocol

from neurove_service.streams.lanes import Lanes
from neurove_service.streams.roles import Roles, Serving


class StreamView(Protocol):
    """A stream as a model change sees it."""

    name: str
    lanes: Lanes

    @property
    def flowing(self) -> bool:
        """Whether packets arrive and are processed."""


class ModelSource(Protocol):
    """Gives a stream its models."""

    def roles(self, stream: str, /) -> Roles:
        """Which models work on this stream from its next packet on; called once per packet."""

    def fault(self, serving: Serving, why: str, /) -> None:
        """Report that a serving model failed; a model on probation is rolled back at once."""

    def join(self, stream: StreamView, /) -> None:
        """Include a stream in every model change from now on, for as long as the stream lives."""
