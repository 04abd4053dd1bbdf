"""Fleet: the health of every node behind one session, for the exporter of a whole fleet."""

import threading

from neurove_protocol.control import HealthReply, HealthRequest
from neurove_protocol.errors import NeuroVEError
from neurove_service import logs
from neurove_service.clients.ask import ANSWER_S
from neurove_service.config import ClientConfig
from neurove_service.metrics.families import Fleet
from neurove_service.transport import Reply, Transport

log = logs.get(__name__)

MAX_ASKED = 64
"""Nodes that are queried one by one if one of them answers the query of all with an error."""

_ONE_S = 0.3


class Nodes:
    """Reads the health of every node.

    Args:
        transport: an open session.
        config: the deployment's prefix.
    """

    def __init__(self, transport: Transport, config: ClientConfig) -> None:
        self._transport, self._keys = transport, config.keys
        self._alive: set[str] = set()
        self._lock = threading.Lock()
        transport.watch_tokens(self._keys.alive(), self._on_token)

    def read(self) -> Fleet:
        """The nodes now; a node whose liveliness token is there and that does not answer is silent."""
        with self._lock:
            alive = sorted(self._alive)
        replies: list[HealthReply] = []
        refused = 0
        for answer in self._answers(alive):
            try:
                replies.append(HealthReply.decode(answer.payload))
            except NeuroVEError as error:
                refused += 1
                log.warning("health reply refused", key=answer.key, why=error.message)
        replies.sort(key=lambda reply: reply.node)
        answered = {reply.node for reply in replies}
        return Fleet(replies, [node for node in alive if node not in answered], refused)

    def _answers(self, alive: list[str]) -> list[Reply]:
        request = HealthRequest().encode()
        try:
            return self._transport.ask(self._keys.health(), request, ANSWER_S)
        except NeuroVEError as error:  # one of them answered with an error, which ends the query of all
            log.warning("a node refuses the query for its health", why=error.message)
        found: list[Reply] = []
        for node in alive[:MAX_ASKED]:
            try:
                found += self._transport.ask(self._keys.health(node), request, _ONE_S)
            except NeuroVEError:
                continue
        return found

    def _on_token(self, key: str, present: bool) -> None:
        node = self._keys.node_of(key)
        with self._lock:
            if present:
                self._alive.add(node)
            else:
                self._alive.discard(node)
