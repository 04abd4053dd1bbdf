"""Transport over Zenoh. Only this module imports zenoh, and no other module has a Zenoh type in a signature.

The settings follow measurements with eclipse-zenoh 1.10: multicast and shared memory off, explicit endpoints, direct
callbacks that only append, every query answered, every session closed.
"""

import atexit
import contextlib
import json
import os
import struct
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from types import MappingProxyType, TracebackType
from typing import Any, Final, Literal, NamedTuple, Self

import zenoh

from neurove_protocol.control import CONTROL_SCHEMA, PROGRESS_SCHEMA, ErrorReply, PeerError
from neurove_protocol.errors import Busy, InternalError, NeuroVEError
from neurove_protocol.events import MAX_PACKET_BYTES
from neurove_service import logs
from neurove_service.desk import Desk
from neurove_service.endpoints import reason, unreached, where
from neurove_service.guard import Guard

log = logs.get(__name__)

_SETTINGS: Mapping[str, object] = {
    "scouting/multicast/enabled": False,
    "transport/shared_memory/enabled": False,  # leaks 17 MiB per publisher restart in this version
    "transport/link/rx/max_message_size": MAX_PACKET_BYTES,
    # What waits on the sender's side of a slow link is old when it arrives: 5 Mbit/s take 0.6 s for these two.
    "transport/link/tx/queue/size/data": 4,  # batches of 64 KiB
    "transport/link/tcp/so_sndbuf": 1 << 16,  # bytes; Linux takes twice as many
    "transport/link/tx/queue/size/data_high": 16,  # 2 by default, and an estimate, being express, fills one alone
    "transport/link/tx/queue/congestion_control/drop/wait_before_drop": 20_000,  # us: ride out a stall of the receiver
}
TIMESTAMPS: Final = {"timestamping/enabled": True}  # messages carry the time of publishing, as ROS 2 expects
SMALL_BATCHES: Final = {"transport/link/tx/batch_size": 1 << 14}  # a packet that waits holds the buffer of its batch
_RETRY_S = 0.5
_SENT = struct.Struct("<q")  # the attachment of a packet: time of sending [us]
Haste = Literal["bulk", "usual", "urgent"]
_P = zenoh.Priority
_PRIORITIES: dict[Haste, zenoh.Priority] = {"bulk": _P.DATA_LOW, "usual": _P.DATA, "urgent": _P.INTERACTIVE_HIGH}

OnSample = Callable[[str, bytes, int], None]
"""Key, payload, and time of reception (monotonic) [ns]. Runs on Zenoh's thread: it must only append and return."""

OnTimedSample = Callable[[str, bytes, int, int | None], None]
"""As OnSample, with the time of sending on a clock of the sender's host [us], or None."""


class EndpointError(NeuroVEError):
    """Cannot open a session: an endpoint is in use or wrong, or no process listens there."""

    code = "endpoint"


class Unreachable(EndpointError):
    """No process listens at the endpoints to connect to, or one side refuses the certificate of the other."""


class Reply(NamedTuple):
    """One reply to a query."""

    key: str
    payload: bytes
    schema: str = ""  # Zenoh Encoding


Report = Callable[[bytes], None]
"""Sends a reply before the last one; does nothing if the caller has left."""


class Publisher:
    """Publishes one key. Messages are dropped on a congested link, so that a slow peer does not delay newer data."""

    def __init__(self, publisher: zenoh.Publisher) -> None:
        self._publisher = publisher

    def put(self, payload: bytes, sent_us: int | None = None) -> None:
        """Publish a message; if it is dropped, the receiver sees a gap in the sequence numbers.

        Args:
            payload: the message.
            sent_us: the time of sending, for a packet whose sensor clock may not run in real time [us].
        """
        self._publisher.put(payload, attachment=None if sent_us is None else _SENT.pack(sent_us))

    @property
    def matching(self) -> bool:
        """Whether a subscriber is connected now."""
        status = self._publisher.matching_status  # an object that is always true, though its type says bool
        return bool(getattr(status, "matching", status))

    def close(self) -> None:
        """Stop publishing."""
        self._publisher.undeclare()  # type: ignore[no-untyped-call]  # gap in Zenoh's stubs


_OPEN: dict[int, "Transport"] = {}  # by identity, until closed: Zenoh's threads hold a session anyway


@atexit.register
def _close_all() -> None:
    """Close what a program leaves open: at the end of the interpreter an open session hangs or aborts the process."""
    for transport in list(_OPEN.values()):
        transport.close()


class Transport:
    """One Zenoh session. Use it in a `with` block or close it; one that is left open is closed when the process ends.

    Args:
        session: opened; the module that speaks to ROS 2 uses it too.
        guard: counts internal errors of what is called for a message or a query.
    """

    def __init__(self, session: zenoh.Session, guard: Guard | None = None) -> None:
        self.session, self._guard = session, guard or Guard()
        self._answering: list[tuple[Any, Desk[zenoh.Query], threading.Thread]] = []
        self._kept: list[Any] = []  # Zenoh undeclares what is garbage collected
        _OPEN[id(self)] = self

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """Undeclare everything and close the session; a second call does nothing."""
        if _OPEN.pop(id(self), None) is None:
            return
        for queryable, desk, thread in self._answering:
            queryable.undeclare()
            desk.close()
            thread.join(timeout=1)
        try:
            self.session.close()  # type: ignore[no-untyped-call]  # gap in Zenoh's stubs
        except zenoh.ZError as error:  # a link that cannot deliver what waits
            log.warning("the session did not close in order", why=reason(error))

    def publisher(self, key: str, schema: str, *, urgent: bool = False) -> Publisher:
        """Declare a publisher.

        Args:
            key: concrete key.
            schema: Zenoh Encoding of its messages.
            urgent: for estimates: sent before ordinary data and never batched.
        """
        declared = self.session.declare_publisher(
            key,
            encoding=zenoh.Encoding(schema),
            congestion_control=zenoh.CongestionControl.DROP,
            priority=zenoh.Priority.DATA_HIGH if urgent else zenoh.Priority.DATA,
            express=urgent,
        )
        return Publisher(declared)

    def put(self, key: str, payload: bytes, schema: str) -> None:
        """Publish one message that must not be dropped on a congested link, such as a CameraInfo."""
        block = zenoh.CongestionControl.BLOCK
        self.session.put(key, payload, encoding=zenoh.Encoding(schema), congestion_control=block)

    def subscribe(self, key: str, on_sample: OnSample) -> Callable[[], None]:
        """Receive every message of a key expression until the result is called or the session is closed."""
        return self.subscribe_timed(key, lambda name, payload, received_ns, _: on_sample(name, payload, received_ns))

    def subscribe_timed(self, key: str, on_sample: OnTimedSample, *, remote: bool = False) -> Callable[[], None]:
        """As subscribe, with the time of sending, if the driver attaches it [us]; `remote`: not of this session."""
        origin = zenoh.Locality.REMOTE if remote else zenoh.Locality.ANY

        def receive(sample: zenoh.Sample) -> None:
            received_ns = time.monotonic_ns()
            try:  # not `guard.at`: this runs for every packet
                on_sample(str(sample.key_expr), sample.payload.to_bytes(), received_ns, _sent_us(sample.attachment))
            except Exception as error:  # noqa: BLE001  # one message must not end the subscription
                self._guard.caught("message", error)

        handler = zenoh.handlers.Callback(receive, indirect=False)
        return _keep(self._kept, self.session.declare_subscriber(key, handler, allowed_origin=origin))

    def subscribe_newest(self, key: str, most: int) -> tuple[Callable[[], list[bytes]], Callable[[], None]]:
        """Keep the newest messages of a key, without Python for each; returns what takes them and what ends it."""
        declared = self.session.declare_subscriber(key, zenoh.handlers.RingChannel(most))
        return lambda: _taken(declared), _keep(self._kept, declared)

    def answer(self, key: str, handle: Callable[[bytes], bytes], schema: str = CONTROL_SCHEMA) -> None:
        """Answer the queries of a key on a separate thread; an error of `handle` goes to the caller.

        Args:
            key: concrete key.
            handle: turns the request payload into the reply payload; raises NeuroVEError to refuse.
            schema: Zenoh Encoding of the replies.
        """

        def work(query: zenoh.Query) -> None:
            with query:
                _reply(query, key, handle, schema, self._guard)

        self._answer(key, work)

    def answer_streaming(
        self,
        key: str,
        handle: Callable[[bytes, Report], bytes],
        at_once: int = 4,
        after: Callable[[], None] = lambda: None,
    ) -> None:
        """Answer queries that take time: each on its own thread, with progress replies before the last reply.

        The work continues if the caller leaves.

        Args:
            key: concrete key.
            handle: turns the request payload into the payload of the last reply, and reports progress; raises as in
                `answer`.
            at_once: maximum number of queries at once; further ones are refused as busy.
            after: called after the last reply, when nothing refers to the objects of the work any more.
        """
        free = threading.BoundedSemaphore(at_once)

        def work(query: zenoh.Query) -> None:
            if free.acquire(blocking=False):
                threading.Thread(target=work_alone, args=(query,), name=f"work {key}", daemon=True).start()
            else:
                with query:
                    _refuse(query, Busy(at_once))

        def work_alone(query: zenoh.Query) -> None:
            def report(payload: bytes) -> None:
                _send(query, key, payload, PROGRESS_SCHEMA)

            with query:
                try:
                    _reply(query, key, lambda request: handle(request, report), CONTROL_SCHEMA, self._guard)
                finally:
                    free.release()
            with self._guard.at("after a query", key=key):
                after()

        self._answer(key, work)

    def _answer(self, key: str, work: Callable[[zenoh.Query], None]) -> None:
        desk: Desk[zenoh.Query] = Desk()

        def receive(query: zenoh.Query) -> None:  # on Zenoh's thread: it must not wait
            if not desk.offer(query):
                with query:
                    _refuse(query, Busy(desk.most))

        def serve() -> None:
            for query in desk:
                with self._guard.at("query", key=key):
                    work(query)

        queryable = self.session.declare_queryable(key, zenoh.handlers.Callback(receive, indirect=False))
        thread = threading.Thread(target=serve, name=f"answer {key}", daemon=True)
        thread.start()
        self._answering.append((queryable, desk, thread))

    def ask(self, key: str, request: bytes, timeout_s: float, haste: Haste = "usual") -> list[Reply]:
        """Query a key expression and wait for all replies.

        Args:
            key: key expression.
            request: payload of the query.
            timeout_s: replies after this time are ignored [s].
            haste: `bulk`: query and reply have a lower priority than all other data. `urgent`: they overtake all data,
                and are dropped where a peer that hangs has filled its link.

        Returns:
            replies in order of arrival; empty if no peer answered in time.

        Raises:
            PeerError: a peer refused; it has the code and the reason of the peer.
        """
        return list(_query(self.session, key, request, timeout_s, haste, zenoh.ConsolidationMode.AUTO))

    def ask_streaming(self, key: str, request: bytes, timeout_s: float) -> Iterator[Reply]:
        """Query one node and yield every reply as it arrives; replies with PROGRESS_SCHEMA precede the last one.

        Raises:
            PeerError: as ask.
        """
        return _query(self.session, key, request, timeout_s, "usual", zenoh.ConsolidationMode.NONE)

    def token(self, key: str) -> Callable[[], None]:
        """Declare a liveliness token; call the result to undeclare it."""
        return _keep(self._kept, self.session.liveliness().declare_token(key))

    def watch_tokens(self, key: str, on_token: Callable[[str, bool], None]) -> None:
        """Call `on_token` with a token's key and whether it is present, for present tokens and at each change."""

        def receive(sample: zenoh.Sample) -> None:
            with self._guard.at("token"):
                on_token(str(sample.key_expr), sample.kind == zenoh.SampleKind.PUT)

        handler = zenoh.handlers.Callback(receive, indirect=False)
        self._kept.append(self.session.liveliness().declare_subscriber(key, handler, history=True))

    def tokens(self, key: str, timeout_s: float) -> list[str]:
        """The present liveliness tokens of a key expression."""
        replies = self.session.liveliness().get(key, timeout=timeout_s)
        return [str(reply.ok.key_expr) for reply in replies if reply.ok is not None]


def _keep(kept: list[Any], declared: Any) -> Callable[[], None]:
    """Keep what was declared until the result undeclares it."""
    kept.append(declared)

    def undeclare() -> None:
        kept.remove(declared)
        declared.undeclare()

    return undeclare


def _taken(declared: Any) -> list[bytes]:
    return [sample.payload.to_bytes() for sample in iter(declared.try_recv, None)]


def _sent_us(attachment: zenoh.ZBytes | None) -> int | None:
    """The time of sending in an attachment [us]; None if there is none or it is another attachment."""
    if attachment is None:
        return None
    attached = attachment.to_bytes()
    return int(_SENT.unpack(attached)[0]) if len(attached) == _SENT.size else None


def _query(
    session: zenoh.Session,
    key: str,
    request: bytes,
    timeout_s: float,
    haste: Haste,
    mode: zenoh.ConsolidationMode,
) -> Iterator[Reply]:
    channel: Any = zenoh.handlers.FifoChannel(64)
    replies = session.get(
        key,
        channel,
        payload=request,
        timeout=timeout_s,
        priority=_PRIORITIES[haste],
        consolidation=mode,
        congestion_control=zenoh.CongestionControl.DROP if haste == "urgent" else zenoh.CongestionControl.BLOCK,
    )
    for reply in replies:
        if reply.ok is not None:
            yield Reply(str(reply.ok.key_expr), reply.ok.payload.to_bytes(), str(reply.ok.encoding))
        elif reply.err is not None and reply.err.payload.to_bytes() != b"Timeout":  # Zenoh has no code for it
            raise PeerError(ErrorReply.decode(reply.err.payload.to_bytes()))


def _reply(query: zenoh.Query, key: str, handle: Callable[[bytes], bytes], schema: str, guard: Guard) -> None:
    try:
        answer = handle(query.payload.to_bytes() if query.payload else b"")
    except NeuroVEError as error:
        return _refuse(query, error)
    except Exception as error:  # noqa: BLE001  # a bug must not end the loop; the caller still gets a reply
        guard.caught("query", error, key=key)
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
    guard: Guard | None = None,
    more: Mapping[str, object] = MappingProxyType({}),
) -> Transport:
    """Open a session.

    Args:
        mode: `peer`, `client` or `router`.
        listen: endpoints to listen on.
        connect: endpoints to connect to; in client mode one of them must answer.
        config_file: Zenoh configuration (JSON5) that these settings are added to.
        patience_s: how long a client retries while no process listens [s].
        stop: ends the retries early.
        guard: counts internal errors of what is called for a message or a query.
        more: TIMESTAMPS, SMALL_BATCHES, or other settings of Zenoh.

    Raises:
        Unreachable: no process listened for that time.
        EndpointError: the session cannot be opened, and a retry cannot help.
    """
    config = _session_config(mode, listen, connect, config_file, more)
    stop = stop or threading.Event()
    deadline = time.monotonic() + patience_s
    waiting = False
    while True:
        try:
            return Transport(zenoh.open(config), guard)
        except zenoh.ZError as error:
            if not str(error).startswith("Unable to connect"):  # Zenoh has one error class and no codes
                raise EndpointError(f"cannot open a Zenoh session: {where(listen, connect)}: {reason(error)}") from None
        if time.monotonic() >= deadline or stop.is_set():
            raise Unreachable(unreached(connect))
        if not waiting:
            log.info("waiting for a router", connect=", ".join(connect), why=unreached(connect))
            waiting = True
        stop.wait(_RETRY_S)


def _session_config(
    mode: str, listen: tuple[str, ...], connect: tuple[str, ...], config_file: Path | None, more: Mapping[str, object]
) -> zenoh.Config:
    try:
        config = zenoh.Config.from_file(str(config_file)) if config_file else zenoh.Config()
        config.insert_json5("mode", json.dumps(mode))
        if listen or not config_file:
            config.insert_json5("listen/endpoints", json.dumps(listen))
        if connect or not config_file:
            config.insert_json5("connect/endpoints", json.dumps(connect))
        for key, value in {**_SETTINGS, **more}.items():
            config.insert_json5(key, json.dumps(value))
    except zenoh.ZError as error:
        place = f"zenoh_config={config_file}" if config_file else where(listen, connect)
        raise EndpointError(f"cannot configure Zenoh: {place}: {reason(error)}") from None
    return config


def receive_on_one_thread() -> None:
    """Let Zenoh receive on one thread instead of two, in a process with one session; call it before the first one."""
    os.environ.setdefault("ZENOH_RUNTIME", "(rx: (worker_threads: 1))")
