"""The process of the page: a web server on one thread, and the feed from Zenoh on others."""

import asyncio
import contextlib
import socket
import threading
from collections.abc import Callable, Iterator
from typing import Any, Final

import uvicorn
from uvicorn.protocols.http.h11_impl import H11Protocol

from neurove_service.config import ClientConfig
from neurove_service.guard import Guard
from neurove_service.page.access import Access
from neurove_service.page.deployment import Deployment
from neurove_service.page.feed import Feed
from neurove_service.page.images import Images
from neurove_service.page.viewers import MAX_VIEWERS, Viewers
from neurove_service.page.web import Site
from neurove_service.transport import receive_on_one_thread

MAX_CONNECTIONS: Final = 8 * MAX_VIEWERS
"""Connections at once; a browser opens up to six."""

_FORGET_S: Final = 0.5
_SEND_BYTES: Final = 32 << 10  # that the kernel keeps for a connection: a viewer that does not read is found in seconds


class _Server(uvicorn.Server):
    @contextlib.contextmanager
    def capture_signals(self) -> Iterator[None]:
        """Leave the signals to the command, which sets the stop event."""
        yield


def bound(host: str, port: int) -> socket.socket:
    """A listening socket; port 0 takes a free one.

    Raises:
        OSError: the address is in use or not of this machine.
    """
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    listening = socket.socket(family, socket.SOCK_STREAM)
    try:
        listening.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        listening.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _SEND_BYTES)  # connections inherit it
        listening.bind((host, port))
        listening.listen(64)
    except OSError:
        listening.close()
        raise
    return listening


def serve(config: ClientConfig, listening: socket.socket, access: Access, stop: threading.Event) -> None:
    """Serve the page until the stop event.

    Args:
        config: endpoints and prefix of the deployment.
        listening: socket of the web server.
        access: who may do what.
        stop: ends the server.

    Raises:
        EndpointError: an endpoint or the configuration is wrong.
    """
    receive_on_one_thread()
    deployment, guard = Deployment(), Guard()
    feed = Feed(config, deployment, stop, guard)
    try:
        asyncio.run(_serve(deployment, feed, Images(config.keys.events, guard), listening, access, stop, guard))
    finally:
        stop.set()
        feed.close()


async def _serve(
    deployment: Deployment,
    feed: Feed,
    images: Images,
    listening: socket.socket,
    access: Access,
    stop: threading.Event,
    guard: Guard,
) -> None:
    connections: dict[Any, asyncio.Transport] = {}
    viewers = Viewers(deployment, feed.take, stop, _aborting(connections), guard)
    settings = uvicorn.Config(
        Site(deployment, feed, images, viewers, access).app(),
        http=_protocol(connections),
        ws="none",
        lifespan="off",
        log_config=None,
        log_level="critical",
        access_log=False,
        server_header=False,
        limit_concurrency=MAX_CONNECTIONS,
        timeout_graceful_shutdown=1,
    )
    server = _Server(settings)
    answering = asyncio.create_task(server.serve(sockets=[listening]))
    forgetting = asyncio.create_task(_forget(images, guard))
    await viewers.run()
    server.should_exit = True
    forgetting.cancel()
    await answering


async def _forget(images: Images, guard: Guard) -> None:
    while True:
        await asyncio.sleep(_FORGET_S)
        with guard.at("page images"):
            images.forget()


def _aborting(connections: dict[Any, asyncio.Transport]) -> Callable[[Any], None]:
    def abort(client: Any) -> None:
        if client is not None and (transport := connections.get(tuple(client)[:2])):
            transport.abort()

    return abort


def _protocol(connections: dict[Any, asyncio.Transport]) -> type[H11Protocol]:
    """The HTTP protocol of uvicorn, which also keeps the connection of each client, so that one can be closed."""

    class Protocol(H11Protocol):
        def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
            super().connection_made(transport)
            if self.client is not None:
                connections[tuple(self.client)[:2]] = transport

        def connection_lost(self, exc: Exception | None) -> None:
            super().connection_lost(exc)
            if self.client is not None:
                connections.pop(tuple(self.client)[:2], None)

    return Protocol
