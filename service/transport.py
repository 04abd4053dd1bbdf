"""Zenoh, and the only file that imports it: no Zenoh type appears in a signature of another module.

Settings and traps are those measured in eclipse-zenoh 1.10: multicast and shared memory off, explicit endpoints,
direct callbacks that only append, every query answered, sessions always closed.
"""

import contextlib
import json
import re
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from types import TracebackType
from typing import Any, NamedTuple, Self

import zenoh

from neurove_protocol.control import CONTROL_SCHEMA, PROGRESS_SCHEMA, ErrorReply, PeerError
from neurove_protocol.errors import Busy, InternalError, NeuroVEError
from neurove_service import logs

log = logs.get(__name__)

_SETTINGS = {
    "scouting/multicast/enabled": False,
    "transport/shared_memory/enabled": False,  # leaks 17 MiB per publisher restart in this version
    "transport/link/rx/max_message_size": 32 << 20,
    "transport/link/tx/queue/size/data": 16,  # batches of 64 KiB: a burst of packets fits
    "transport/link/tx/queue/size/data_high": 16,  # 2 by default, and an estimate, being express, fills one alone
    "transport/link/tx/queue/congestion_control/drop/wait_before_drop": 20_000,  # us: ride out a stall of the receiver
}
_RETRY_S = 0.5
_SYSTEM_ERROR = re.compile(r"([^:\[\]]+) \(os error \d+\)")

OnSample = Callable[[str, bytes, int], None]
"""key, payload, and when it was received (monotonic ns). Runs on Zenoh's thread: it may only append and return."""


class EndpointError(NeuroVEError):
    """A session can not be opened: an endpoint is taken, wrong, or nobody listens there."""

    code = "endpoint"


class Unreachable(EndpointError):
    """No router and no service listens at the endpoints."""


class Reply(NamedTuple):
    """One reply to a query."""

    key: str
    payload: bytes
    schema: str = ""  # Zenoh Encoding


Tell = Callable[[bytes], None]
"""Sends one more reply, ahead of the last one; nothing happens where the caller has left."""


class Publisher:
    """Publishes one key. Events and estimates use DROP: the newest data matters, a slow peer must not hold us up."""

    def __init__(self, publisher: zenoh.Publisher) -> None:
        self._publisher = publisher

    def put(self, payload: bytes) -> None:
        """Hand a message over; it may be dropped on the way, which the receiver sees in the sequence numbers."""
        self._publisher.put(payload)

    @property
    def matching(self) -> bool:
        """Whether some subscriber is connected now."""
        status = self._publisher.matching_status  # an object that is always true, though its type says bool
        return bool(getattr(status, "matching", status))

    def close(self) -> None:
        """Stop publishing."""
        self._publisher.undeclare()  # type: ignore[no-untyped-call]  # gap in Zenoh's stubs


class Transport:
    """One Zenoh session. Use it in a `with` block, or close it: an open session keeps the process alive."""

    def __init__(self, session: zenoh.Session) -> None:
        self._session = session
        self._answering: list[tuple[Any, threading.Thread]] = []
        self._kept: list[Any] = []  # Zenoh takes back what is garbage collected

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """End everything declared on this session, and the session."""
        for queryable, thread in self._answering:
            queryable.undeclare()
            thread.join(timeout=1)
        self._session.close()  # type: ignore[no-untyped-call]  # gap in Zenoh's stubs

    def publisher(self, key: str, schema: str, *, urgent: bool = False) -> Publisher:
        """A publisher of a key whose messages carry the schema as their Encoding.

        Args:
            key: concrete key.
            schema: Zenoh Encoding.
            urgent: sent before ordinary data and never batched: for estimates.
        """
        priority = zenoh.Priority.DATA_HIGH if urgent else zenoh.Priority.DATA
        declared = self._session.declare_publisher(
            key,
            encoding=zenoh.Encoding(schema),
            congestion_control=zenoh.CongestionControl.DROP,
            priority=priority,
            express=urgent,
        )
        return Publisher(declared)

    def put(self, key: str, payload: bytes, schema: str) -> None:
        """Publish one message that must not be dropped on a busy link, such as a CameraInfo."""
        block = zenoh.CongestionControl.BLOCK
        self._session.put(key, payload, encoding=zenoh.Encoding(schema), congestion_control=block)

    def subscribe(self, key: str, on_sample: OnSample) -> None:
        """Receive every message of a key expression, for as long as the session lives."""

        def receive(sample: zenoh.Sample) -> None:
            on_sample(str(sample.key_expr), sample.payload.to_bytes(), time.monotonic_ns())

        self._kept.append(self._session.declare_subscriber(key, zenoh.handlers.Callback(receive, indirect=False)))

    def answer(self, key: str, handle: Callable[[bytes], bytes], schema: str = CONTROL_SCHEMA) -> None:
        """Answer queries of a key on a thread of their own; what `handle` raises is told to the caller.

        Args:
            key: concrete key.
            handle: request payload to reply payload; raises NeuroVEError to refuse.
            schema: Zenoh Encoding of the replies.
        """

        def work(query: zenoh.Query) -> None:
            with query:
                _reply(query, key, handle, schema)

        self._answer(key, work)

    def answer_streaming(
        self,
        key: str,
        handle: Callable[[bytes, Tell], bytes],
        at_once: int = 4,
        after: Callable[[], None] = lambda: None,
    ) -> None:
        """Answer queries whose work takes time: each on its own thread, with replies on the way to the last one.

        A caller that leaves does not stop the work.

        Args:
            key: concrete key.
            handle: request payload and a way to tell progress, to the last reply's payload; raises as in `answer`.
            at_once: with so many under way further queries are refused as busy.
            after: called when the last reply has gone, and nothing refers to what the work has made any more.
        """
        free = threading.BoundedSemaphore(at_once)

        def work(query: zenoh.Query) -> None:
            if free.acquire(blocking=False):
                threading.Thread(target=work_alone, args=(query,), name=f"work {key}", daemon=True).start()
            else:
                with query:
                    _refuse(query, Busy(at_once))

        def work_alone(query: zenoh.Query) -> None:
            def tell(payload: bytes) -> None:
                _send(query, key, payload, PROGRESS_SCHEMA)

            with query:
                try:
                    _reply(query, key, lambda request: handle(request, tell), CONTROL_SCHEMA)
                finally:
                    free.release()
            after()

        self._answer(key, work)

    def _answer(self, key: str, work: Callable[[zenoh.Query], None]) -> None:
        queryable = self._session.declare_queryable(key, zenoh.handlers.FifoChannel(16))

        def serve() -> None:
            for query in queryable:
                work(query)

        thread = threading.Thread(target=serve, name=f"answer {key}", daemon=True)
        thread.start()
        self._answering.append((queryable, thread))

    def ask(self, key: str, request: bytes, timeout_s: float, *, bulk: bool = False) -> list[Reply]:
        """Query a key expression and wait for everybody's reply.

        Args:
            key: key expression.
            request: payload of the query.
            timeout_s: later replies are not waited for.
            bulk: the reply is large and in no hurry: it takes the query's priority, after all other data.

        Returns:
            replies, in the order they came; empty where nobody answers the key or nobody did in time.

        Raises:
            PeerError: a peer refused, with its own code and reason.
        """
        priority = zenoh.Priority.DATA_LOW if bulk else zenoh.Priority.DATA
        return list(self._ask(key, request, timeout_s, priority, zenoh.ConsolidationMode.AUTO))

    def ask_streaming(self, key: str, request: bytes, timeout_s: float) -> Iterator[Reply]:
        """Query one node and hear every reply as it comes; those of PROGRESS_SCHEMA are not the last one.

        Raises:
            PeerError: as ask.
        """
        return self._ask(key, request, timeout_s, zenoh.Priority.DATA, zenoh.ConsolidationMode.NONE)

    def _ask(
        self, key: str, request: bytes, timeout_s: float, priority: zenoh.Priority, mode: zenoh.ConsolidationMode
    ) -> Iterator[Reply]:
        channel: Any = zenoh.handlers.FifoChannel(64)
        replies = self._session.get(
            key,
            channel,
            payload=request,
            timeout=timeout_s,
            priority=priority,
            consolidation=mode,
            congestion_control=zenoh.CongestionControl.BLOCK,
        )
        for reply in replies:
            if reply.ok is not None:
                yield Reply(str(reply.ok.key_expr), reply.ok.payload.to_bytes(), str(reply.ok.encoding))
            elif reply.err is not None and reply.err.payload.to_bytes() != b"Timeout":
                raise PeerError(ErrorReply.decode(reply.err.payload.to_bytes()))

    def token(self, key: str) -> Callable[[], None]:
        """Declare a liveliness token; call the result to take it back."""
        token = self._session.liveliness().declare_token(key)
        self._kept.append(token)

        def take_back() -> None:
            self._kept.remove(token)
            token.undeclare()  # type: ignore[no-untyped-call]  # gap in Zenoh's stubs

        return take_back

    def tokens(self, key: str, timeout_s: float) -> list[str]:
        """The liveliness tokens that exist now under a key expression."""
        replies = self._session.liveliness().get(key, timeout=timeout_s)
        return [str(reply.ok.key_expr) for reply in replies if reply.ok is not None]


def _reply(query: zenoh.Query, key: str, handle: Callable[[bytes], bytes], schema: str) -> None:
    try:
        answer = handle(query.payload.to_bytes() if query.payload else b"")
    except NeuroVEError as error:
        return _refuse(query, error)
    except Exception:  # a bug must not end the loop; the caller still gets an answer
        log.exception("handler failed", key=key)
        return _refuse(query, InternalError())
    return _send(query, key, answer, schema)


def _send(query: zenoh.Query, key: str, payload: bytes, schema: str) -> None:
    with contextlib.suppress(zenoh.ZError):  # the caller has left, or the session was closed
        query.reply(key, payload, encoding=zenoh.Encoding(schema))


def _refuse(query: zenoh.Query, error: NeuroVEError) -> None:
    with contextlib.suppress(zenoh.ZError):
        query.reply_err(ErrorReply.of(error).encode(), encoding=zenoh.Encoding(CONTROL_SCHEMA))


def open_transport(
    mode: str,
    *,
    listen: tuple[str, ...] = (),
    connect: tuple[str, ...] = (),
    config_file: Path | None = None,
    patience_s: float = 0.0,
    stop: threading.Event | None = None,
) -> Transport:
    """Open a session.

    Args:
        mode: `peer`, `client` or `router`.
        listen: endpoints to listen on.
        connect: endpoints to connect to; in client mode one of them must answer.
        config_file: Zenoh configuration (JSON5) to start from.
        patience_s: how long a client keeps trying where nobody listens yet.
        stop: ends the trying early.

    Raises:
        EndpointError: after that time, or at once where waiting can not help.
    """
    config = _session_config(mode, listen, connect, config_file)
    stop = stop or threading.Event()
    deadline = time.monotonic() + patience_s
    waiting = False
    while True:
        try:
            return Transport(zenoh.open(config))
        except zenoh.ZError as error:
            if not str(error).startswith("Unable to connect"):
                raise EndpointError(
                    f"can not open a Zenoh session: {_where(listen, connect)}: {_reason(error)}"
                ) from None
        if time.monotonic() >= deadline or stop.is_set():
            raise Unreachable(_unreached(connect))
        if not waiting:
            log.info("waiting for a router", connect=", ".join(connect), why=_unreached(connect))
            waiting = True
        stop.wait(_RETRY_S)


def _session_config(
    mode: str, listen: tuple[str, ...], connect: tuple[str, ...], config_file: Path | None
) -> zenoh.Config:
    try:
        config = zenoh.Config.from_file(str(config_file)) if config_file else zenoh.Config()
        config.insert_json5("mode", json.dumps(mode))
        if listen or not config_file:
            config.insert_json5("listen/endpoints", json.dumps(listen))
        if connect or not config_file:
            config.insert_json5("connect/endpoints", json.dumps(connect))
        for key, value in _SETTINGS.items():
            config.insert_json5(key, json.dumps(value))
    except zenoh.ZError as error:
        where = f"zenoh_config={config_file}" if config_file else _where(listen, connect)
        raise EndpointError(f"can not configure Zenoh: {where}: {_reason(error)}") from None
    return config


def _where(listen: tuple[str, ...], connect: tuple[str, ...]) -> str:
    parts = [f"listen={', '.join(listen)}"] * bool(listen) + [f"connect={', '.join(connect)}"] * bool(connect)
    return " ".join(parts) or "no endpoints"


def _unreached(connect: tuple[str, ...]) -> str:
    """Why no connection came about, as far as Zenoh tells: a closed port and a refused certificate look the same."""
    secured = any(endpoint.startswith(("tls/", "quic/")) for endpoint in connect)
    refused = ", or one side refuses the other's certificate (zenoh_config)" if secured else ""
    return f"nobody listens at {', '.join(connect)}{refused}"


def _reason(error: zenoh.ZError) -> str:
    """What Zenoh says, without the places in its own source, or the system's own word where that is the reason."""
    system = _SYSTEM_ERROR.search(str(error))
    return system[1].strip() if system else str(error).split(" at /", maxsplit=1)[0].removesuffix(".")
