"""The web application of the page: static files, events, images, and the few requests that change something."""

import asyncio
import importlib.metadata
import importlib.resources
import json
from collections.abc import Callable, Mapping
from pathlib import PurePosixPath
from typing import Any, Final

from starlette.applications import Starlette
from starlette.concurrency import run_in_threadpool
from starlette.datastructures import Headers, MutableHeaders, QueryParams
from starlette.requests import ClientDisconnect, Request, cookie_parser
from starlette.responses import JSONResponse, PlainTextResponse, Response
from starlette.routing import Route
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from neurove_protocol.errors import EXIT_CONFLICT, NeuroVEError
from neurove_protocol.keys import is_name
from neurove_service import logs
from neurove_service.page.access import COOKIE, Access, Role, same_origin
from neurove_service.page.deployment import Deployment
from neurove_service.page.feed import Feed
from neurove_service.page.images import MAX_WATCHED, Images
from neurove_service.page.viewers import Viewers

log = logs.get(__name__)

MAX_BODY_BYTES: Final = 4096

_POLICY: Final = (
    "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self'; connect-src 'self'; "
    "base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
)
_HEADERS: Final = {
    "content-security-policy": _POLICY,
    "x-content-type-options": "nosniff",
    "referrer-policy": "no-referrer",
    "cross-origin-resource-policy": "same-origin",
    "cross-origin-opener-policy": "same-origin",
    "cache-control": "no-store",
}
_TYPES: Final = {
    ".html": "text/html; charset=utf-8",
    ".css": "text/css; charset=utf-8",
    ".js": "text/javascript; charset=utf-8",
    ".svg": "image/svg+xml",
    ".txt": "text/plain; charset=utf-8",
}


def static_files() -> dict[str, tuple[bytes, str]]:
    """The files of the page by their path: content and type."""
    found = {}
    for folder in ("", "vendor"):
        for entry in importlib.resources.files("neurove_service.page").joinpath("static", folder).iterdir():
            kind = _TYPES.get(PurePosixPath(entry.name).suffix)
            if kind is not None and entry.is_file():
                found["/".join(("", *([folder] if folder else []), entry.name))] = (entry.read_bytes(), kind)
    found["/"] = found["/index.html"]
    return found


class Guarded:
    """Checks Host and role before every request, and adds the security headers to every response.

    Args:
        app: what answers.
        access: who may do what.
    """

    def __init__(self, app: ASGIApp, access: Access) -> None:
        self._app, self._access = app, access

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer one request."""
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return

        async def with_headers(message: Message) -> None:
            if message["type"] == "http.response.start":
                MutableHeaders(scope=message).update(_HEADERS)
            await send(message)

        headers = Headers(scope=scope)
        scope["role"] = self._access.role(cookie_parser(headers.get("cookie", "")).get(COOKIE))
        refused = self._refused(scope, headers)
        await (refused or self._app)(scope, receive, with_headers)

    def _refused(self, scope: Scope, headers: Headers) -> Response | None:
        host = headers.get("host", "")
        if not self._access.host_allowed(host):
            return PlainTextResponse("this host name does not name the page", 403)
        if scope["method"] == "POST" and not same_origin(headers.get("origin"), host):
            return PlainTextResponse("refused: another origin", 403)
        if scope["role"] == "none" and (scope["path"] in ("/feed", "/images") or scope["path"].startswith("/operate/")):
            return PlainTextResponse("refused: open the page with its token", 401)
        return None


class Site:
    """The answers of the page.

    Args:
        deployment: what is shown.
        feed: the session with it.
        images: event images.
        viewers: the browsers.
        access: who may do what.
    """

    def __init__(self, deployment: Deployment, feed: Feed, images: Images, viewers: Viewers, access: Access) -> None:
        self._deployment, self._feed, self._images = deployment, feed, images
        self._viewers, self._access = viewers, access
        self._files = static_files()
        self._changing = asyncio.Lock()
        self._version = importlib.metadata.version("neurove")

    def app(self) -> ASGIApp:
        """The application."""
        routes = [
            Route("/session", self._session, methods=["POST"]),
            Route("/operate/activate", self._activate, methods=["POST"]),
            Route("/operate/rollback", self._rollback, methods=["POST"]),
            Route("/{path:path}", self._file),
        ]
        lasting = {"/feed": self._follow, "/images": self._watch}
        return Guarded(_Lasting(lasting, Starlette(routes=routes)), self._access)

    async def _file(self, request: Request) -> Response:
        found = self._files.get(request.url.path)
        return PlainTextResponse("not found", 404) if found is None else Response(found[0], media_type=found[1])

    async def _follow(self, scope: Scope, receive: Receive, send: Send) -> None:
        about = {"version": self._version, "role": scope["role"], "operator": self._access.operator}
        await self._viewers.follow(scope, receive, send, about)

    async def _watch(self, scope: Scope, receive: Receive, send: Send) -> None:
        """New images of the streams `s`, until the browser leaves; see `Images.follow`."""
        names = QueryParams(scope["query_string"]).getlist("s")[:MAX_WATCHED]
        transport = self._feed.transport
        if transport is None or not names or not all(map(self._shown, names)):
            await PlainTextResponse("no such stream", 404)(scope, receive, send)
            return
        await self._viewers.watch(scope, receive, send, self._images.follow(list(dict.fromkeys(names)), transport))

    def _shown(self, stream: str) -> bool:
        return is_name(stream) and self._deployment.has_stream(stream)

    async def _session(self, request: Request) -> Response:
        given = await _body(request)
        token = None if given is None else given.get("token")
        redeemed = self._access.redeem(token) if isinstance(token, str) else None
        if redeemed is None:
            return JSONResponse({"error": "this token is wrong, or it was used before"}, 403)
        key, role = redeemed
        answer = JSONResponse({"role": role})
        answer.set_cookie(COOKIE, key, httponly=True, samesite="strict", path="/")
        return answer

    async def _activate(self, request: Request) -> Response:
        def change(given: dict[str, Any]) -> str:
            return self._feed.activate(_text(given, "node"), _text(given, "model"), given.get("expect"))

        return await self._change(request, change)

    async def _rollback(self, request: Request) -> Response:
        def change(given: dict[str, Any]) -> str:
            return self._feed.rollback(_text(given, "node"), given.get("expect"))

        return await self._change(request, change)

    async def _change(self, request: Request, change: Callable[[dict[str, Any]], str]) -> Response:
        role: Role = request.scope["role"]
        if not self._access.operator:
            return JSONResponse({"error": "this page only shows; start it with --operator to change models"}, 403)
        if role != "operator":
            return JSONResponse({"error": "give the operator token first"}, 403)
        given = await _body(request)
        if given is None or not is_name(str(given.get("node"))):
            return JSONResponse({"error": "the request names no node"}, 400)
        if self._changing.locked():
            return JSONResponse({"error": "another change of this page is running"}, 409)
        async with self._changing:
            try:
                done = await run_in_threadpool(change, given)
            except NeuroVEError as error:
                return JSONResponse({"error": error.message}, 409 if error.exit_code == EXIT_CONFLICT else 502)
            except ValueError as error:  # a field out of its bound
                return JSONResponse({"error": str(error)[:200]}, 400)
            finally:
                self._deployment.running(str(given.get("node")), "")
        log.warning("model change by the page", node=str(given.get("node")), result=done)
        return JSONResponse({"done": done})


class _Lasting:
    """Answers that last, and so have many parts, without the layers that an application puts around each part."""

    def __init__(self, lasting: Mapping[str, ASGIApp], other: ASGIApp) -> None:
        self._lasting, self._other = lasting, other

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        await self._lasting.get(scope["path"], self._other)(scope, receive, send)


def _text(given: dict[str, Any], field: str) -> str:
    return str(given.get(field, ""))[:128]


async def _body(request: Request) -> dict[str, Any] | None:
    """The JSON object of a small request; None for anything else."""
    data = b""
    try:
        async for chunk in request.stream():
            data += chunk
            if len(data) > MAX_BODY_BYTES:
                return None
        found = json.loads(data)
    except (ClientDisconnect, ValueError, RecursionError):
        return None
    return found if isinstance(found, dict) else None
