"""A node as the page shows it: health, models, and the history of its model changes since the page started."""

import time
from collections import deque
from dataclasses import dataclass, field
from typing import Any, Final

from neurove_protocol.control import HealthReply, ModelInfo, ModelsReply
from neurove_service.page.streams import clipped

SILENT_S: Final = 1.6
"""A node that has not answered for this time is shown as not answering [s]."""

_SLACK_S: Final = 1.5  # a reply may have been on its way for so long
MAX_HISTORY, MAX_MODELS = 40, 64


def model_json(info: ModelInfo) -> dict[str, Any]:
    """A model in short."""
    return {
        "name": clipped(info.name, 128),
        "digest": info.digest[:64],
        "signature": info.signature,
        "trained": info.trained,
        "release": info.release,
        "parameters": info.parameters,
        "provenance": clipped(info.provenance, 110),
    }


@dataclass
class NodeView:
    """What is known of one node; times are seconds of the monotonic clock."""

    name: str
    alive: bool = True
    left_at: float = 0.0
    answered_at: float = field(default_factory=time.monotonic)
    health: HealthReply | None = None
    models: ModelsReply | None = None
    running: str = ""  # the newest step of a change that this page asked for
    history: deque[dict[str, Any]] = field(default_factory=lambda: deque(maxlen=MAX_HISTORY))

    def on_health(self, reply: HealthReply) -> None:
        """Take an answer, and note what changed since the one before."""
        before, self.health = self.health, reply
        elapsed_s = time.monotonic() - self.answered_at
        self.answered_at = time.monotonic()
        if before is None:
            what = "the page started; this model was active"
            self._note(reply.model, f"{what}; {reply.change}" if reply.change else what)
        elif reply.uptime_s < before.uptime_s + elapsed_s - _SLACK_S:  # a new process, however long it has run
            self._note(reply.model, "the service started again")
        elif (reply.epoch, reply.model.digest) != (before.epoch, before.model.digest):
            self._note(reply.model, reply.change or "another model became active")
        elif reply.change != before.change and reply.change:
            self._note(reply.model, reply.change)

    def on_token(self, present: bool) -> None:
        """Take a change of its liveliness token."""
        if self.alive and not present:
            self.left_at = time.monotonic()
        self.alive = present

    def _note(self, model: ModelInfo, reason: str) -> None:
        self.history.appendleft(
            {"at": round(time.time(), 1), "model": clipped(model.name, 128), "digest": model.digest[:12],
             "reason": clipped(reason)}
        )  # fmt: skip

    @property
    def problem(self) -> str:
        """Why it cannot answer, in words; empty if it answers."""
        now = time.monotonic()
        if not self.alive:
            return f"node {self.name} left {now - self.left_at:.0f} s ago"
        if now - self.answered_at > SILENT_S:
            return f"node {self.name} has not answered for {now - self.answered_at:.0f} s"
        return ""

    def as_json(self) -> dict[str, Any]:
        """Everything about it."""
        reply, models, problem = self.health, self.models, self.problem
        level = "bad" if problem else "idle" if reply is None else "ok" if reply.ok else "warn"
        shown: dict[str, Any] = {
            "name": self.name,
            "level": level,
            "verdict": "gone" if not self.alive else "silent" if problem else "ok" if level == "ok" else "not ok",
            "why": problem or ("waiting for its health" if reply is None else clipped(reply.why)),
            "history": list(self.history),
            "running": self.running,
        }
        if reply is not None:
            shown |= {
                "version": clipped(reply.version, 40),
                "uptime_s": round(reply.uptime_s),
                "epoch": reply.epoch,
                "model": model_json(reply.model),
                "rollbacks": reply.rollbacks,
                "streams": len(reply.streams),
                "missing": list(reply.missing_streams[:16]),
            }
        if models is not None:
            shown["available"] = [
                {"name": clipped(one.name, 128), "digest": one.digest} for one in models.available[:MAX_MODELS]
            ]
            shown["previous"] = None if models.previous is None else model_json(models.previous)
        return shown
