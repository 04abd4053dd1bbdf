"""Feed: the page's session with the deployment; it retries until a service listens, and Zenoh reconnects after that."""

import contextlib
import threading
from collections import deque
from collections.abc import Callable
from typing import Final

from neurove_protocol.control import ProgressReply
from neurove_protocol.errors import NeuroVEError
from neurove_service import logs
from neurove_service.clients import ask
from neurove_service.config import ClientConfig
from neurove_service.guard import Guard
from neurove_service.page.deployment import Deployment
from neurove_service.transport import SMALL_BATCHES, OnSample, Transport

log = logs.get(__name__)

MAX_ARRIVED: Final = 4096
"""Messages that wait to be decoded; of more, the oldest ones are dropped."""

_HEALTH_S: Final = 0.4
_MODELS_S: Final = 4.0
_RETRY_S: Final = 0.5


class Feed:
    """Fills a deployment from Zenoh until the stop event: `take` with what is published, threads with replies.

    Args:
        config: endpoints and prefix.
        deployment: receives everything.
        stop: ends the feed.
        guard: counts internal errors.

    Raises:
        EndpointError: an endpoint or the configuration is wrong.
    """

    def __init__(self, config: ClientConfig, deployment: Deployment, stop: threading.Event, guard: Guard) -> None:
        self._config, self._deployment, self._stop, self._guard = config, deployment, stop, guard
        self.transport: Transport | None = None
        self._arrived: deque[tuple[OnSample, tuple[str, bytes, int]]] = deque(maxlen=MAX_ARRIVED)
        with contextlib.suppress(ask.NoService):
            self._take(ask.connect(config, patience_s=0, more=SMALL_BATCHES))
        self._threads = [
            threading.Thread(target=work, name=name, daemon=True)
            for name, work in (("page health", self._poll_health), ("page models", self._poll_models))
        ]
        for thread in self._threads:
            thread.start()

    def close(self) -> None:
        """End after the stop event, and close the session."""
        for thread in self._threads:
            thread.join(timeout=2)
        if self.transport is not None:
            self.transport.close()

    def take(self) -> None:
        """Put the messages that have arrived into the deployment; called ten times per second.

        Zenoh's threads only append, so that they do not wait for Python at each message.
        """
        for _ in range(len(self._arrived)):
            read, sample = self._arrived.popleft()
            with self._guard.at("page message"):
                read(*sample)

    def activate(self, node: str, model: str, expect: str | None) -> str:
        """Change the model of a node; returns one sentence.

        Raises:
            PeerError, NoService: as `ask.activate`.
        """
        reply = ask.activate(self._need(), self._config, model, node, expect=expect, on_progress=self._progress)
        return f"{reply.active.name} is active" if reply.changed else f"{reply.active.name} was active already"

    def rollback(self, node: str, expect: str | None) -> str:
        """Activate the previous model of a node; returns one sentence.

        Raises:
            PeerError, NoService: as `ask.rollback`.
        """
        reply = ask.rollback(self._need(), self._config, node, expect=expect, on_progress=self._progress)
        return f"{reply.active.name} is active again"

    def _progress(self, reply: ProgressReply) -> None:
        self._deployment.running(reply.node, reply.text)

    def _need(self) -> Transport:
        if self.transport is None:
            raise ask.NoService("no service: the page has no connection")
        return self.transport

    def _take(self, transport: Transport) -> None:
        keys, deployment = self._config.keys, self._deployment
        readers = ask.readers(deployment.on_estimate, deployment.on_status)
        for key, read in zip((keys.velocity(), keys.status()), readers, strict=True):
            transport.subscribe(key, lambda *sample, read=read: self._arrived.append((read, sample)))
        transport.watch_tokens(keys.alive(), lambda key, present: deployment.on_token(keys.node_of(key), present))
        self.transport = transport
        deployment.unreachable("")

    def _poll_health(self) -> None:
        while not self._stop.is_set():
            if self.transport is None:
                self._connect()
            else:
                self._poll(lambda transport: self._deployment.on_health(ask.health(transport, self._config)))
                self._stop.wait(_HEALTH_S)

    def _connect(self) -> None:
        try:
            self._take(ask.connect(self._config, patience_s=_RETRY_S, stop=self._stop, more=SMALL_BATCHES))
        except NeuroVEError as error:
            self._deployment.unreachable(error.message)
            self._stop.wait(_RETRY_S)

    def _poll_models(self) -> None:
        while not self._stop.wait(_RETRY_S):
            if self._poll(lambda transport: self._deployment.on_models(ask.models(transport, self._config))):
                self._stop.wait(_MODELS_S)

    def _poll(self, query: Callable[[Transport], None]) -> bool:
        """Run a query; whether it was answered. A deployment that does not answer is shown as such."""
        with self._guard.at("page query"):
            try:
                if self.transport is not None:
                    query(self.transport)
                    return True
            except NeuroVEError as error:
                log.debug("query refused", why=error.message)
        return False
