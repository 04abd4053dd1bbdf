"""Queries to nodes and what nodes publish: health, models, model changes with progress, live estimates."""

import threading
from collections import defaultdict
from collections.abc import Callable, Mapping
from types import MappingProxyType
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
from neurove_protocol.duty import DrainReply, DrainRequest, Newest
from neurove_protocol.errors import EXIT_FAILURE, NeuroVEError
from neurove_service import logs
from neurove_service.clients.transit import Transit
from neurove_service.config import ClientConfig
from neurove_service.transport import OnSample, Transport, Unreachable, open_transport

log = logs.get(__name__)

CONNECT_S = 0.3
ANSWER_S = 0.8
CHANGE_S = 120.0
PUSH_S = 3600.0

ReplyT = TypeVar("ReplyT", bound=Message)
OnProgressReply = Callable[[ProgressReply], None]


def _ignore(_: ProgressReply) -> None:
    """Ignore the progress."""


class NoService(NeuroVEError):
    """No service answers."""

    code = "no_service"
    exit_code = EXIT_FAILURE


class SeveralNodes(NeuroVEError):
    """Several nodes are alive, and the user named neither one nor all."""

    code = "several_nodes"


def connect(
    config: ClientConfig,
    patience_s: float = CONNECT_S,
    stop: threading.Event | None = None,
    more: Mapping[str, object] = MappingProxyType({}),
) -> Transport:
    """Open a session with a service or a router.

    Args:
        config: endpoints, and Zenoh's configuration.
        patience_s: how long to retry while nothing listens there.
        stop: ends the retries.
        more: settings of the session, as for `open_transport`.

    Raises:
        NoService: nothing listens at the endpoints. EndpointError: an endpoint or the configuration is wrong.
    """
    try:
        return open_transport(
            "client",
            connect=config.connect,
            config_file=config.zenoh_config,
            patience_s=patience_s,
            stop=stop,
            more=more,
        )
    except Unreachable as error:
        raise NoService(f"no service: {error.message}; start one with `neurove serve`") from None


def health(transport: Transport, config: ClientConfig, node: str = "*") -> list[HealthReply]:
    """The health of one node, or of every node.

    Raises:
        NoService: no node answers.
    """
    return _query(transport, config.keys.health(node), HealthRequest(), HealthReply, ANSWER_S)


def models(transport: Transport, config: ClientConfig, node: str = "*") -> list[ModelsReply]:
    """The models of one node, or of every node.

    Raises:
        NoService: no node answers.
    """
    return _query(transport, config.keys.models(node), ModelsRequest(), ModelsReply, 5 * ANSWER_S)


def nodes(transport: Transport, config: ClientConfig, node: str | None, every: bool = True) -> list[str]:
    """Names of the nodes that a change applies to.

    Args:
        transport: an open session.
        config: the deployment's prefix and endpoints.
        node: name of one node; None for the nodes that are alive.
        every: whether the change applies to all nodes if several are alive.

    Raises:
        NoService: no node is alive. SeveralNodes: several nodes are alive, and `every` is false.
    """
    if node is not None:
        return [node]
    alive = sorted({config.keys.node_of(key) for key in transport.tokens(config.keys.alive(), ANSWER_S)})
    if not alive:
        raise _no_node(config)
    if len(alive) > 1 and not every:
        raise SeveralNodes(f"several nodes are alive: {', '.join(alive)}; give --node NAME or --all")
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
    force: str | None = None,
    on_progress: OnProgressReply = _ignore,
) -> ActivateReply:
    """Change the model of a node.

    Args:
        transport: an open session.
        config: the deployment's prefix.
        model: name, or the first 8 or more digits of its digest.
        node: name of the node.
        expect: first digits of the active model's digest; the node refuses if another model is active.
        shadow_s: time that the model runs in shadow before it becomes active [s].
        canary: streams to change; empty for all.
        force: why no difference from the active model may refuse it; None: differences count.
        on_progress: receives each step.

    Raises:
        PeerError: the node refused; its model is unchanged. NoService: it does not answer, or left during the change.
    """
    request = ActivateRequest(model=model, expect=expect, shadow_s=shadow_s, canary=canary, force=force)
    key, timeout_s = config.keys.activate(node), CHANGE_S + shadow_s
    return _change(transport, key, node, request, ActivateReply, timeout_s, on_progress)


def rollback(
    transport: Transport,
    config: ClientConfig,
    node: str,
    *,
    expect: str | None = None,
    on_progress: OnProgressReply = _ignore,
) -> ActivateReply:
    """Activate the previous model of a node again.

    Raises:
        PeerError, NoService: as `activate`.
    """
    request = RollbackRequest(expect=expect)
    return _change(transport, config.keys.rollback(node), node, request, ActivateReply, CHANGE_S, on_progress)


def drain(transport: Transport, config: ClientConfig, node: str, *, resume: bool = False) -> DrainReply:
    """Let a node hand over its streams to the nodes that follow them.

    Args:
        transport: an open session.
        config: the deployment's prefix.
        node: name of the node.
        resume: instead, end the draining.

    Raises:
        NoService: the node does not answer, or it has no standby.
    """
    answers = transport.ask(config.keys.drain(node), DrainRequest(resume=resume).encode(), CHANGE_S)
    if not answers:
        raise NoService(f"{node}: it does not answer, or its setting standby is off, so no node can follow it")
    return DrainReply.decode(answers[0].payload)


def push(
    transport: Transport,
    config: ClientConfig,
    request: PushRequest,
    node: str,
    on_progress: OnProgressReply = _ignore,
) -> PushReply:
    """Offer a bundle to a node and wait until the node has pulled it; meanwhile `PushSource` must answer its chunks.

    Raises:
        PeerError, NoService: as `activate`.
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
    last = None
    try:
        for answer in transport.ask_streaming(key, request.encode(), timeout_s):
            if answer.schema != PROGRESS_SCHEMA:
                return kind.decode(answer.payload)
            last = ProgressReply.decode(answer.payload)
            on_progress(last)
    except PeerError as error:
        raise PeerError(
            ErrorReply(code=error.code, message=f"{node}: {error.message}", details=error.details)
        ) from None
    if last is None:
        raise _no_answer(key)
    raise NoService(f"{node} left or needs more than {timeout_s:g} s; its last step: {last.step}: {last.text}")


def _query(transport: Transport, key: str, request: Message, reply: type[ReplyT], timeout_s: float) -> list[ReplyT]:
    answers = transport.ask(key, request.encode(), timeout_s)
    if not answers:
        raise _no_answer(key)
    return sorted((reply.decode(answer.payload) for answer in answers), key=lambda one: str(getattr(one, "node", "")))


def _no_answer(key: str) -> NoService:
    """The error for a query without an answer; Zenoh does not report whether an access list denied it."""
    return NoService(f"no service answers {key}; is `neurove serve` running there, and does its access list admit you?")


def _no_node(config: ClientConfig) -> NoService:
    where = ", ".join(config.connect)
    return NoService(
        f"no service behind {where}; is `neurove serve` running there, and does its access list admit you?"
    )


def silent(transport: Transport, config: ClientConfig, answered: set[str], node: str = "*") -> list[str]:
    """Names of the nodes that are alive by their token and are not among those that answered."""
    alive = {config.keys.node_of(key) for key in transport.tokens(config.keys.alive(node), ANSWER_S)}
    return sorted(alive - answered)


def need_service(transport: Transport, config: ClientConfig, node: str = "*") -> None:
    """Check that one node, or at least any node, is alive.

    Raises:
        NoService: it is not alive.
    """
    if not transport.tokens(config.keys.alive(node), ANSWER_S):
        raise _no_node(config) if node == "*" else _no_answer(config.keys.alive(node))


def listen(
    transport: Transport,
    config: ClientConfig,
    on_estimate: Callable[[TwistEstimate], None],
    on_status: Callable[[StreamStatus], None],
) -> None:
    """Receive every estimate and status; see `readers`.

    Args:
        transport: an open session; the subscriptions last as long as it.
        config: the deployment's prefix.
        on_estimate: called on Zenoh's thread.
        on_status: called on Zenoh's thread.
    """
    read_estimate, read_status = readers(lambda estimate, _: on_estimate(estimate), on_status)
    transport.subscribe(config.keys.velocity(), read_estimate)
    transport.subscribe(config.keys.status(), read_status)


def readers(
    on_estimate: Callable[[TwistEstimate, int], None], on_status: Callable[[StreamStatus], None]
) -> tuple[OnSample, OnSample]:
    """What takes the bytes of an estimate and of a status; a message that cannot be decoded is logged and ignored.

    Where several nodes can answer a stream, each window comes once: see `duty.Newest`.
    An estimate that waited on its way is flagged `late`, and its `host.age_ns` counts until its arrival: see `Transit`.

    Args:
        on_estimate: called with an estimate and its time of reception (monotonic) [ns].
        on_status: called with a status.
    """
    transit, rules = Transit(), defaultdict[str, Newest](Newest)

    def take(estimate: TwistEstimate, at_ns: int) -> None:
        if rules[estimate.stream].takes(estimate.term, estimate.start_us, at_ns):
            on_estimate(transit.arrived(estimate, at_ns), at_ns)

    def decoded(kind: type[ReplyT], use: Callable[[ReplyT, int], None]) -> OnSample:
        def on_sample(key: str, payload: bytes, received_ns: int) -> None:
            try:
                use(kind.decode(payload), received_ns)
            except NeuroVEError as error:
                log.warning("message refused", key=key, why=error.message)

        return on_sample

    return decoded(TwistEstimate, take), decoded(StreamStatus, lambda one, _: on_status(one))
