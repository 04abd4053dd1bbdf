"""Deployment: streams and nodes as the page knows them, filled by the feed and read by the web server."""

import threading
import time
from typing import Any, Final

from neurove_protocol import TwistEstimate
from neurove_protocol.control import HealthReply, ModelsReply, StreamStatus
from neurove_service.page.nodes import NodeView
from neurove_service.page.streams import HISTORY_S, StreamView

MAX_STREAMS: Final = 32
MAX_NODES: Final = 32
NODES_TICKS: Final = 5
"""One of so many news has the nodes."""

_FORGET_S: Final = 600.0  # a stream or a node that has been silent for so long leaves the page


class Deployment:
    """All streams and nodes, bounded in number; the one that has been silent longest makes room for a new one."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._start = time.monotonic()
        self._streams: dict[str, StreamView] = {}
        self._nodes: dict[str, NodeView] = {}
        self._unreachable = "the page has not connected yet"
        self._ticks = 0

    def on_estimate(self, estimate: TwistEstimate, received_ns: int) -> None:
        """Take an estimate that was received at this time of the monotonic clock [ns]."""
        with self._lock:
            if view := self._stream(estimate.stream):
                view.on_estimate(estimate, received_ns / 1e9, self._start)

    def on_status(self, status: StreamStatus) -> None:
        """Take a status."""
        with self._lock:
            if view := self._stream(status.stream):
                view.on_status(status)

    def on_health(self, replies: list[HealthReply]) -> None:
        """Take the answers of the nodes."""
        with self._lock:
            for reply in replies:
                if view := self._node(reply.node):
                    view.on_health(reply)

    def on_models(self, replies: list[ModelsReply]) -> None:
        """Take the models of the nodes."""
        with self._lock:
            for reply in replies:
                if view := self._node(reply.node):
                    view.models = reply

    def on_token(self, node: str, present: bool) -> None:
        """A node came or left."""
        with self._lock:
            if view := self._node(node):
                view.on_token(present)

    def running(self, node: str, text: str) -> None:
        """The step of a change that this page asked for; empty at its end."""
        with self._lock:
            if node in self._nodes:
                self._nodes[node].running = text

    def unreachable(self, why: str) -> None:
        """Why there is no session with the deployment; empty once there is."""
        with self._lock:
            self._unreachable = why

    def has_stream(self, name: str) -> bool:
        """Whether the page shows a stream of this name."""
        with self._lock:
            return name in self._streams

    def news(self) -> dict[str, Any]:
        """The state now, with the points since the last call; nodes change slowly, so only some news have them."""
        with self._lock:
            now_s = time.monotonic() - self._start
            state = self._state(now_s, {name: view.drain() for name, view in self._streams.items()})
            with_nodes = self._ticks % NODES_TICKS == 0
            self._ticks += 1
            return state | self._all_nodes() if with_nodes else state

    def everything(self) -> dict[str, Any]:
        """The state now, with all nodes, and all points of the plotted time."""
        with self._lock:
            now_s = time.monotonic() - self._start
            state = self._state(now_s, {name: view.recent(now_s) for name, view in self._streams.items()})
            return state | self._all_nodes()

    def _state(self, now_s: float, points: dict[str, list[list[Any]]]) -> dict[str, Any]:
        self._forget()
        problems = {name: node.problem for name, node in self._nodes.items()}
        streams = [
            view.as_json(now_s, problems.get(view.node, self._unreachable)) | {"points": points.get(name, [])}
            for name, view in sorted(self._streams.items())
        ]
        reached = any(not problem for problem in problems.values())
        why = self._unreachable or ("no service answers" if not reached else "")
        return {
            "now_s": round(now_s, 3),
            "history_s": HISTORY_S,
            "problem": "" if reached else why,
            "streams": streams,
        }

    def _all_nodes(self) -> dict[str, Any]:
        return {"nodes": [node.as_json() for _, node in sorted(self._nodes.items())]}

    def _stream(self, name: str) -> StreamView | None:
        view = self._streams.get(name)
        if view is None:
            if len(self._streams) >= MAX_STREAMS:
                oldest = min(self._streams.values(), key=lambda one: one.heard_at)
                if time.monotonic() - oldest.heard_at < 2:
                    return None  # all are alive: the page shows the first ones
                del self._streams[oldest.name]
            view = self._streams[name] = StreamView(name, heard_at=time.monotonic())
        return view

    def _node(self, name: str) -> NodeView | None:
        if name not in self._nodes:
            if len(self._nodes) >= MAX_NODES:
                gone = [one for one in self._nodes.values() if not one.alive]
                if not gone:
                    return None
                del self._nodes[min(gone, key=lambda one: one.left_at).name]
            self._nodes[name] = NodeView(name)
        return self._nodes[name]

    def _forget(self) -> None:
        now = time.monotonic()
        for view in [one for one in self._streams.values() if now - one.heard_at > _FORGET_S]:
            del self._streams[view.name]
        for node in [one for one in self._nodes.values() if not one.alive and now - one.left_at > _FORGET_S]:
            del self._nodes[node.name]
