"""Viewers: the browsers that follow the page, each with a bounded queue; one that does not read is dropped."""

import asyncio
import contextlib
import json
import threading
from collections.abc import AsyncIterator, Callable
from typing import Any, Final

from starlette.types import Receive, Scope, Send

from neurove_service import logs
from neurove_service.guard import Guard
from neurove_service.page.deployment import Deployment

log = logs.get(__name__)

MAX_VIEWERS: Final = 16
QUEUE_TICKS: Final = 40
"""Messages that wait for a viewer; with more it is dropped, and its browser connects again if it still runs."""

TICK_S: Final = 0.1

READ_S: Final = 10.0
"""A browser that reads no image for this time is disconnected [s]."""

_IMAGES: Final = [(b"content-type", b"application/octet-stream"), (b"cache-control", b"no-store")]

Abort = Callable[[Any], None]
"""Closes the connection of a client address at once."""


class _Viewer:
    def __init__(self, client: Any) -> None:
        self.client = client
        self.queue: asyncio.Queue[bytes | None] = asyncio.Queue(QUEUE_TICKS)


class Viewers:
    """Sends the state of a deployment to every viewer, as server-sent events; each message is encoded once.

    Args:
        deployment: what is shown.
        take: puts what has arrived into the deployment.
        stop: ends the loop and the answers.
        abort: closes a connection.
        guard: counts internal errors.
    """

    def __init__(
        self, deployment: Deployment, take: Callable[[], None], stop: threading.Event, abort: Abort, guard: Guard
    ) -> None:
        self._deployment, self._take = deployment, take
        self._stop, self._abort, self._guard = stop, abort, guard
        self._viewers: set[_Viewer] = set()
        self._watching = 0

    @property
    def count(self) -> int:
        """Viewers that are connected."""
        return len(self._viewers)

    async def run(self) -> None:
        """Send the news ten times per second until the stop event; without a viewer nothing is encoded."""
        while not self._stop.is_set():
            await asyncio.sleep(TICK_S)
            self._take()
            if self._viewers:
                with self._guard.at("page news"):
                    self._send(message("news", self._deployment.news()))
        for viewer in list(self._viewers):
            self._drop(viewer)

    async def watch(self, scope: Scope, receive: Receive, send: Send, images: AsyncIterator[bytes]) -> None:
        """Answer a request with images until the browser leaves; one that takes none for a while is disconnected."""
        if self._watching >= MAX_VIEWERS:
            await _refuse(send)
            return
        self._watching += 1
        sending = asyncio.create_task(self._send_images(scope, send, images))
        leaving = asyncio.create_task(_left(receive))
        try:
            await asyncio.wait((sending, leaving), return_when=asyncio.FIRST_COMPLETED)
        finally:
            self._watching -= 1
            leaving.cancel()
            sending.cancel()
            with contextlib.suppress(asyncio.CancelledError):
                await sending

    async def _send_images(self, scope: Scope, send: Send, images: AsyncIterator[bytes]) -> None:
        with self._guard.at("page images"):
            await send({"type": "http.response.start", "status": 200, "headers": _IMAGES})
            try:
                async for data in images:
                    if self._stop.is_set():
                        break
                    async with asyncio.timeout(READ_S):
                        await send({"type": "http.response.body", "body": data, "more_body": True})
                await send({"type": "http.response.body", "body": b""})
            except TimeoutError:
                log.warning("viewer dropped: it does not read", client=str(scope.get("client")))
                self._abort(scope.get("client"))

    def _send(self, data: bytes) -> None:
        for viewer in list(self._viewers):
            try:
                viewer.queue.put_nowait(data)
            except asyncio.QueueFull:
                log.warning("viewer dropped: it does not read", client=str(viewer.client))
                self._drop(viewer)
                self._abort(viewer.client)

    def _drop(self, viewer: _Viewer) -> None:
        self._viewers.discard(viewer)
        while not viewer.queue.empty():
            viewer.queue.get_nowait()
        viewer.queue.put_nowait(None)

    async def follow(self, scope: Scope, receive: Receive, send: Send, about: dict[str, Any]) -> None:
        """Answer a request with events until the browser leaves; `about` goes into the first one."""
        if self.count >= MAX_VIEWERS:
            await _refuse(send)
            return
        viewer = _Viewer(scope.get("client"))
        self._viewers.add(viewer)
        gone = asyncio.create_task(_gone(receive, viewer))
        try:
            headers = [(b"content-type", b"text/event-stream"), (b"cache-control", b"no-store")]
            await send({"type": "http.response.start", "status": 200, "headers": headers})
            first = b"retry: 1000\n" + message("hello", self._deployment.everything() | about)
            await send({"type": "http.response.body", "body": first, "more_body": True})
            while (data := await viewer.queue.get()) is not None:
                await send({"type": "http.response.body", "body": data, "more_body": True})
            await send({"type": "http.response.body", "body": b""})
        finally:
            self._viewers.discard(viewer)
            gone.cancel()


async def _left(receive: Receive) -> None:
    """Wait until the browser has left."""
    while (await receive())["type"] != "http.disconnect":
        pass


async def _gone(receive: Receive, viewer: _Viewer) -> None:
    """Wait until the browser has left, then end its answer."""
    await _left(receive)
    while not viewer.queue.empty():
        viewer.queue.get_nowait()
    viewer.queue.put_nowait(None)


async def _refuse(send: Send) -> None:
    body = f"at most {MAX_VIEWERS} viewers at once".encode()
    headers = [(b"content-type", b"text/plain; charset=utf-8")]
    await send({"type": "http.response.start", "status": 503, "headers": headers})
    await send({"type": "http.response.body", "body": body})


def message(event: str, data: dict[str, Any]) -> bytes:
    """One server-sent event; JSON has no line breaks, so no text from the network can begin a new field."""
    return f"event: {event}\ndata: {json.dumps(data, separators=(',', ':'), allow_nan=False)}\n\n".encode()
