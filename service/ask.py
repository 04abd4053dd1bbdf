"""What a client asks a node, and what it hears: health, models, activate, live estimates."""

import threading
from collections.abc import Callable
from typing import TypeVar

from protocol import TwistEstimate
from protocol.codec import Message
from protocol.control import (
    ActivateReply,
    ActivateRequest,
    HealthReply,
    HealthRequest,
    ModelsReply,
    ModelsRequest,
    StreamStatus,
)
from protocol.errors import NeuroVEError
from service import logs
from service.config import ClientConfig
from service.transport import EndpointError, Transport, open_transport

log = logs.get(__name__)

CONNECT_S = 0.3
ANSWER_S = 0.8
ACTIVATE_S = 60.0

ReplyT = TypeVar("ReplyT", bound=Message)


class NoService(NeuroVEError):
    """Nobody serves there."""

    code = "no_service"


def connect(config: ClientConfig, patience_s: float = CONNECT_S, stop: threading.Event | None = None) -> Transport:
    """A session towards a service or a router.

    Raises:
        NoService: nobody listens there.
    """
    try:
        return open_transport(
            "client",
            connect=config.connect,
            config_file=config.zenoh_config,
            patience_s=patience_s,
            stop=stop,
        )
    except EndpointError as error:
        if error.message.startswith("nobody"):
            raise NoService(f"no service: {error.message}; start one with `neurove serve`") from None
        raise


def health(transport: Transport, config: ClientConfig, node: str = "*") -> list[HealthReply]:
    """How every node is, or one of them."""
    return _ask(transport, config.keys.health(node), HealthRequest(), HealthReply, ANSWER_S)


def models(transport: Transport, config: ClientConfig, node: str = "*") -> list[ModelsReply]:
    """Which models every node has, or one of them."""
    return _ask(transport, config.keys.models(node), ModelsRequest(), ModelsReply, 5 * ANSWER_S)


def activate(transport: Transport, config: ClientConfig, model: str, node: str = "*") -> list[ActivateReply]:
    """Change the model of every node, or of one.

    Raises:
        PeerError: a node refused; nothing changed there.
    """
    return _ask(transport, config.keys.activate(node), ActivateRequest(model=model), ActivateReply, ACTIVATE_S)


def _ask(transport: Transport, key: str, request: Message, reply: type[ReplyT], timeout_s: float) -> list[ReplyT]:
    answers = transport.ask(key, request.encode(), timeout_s)
    if not answers:
        # Zenoh tells a denied question from one that nobody answers as little as we can here.
        raise NoService(
            f"no service answers {key}; is `neurove serve` running there, and does its access list let you ask?"
        )
    return sorted((reply.decode(answer.payload) for answer in answers), key=lambda one: str(getattr(one, "node", "")))


def need_service(transport: Transport, config: ClientConfig) -> None:
    """Check that some node is alive.

    Raises:
        NoService: none is.
    """
    if not transport.tokens(config.keys.alive(), ANSWER_S):
        behind = ", ".join(config.connect)
        raise NoService(
            f"no service behind {behind}; is `neurove serve` running there, and does its access list know you?"
        )


def listen(
    transport: Transport,
    config: ClientConfig,
    on_estimate: Callable[[TwistEstimate], None],
    on_status: Callable[[StreamStatus], None],
) -> None:
    """Hear every estimate and status, called on Zenoh's thread; what can not be read is logged and left out."""

    def decoded(kind: type[ReplyT], use: Callable[[ReplyT], None]) -> Callable[[str, bytes, int], None]:
        def on_sample(key: str, payload: bytes, _: int) -> None:
            try:
                use(kind.decode(payload))
            except NeuroVEError as error:
                log.warning("message refused", key=key, why=error.message)

        return on_sample

    transport.subscribe(config.keys.velocity(), decoded(TwistEstimate, on_estimate))
    transport.subscribe(config.keys.status(), decoded(StreamStatus, on_status))
