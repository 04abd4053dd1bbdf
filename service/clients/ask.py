"""What a client asks a node, and what it hears: health, models, model changes as they go on, live estimates."""

import threading
from collections.abc import Callable
from typing import TypeVar

from neurove_protocol import TwistEstimate
from neurove_protocol.codec import Message
from neurove_protocol.control import (
    PROGRESS_SCHEMA,
    ActivateReply,
    ActivateRequest,
    ErrorReply,
    HealthReply,
    HealthRequest,
    ModelsReply,
    ModelsRequest,
    PeerError,
    ProgressReply,
    PushReply,
    PushRequest,
    RollbackRequest,
    StreamStatus,
)
from neurove_protocol.errors import EXIT_FAILURE, NeuroVEError
from neurove_service import logs
from neurove_service.config import ClientConfig
from neurove_service.transport import Transport, Unreachable, open_transport

log = logs.get(__name__)

CONNECT_S = 0.3
ANSWER_S = 0.8
CHANGE_S = 120.0
PUSH_S = 3600.0

ReplyT = TypeVar("ReplyT", bound=Message)
OnProgressReply = Callable[[ProgressReply], None]


def _quietly(_: ProgressReply) -> None:
    """Progress that nobody wants to hear."""


class NoService(NeuroVEError):
    """Nobody serves there."""

    code = "no_service"
    exit_code = EXIT_FAILURE


class SeveralNodes(NeuroVEError):
    """A change could be meant for one of several nodes, or for all."""

    code = "several_nodes"


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
    except Unreachable as error:
        raise NoService(f"no service: {error.message}; start one with `neurove serve`") from None


def health(transport: Transport, config: ClientConfig, node: str = "*") -> list[HealthReply]:
    """How every node is, or one of them."""
    return _ask(transport, config.keys.health(node), HealthRequest(), HealthReply, ANSWER_S)


def models(transport: Transport, config: ClientConfig, node: str = "*") -> list[ModelsReply]:
    """Which models every node has, or one of them."""
    return _ask(transport, config.keys.models(node), ModelsRequest(), ModelsReply, 5 * ANSWER_S)


def nodes(transport: Transport, config: ClientConfig, node: str | None, every: bool = True) -> list[str]:
    """Names of the nodes that a change is for.

    Args:
        transport: session.
        config: where they are.
        node: the one that was named; None: whoever is alive.
        every: whether all of them are meant, where there are several.

    Raises:
        NoService: nobody is alive. SeveralNodes: several are, and it was not said that all are meant.
    """
    if node is not None:
        return [node]
    alive = sorted({config.keys.node_of(key) for key in transport.tokens(config.keys.alive(), ANSWER_S)})
    if not alive:
        behind = ", ".join(config.connect)
        raise NoService(
            f"no service behind {behind}; is `neurove serve` running there, and does its access list know you?"
        )
    if len(alive) > 1 and not every:
        raise SeveralNodes(f"several nodes are alive: {', '.join(alive)}; name one with --node, or say --all")
    return alive


def activate(
    transport: Transport,
    config: ClientConfig,
    model: str,
    node: str,
    *,
    expect: str | None = None,
    shadow_s: float = 0.0,
    canary: tuple[str, ...] = (),
    on_progress: OnProgressReply = _quietly,
) -> ActivateReply:
    """Change the model of a node, and hear how it goes.

    Raises:
        PeerError: it refused; nothing changed there. NoService: it does not answer, or left on the way.
    """
    request = ActivateRequest(model=model, expect=expect, shadow_s=shadow_s, canary=canary)
    key, timeout_s = config.keys.activate(node), CHANGE_S + shadow_s
    return _change(transport, key, node, request, ActivateReply, timeout_s, on_progress)


def rollback(
    transport: Transport,
    config: ClientConfig,
    node: str,
    *,
    expect: str | None = None,
    on_progress: OnProgressReply = _quietly,
) -> ActivateReply:
    """Put a node back to the model before.

    Raises:
        PeerError, NoService: as activate.
    """
    request = RollbackRequest(expect=expect)
    return _change(transport, config.keys.rollback(node), node, request, ActivateReply, CHANGE_S, on_progress)


def push(
    transport: Transport,
    config: ClientConfig,
    request: PushRequest,
    node: str,
    on_progress: OnProgressReply = _quietly,
) -> PushReply:
    """Tell a node of a bundle, and hear how it pulls it; somebody must answer its chunks meanwhile.

    Raises:
        PeerError, NoService: as activate.
    """
    return _change(transport, config.keys.push(node), node, request, PushReply, PUSH_S, on_progress)


def _change(
    transport: Transport,
    key: str,
    node: str,
    request: Message,
    kind: type[ReplyT],
    timeout_s: float,
    on_progress: OnProgressReply,
) -> ReplyT:
    said = None
    try:
        for answer in transport.ask_streaming(key, request.encode(), timeout_s):
            if answer.schema != PROGRESS_SCHEMA:
                return kind.decode(answer.payload)
            said = ProgressReply.decode(answer.payload)
            on_progress(said)
    except PeerError as error:
        raise PeerError(
            ErrorReply(code=error.code, message=f"{node}: {error.message}", details=error.details)
        ) from None
    if said is None:
        raise NoService(
            f"no service answers {key}; is `neurove serve` running there, and does its access list let you ask?"
        )
    raise NoService(f"{node} left or took over {timeout_s:g} s; the last that was heard: {said.step}: {said.text}")


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
