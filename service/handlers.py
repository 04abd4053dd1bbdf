"""Request bytes -> reply bytes, one function per queryable; tested without a network."""

import importlib.metadata
import time
from collections.abc import Callable

from protocol.control import (
    ActivateReply,
    ActivateRequest,
    HealthReply,
    HealthRequest,
    ModelsReply,
    ModelsRequest,
    StreamStatus,
)
from service.health import node_verdict
from service.model_slot import ModelSlot

VERSION = importlib.metadata.version("neurove")


class Handlers:
    """What a node answers.

    Args:
        node: its name.
        slot: its models.
        streams: the status of every stream it serves now.
        refused_streams: how many streams it did not take.
        ready: whether the next packet gets its estimate.
    """

    def __init__(
        self,
        node: str,
        slot: ModelSlot,
        streams: Callable[[], list[StreamStatus]],
        refused_streams: Callable[[], int],
        ready: Callable[[], bool] = lambda: True,
    ) -> None:
        self._node, self._slot = node, slot
        self._streams, self._refused_streams, self._ready = streams, refused_streams, ready
        self._began = time.monotonic()

    def health(self, request: bytes) -> bytes:
        """How this node is."""
        HealthRequest.decode(request)
        streams = self._streams()
        refused = self._refused_streams()
        ok, why = node_verdict(streams, refused)
        active = self._slot.active
        reply = HealthReply(
            node=self._node,
            ok=ok,
            why=why,
            uptime_s=time.monotonic() - self._began,
            version=VERSION,
            model=active.estimator.bundle.info,
            epoch=active.epoch,
            refused_streams=refused,
            streams=tuple(streams),
            ready=self._ready(),
            change=self._slot.last_change,
            rollbacks=self._slot.rollbacks,
        )
        return reply.encode()

    def models(self, request: bytes) -> bytes:
        """Which models this node has."""
        ModelsRequest.decode(request)
        active, previous, available = self._slot.active, self._slot.previous, self._slot.available()
        reply = ModelsReply(
            node=self._node,
            active=active.estimator.bundle.info,
            previous=previous.info if previous else None,
            epoch=active.epoch,
            available=available.models,
            unreadable=available.unreadable,
        )
        return reply.encode()

    def activate(self, request: bytes) -> bytes:
        """Change the model; the old one serves until the new one is ready."""
        wanted = ActivateRequest.decode(request)
        previous, serving = self._slot.activate(wanted.model)
        reply = ActivateReply(
            node=self._node, active=serving.estimator.bundle.info, previous=previous.info, epoch=serving.epoch
        )
        return reply.encode()
