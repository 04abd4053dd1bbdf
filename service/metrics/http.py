"""A small HTTP server for probes and scrapes: one thread, few connections, slow clients are dropped."""

import contextlib
import os
import selectors
import socket
import threading
import time
from collections.abc import Callable
from http import HTTPStatus
from typing import Final, NamedTuple

from neurove_protocol.errors import NeuroVEError
from neurove_service import logs
from neurove_service.guard import Guard

log = logs.get(__name__)

MAX_CONNECTIONS: Final = 32
"""Open connections; a further one closes the oldest."""

MAX_REQUEST_BYTES: Final = 8192
DEADLINE_S: Final = 5.0
"""A connection that is not answered completely within this time is closed [s]."""

_POLL_S: Final = 1.0
_PAUSE_S: Final = 0.1  # after an error of the listening socket, such as too many open files
_READ_BYTES: Final = 4096


class AddressError(NeuroVEError):
    """The HTTP server cannot listen at its address."""

    code = "address"


class Response(NamedTuple):
    """What a path answers."""

    body: bytes
    status: HTTPStatus = HTTPStatus.OK
    content_type: str = "text/plain; charset=utf-8"


class HttpServer:
    """Answers GET and HEAD on a thread of its own, one request for each connection.

    A request never waits for a slow client: sockets do not block, each connection has a deadline, and the oldest
    connection makes space for a new one.

    Args:
        host: address or name of the interface to listen on.
        port: 0 for a free one.
        respond: the answer to a path; None for an unknown path. Runs on the server's thread.
        guard: counts internal errors of `respond`.
        deadline_s: longest life of a connection [s].

    Raises:
        AddressError: the address is in use or does not exist.
    """

    def __init__(
        self,
        host: str,
        port: int,
        respond: Callable[[str], Response | None],
        guard: Guard,
        deadline_s: float = DEADLINE_S,
    ) -> None:
        self._respond, self._guard, self._deadline_s = respond, guard, deadline_s
        try:
            family = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0][0]
            self._listener = socket.create_server((host, port), family=family, backlog=MAX_CONNECTIONS)
        except socket.gaierror as error:
            raise AddressError(f"cannot listen at {host}:{port}: {error.strerror}") from None
        except OSError as error:
            raise AddressError(f"cannot listen at {host}:{port}: {os.strerror(error.errno or 0)}") from None
        self._listener.setblocking(False)
        self._waker, self._woken = socket.socketpair()
        self._selector = selectors.DefaultSelector()
        self._selector.register(self._listener, selectors.EVENT_READ)
        self._selector.register(self._woken, selectors.EVENT_READ)
        self._open: list[_Connection] = []  # the oldest first
        self._stopping = threading.Event()
        self._thread = threading.Thread(target=self._run, name="http", daemon=True)
        self._thread.start()

    @property
    def url(self) -> str:
        """Where the server listens."""
        host, port = self._listener.getsockname()[:2]
        return f"http://[{host}]:{port}" if ":" in host else f"http://{host}:{port}"

    def close(self) -> None:
        """End the thread and close every connection."""
        self._stopping.set()
        with contextlib.suppress(OSError):
            self._waker.send(b"\0")
        self._thread.join()

    def _run(self) -> None:
        while not self._stopping.is_set():
            with self._guard.at("http"):
                self._turn()
        for connection in list(self._open):
            self._drop(connection)
        self._selector.close()
        for one in (self._listener, self._waker, self._woken):
            one.close()

    def _turn(self) -> None:
        for key, _ in self._selector.select(_POLL_S):
            if key.fileobj is self._listener:
                self._accept()
            elif key.data in self._open:  # `_accept` may have dropped it
                self._serve(key.data)
        now_s = time.monotonic()
        for connection in [one for one in self._open if one.deadline_s <= now_s]:
            self._drop(connection)

    def _accept(self) -> None:
        try:
            sock, _ = self._listener.accept()
        except BlockingIOError:
            return
        except OSError as error:
            log.warning("connection refused", why=error.strerror)
            if self._open:
                self._drop(self._open[0])
            self._stopping.wait(_PAUSE_S)
            return
        sock.setblocking(False)
        if len(self._open) >= MAX_CONNECTIONS:
            self._drop(self._open[0])
        connection = _Connection(sock, time.monotonic() + self._deadline_s)
        self._open.append(connection)
        self._selector.register(sock, selectors.EVENT_READ, connection)

    def _serve(self, connection: "_Connection") -> None:
        try:
            if connection.unsent is None and connection.receive():
                connection.unsent = memoryview(self._answer(bytes(connection.received)))
                self._selector.modify(connection.sock, selectors.EVENT_WRITE, connection)
            if connection.unsent is not None and connection.send():
                self._drop(connection)
        except BlockingIOError:
            return
        except (OSError, _Ended):  # the client has left
            self._drop(connection)

    def _answer(self, request: bytes) -> bytes:
        words = request.split(b"\n", 1)[0].decode("latin-1").split()
        if len(request) >= MAX_REQUEST_BYTES:
            return _encode(Response(b"", HTTPStatus.REQUEST_HEADER_FIELDS_TOO_LARGE))
        if len(words) != 3 or not words[2].startswith("HTTP/1."):
            return _encode(Response(b"", HTTPStatus.BAD_REQUEST))
        method, target = words[:2]
        if method not in ("GET", "HEAD"):
            return _encode(Response(b"", HTTPStatus.METHOD_NOT_ALLOWED))
        response: Response | None = Response(b"internal error\n", HTTPStatus.INTERNAL_SERVER_ERROR)
        with self._guard.at("http answer", path=target[:64]):
            response = self._respond(target.partition("?")[0])
        if response is None:
            response = Response(b"unknown path\n", HTTPStatus.NOT_FOUND)
        return _encode(response, with_body=method == "GET")

    def _drop(self, connection: "_Connection") -> None:
        self._open.remove(connection)
        self._selector.unregister(connection.sock)
        connection.sock.close()


class _Ended(Exception):
    """The client closed the connection."""


class _Connection:
    """One client."""

    def __init__(self, sock: socket.socket, deadline_s: float) -> None:
        self.sock, self.deadline_s = sock, deadline_s
        self.received = bytearray()
        self.unsent: memoryview | None = None

    def receive(self) -> bool:
        """Read what has arrived; whether the request is complete or too large."""
        data = self.sock.recv(_READ_BYTES)
        if not data:
            raise _Ended
        self.received += data
        return b"\r\n\r\n" in self.received or b"\n\n" in self.received or len(self.received) >= MAX_REQUEST_BYTES

    def send(self) -> bool:
        """Send what the client takes; whether that was everything."""
        assert self.unsent is not None
        self.unsent = self.unsent[self.sock.send(self.unsent) :]
        return not self.unsent


def _encode(response: Response, *, with_body: bool = True) -> bytes:
    status = response.status
    body = response.body or f"{status.phrase.lower()}\n".encode()
    head = (
        f"HTTP/1.1 {status.value} {status.phrase}",
        f"Content-Type: {response.content_type}",
        f"Content-Length: {len(body)}",
        "Cache-Control: no-store",
        "X-Content-Type-Options: nosniff",
        *(["Allow: GET, HEAD"] if status is HTTPStatus.METHOD_NOT_ALLOWED else []),
        "Connection: close",
    )
    return "\r\n".join((*head, "", "")).encode() + (body if with_body else b"")
