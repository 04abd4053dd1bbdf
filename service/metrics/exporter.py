"""Exporter: what the paths of the HTTP server answer: /metrics, /live, /ready, /health."""

import json
import time
from collections.abc import Callable
from http import HTTPStatus
from typing import Final

from neurove_service.metrics.families import CONTENT_TYPE, Fleet, exposition
from neurove_service.metrics.http import Response

FRESH_S: Final = 0.25
"""What was read is shown again for this time, so that many clients cost no more than one [s]."""

_INDEX: Final = b"NeuroVE: /metrics (Prometheus), /live, /ready, /health\n"


class Exporter:
    """Answers the paths of one node or of a fleet.

    Args:
        read: the nodes now; called at most once in FRESH_S.
        live: why the process must be restarted; empty if it must not.
        ready: why it does not serve now; empty if it serves.
        now_s: monotonic clock [s].
    """

    def __init__(
        self,
        read: Callable[[], Fleet],
        live: Callable[[], str],
        ready: Callable[[], str],
        now_s: Callable[[], float] = time.monotonic,
    ) -> None:
        self._read, self._live, self._ready, self._now_s = read, live, ready, now_s
        self._newest: tuple[float, Fleet] | None = None

    def respond(self, path: str) -> Response | None:
        """The answer to a path; None for an unknown one."""
        match path:
            case "/metrics":
                return Response(exposition(self._fleet()), content_type=CONTENT_TYPE)
            case "/live":
                return _state(self._live(), "live")
            case "/ready":
                return _state(self._ready(), "ready")
            case "/health":
                return self._health()
            case "/":
                return Response(_INDEX)
        return None

    def _fleet(self) -> Fleet:
        now_s = self._now_s()
        if self._newest is None or now_s - self._newest[0] >= FRESH_S:
            self._newest = (now_s, self._read())
        return self._newest[1]

    def _health(self) -> Response:
        fleet = self._fleet()
        ok = bool(fleet.replies) and not fleet.silent and all(reply.ok for reply in fleet.replies)
        body = {
            "ok": ok,
            "nodes": [reply.model_dump() for reply in fleet.replies],
            "silent": list(fleet.silent),
        }
        status = HTTPStatus.OK if ok else HTTPStatus.SERVICE_UNAVAILABLE
        return Response(json.dumps(body).encode() + b"\n", status, "application/json")


def _state(why_not: str, fine: str) -> Response:
    if why_not:
        return Response(f"not {fine}: {why_not}\n".encode(), HTTPStatus.SERVICE_UNAVAILABLE)
    return Response(f"{fine}\n".encode())
