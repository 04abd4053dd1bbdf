"""Roster: which nodes answer now, with what, and which do not answer."""

import time
from collections.abc import Iterable
from concurrent.futures import ThreadPoolExecutor
from typing import Final, NamedTuple

from neurove_protocol.control import HealthReply, HealthRequest
from neurove_protocol.errors import NeuroVEError
from neurove_service import logs
from neurove_service.config import ClientConfig
from neurove_service.transport import Reply, Transport

log = logs.get(__name__)

ANSWER_S: Final = 3.0
"""Longest wait for the answers of all nodes [s]; it ends as soon as every node has answered."""

_AT_ONCE: Final = 16  # nodes that are queried one by one, if one of them answers the query of all with an error

CONNECTED: Final = "is connected and does not answer"
NOT_CONNECTED: Final = "is expected and not connected"


class Roster(NamedTuple):
    """The nodes at one time."""

    replies: dict[str, HealthReply]  # by node; those that answered
    silent: dict[str, str]  # node -> why it has no reply, as the predicate of a sentence
    took_s: float  # time of the query [s]
    received_bytes: int  # of the replies
    asked_s: float = 0.0  # when the query began (monotonic) [s]; every reply was made later


def ask(
    transport: Transport, config: ClientConfig, expected: Iterable[str] = (), timeout_s: float = ANSWER_S
) -> Roster:
    """Query every node for its health.

    A node that is connected, by its liveliness token, and does not answer is silent. So is an expected node that is not
    connected. An answer that cannot be read counts as no answer.

    Args:
        transport: an open session.
        config: the deployment's prefix.
        expected: names of nodes that should answer.
        timeout_s: longest wait [s].
    """
    began = time.monotonic()
    tokens = {config.keys.node_of(key) for key in transport.tokens(config.keys.alive(), timeout_s)}
    answers, errors = _answers(transport, config, sorted(tokens), timeout_s)
    replies: dict[str, HealthReply] = {}
    for answer in answers:
        try:
            reply = HealthReply.decode(answer.payload)
            replies[reply.node] = reply
        except NeuroVEError as error:
            log.warning("health reply refused", key=answer.key, why=error.message)
            errors[config.keys.node_of(answer.key)] = f"sends a health reply that cannot be read: {error.message}"
    silent = {
        node: errors.get(node, CONNECTED if node in tokens else NOT_CONNECTED)
        for node in sorted((tokens | set(expected) | set(errors)) - replies.keys())
    }
    received = sum(len(answer.payload) for answer in answers)
    return Roster(dict(sorted(replies.items())), silent, time.monotonic() - began, received, began)


def _answers(
    transport: Transport, config: ClientConfig, alive: list[str], timeout_s: float
) -> tuple[list[Reply], dict[str, str]]:
    """The answers of all nodes; and of those that refuse, by name, what they do."""
    request = HealthRequest().encode()
    try:
        return transport.ask(config.keys.health(), request, timeout_s), {}
    except NeuroVEError as error:  # one of them answered with an error, which ends the query of all
        log.info("a node refuses the query for its health", why=error.message)
    errors: dict[str, str] = {}

    def one(node: str) -> list[Reply]:
        try:
            return transport.ask(config.keys.health(node), request, timeout_s)
        except NeuroVEError as error:
            errors[node] = f"answers with an error: {error.message}"
            return []

    with ThreadPoolExecutor(_AT_ONCE) as pool:
        return [reply for replies in pool.map(one, alive) for reply in replies], errors
