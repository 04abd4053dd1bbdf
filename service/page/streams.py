"""A stream as the page shows it: newest estimate and status, a bounded history, and whether it is alive."""

import time
from collections import deque
from dataclasses import dataclass, field
from typing import Any, Final

from neurove_protocol import TwistEstimate
from neurove_protocol.control import StreamStatus
from neurove_service.page.points import Point, magnitudes, point

HISTORY_S: Final = 30.0
"""Time that the plots show [s]."""

STALLED_S: Final = 1.0
"""A stream without an estimate for this time, or for three of its windows, is shown as stalled [s]."""

MAX_POINTS: Final = 900
_RATE_S: Final = 2.0
_LEVEL: Final = {
    "ok": "ok",
    "lossy": "warn",
    "uncertain": "warn",
    "stalled": "bad",
    "unstable": "bad",
    "idle": "idle",
}


def clipped(text: str, most: int = 400) -> str:
    """A text of at most so many characters."""
    return text if len(text) <= most else text[: most - 1] + "…"


@dataclass
class StreamView:
    """What was received of one stream; times are seconds of the monotonic clock."""

    name: str
    node: str = ""
    estimate: TwistEstimate | None = None
    status: StreamStatus | None = None
    estimate_at: float = 0.0
    status_at: float = 0.0
    heard_at: float = 0.0
    points: deque[Point] = field(default_factory=lambda: deque(maxlen=MAX_POINTS))
    recent_s: deque[float] = field(default_factory=lambda: deque(maxlen=MAX_POINTS))  # arrivals that make the rate
    fresh: deque[Point] = field(default_factory=lambda: deque(maxlen=100))

    def on_estimate(self, estimate: TwistEstimate, at: float, start: float) -> None:
        """Take a new estimate that arrived at `at`; `start` is the zero of the page's own clock."""
        self.estimate = estimate
        self.estimate_at = self.heard_at = at
        self.node = estimate.node or self.node
        new = point(estimate, at - start)
        self.points.append(new)
        self.recent_s.append(new.at_s)
        self.fresh.append(new)

    def on_status(self, status: StreamStatus) -> None:
        """Take a new status."""
        self.status, self.node = status, status.node
        self.status_at = self.heard_at = time.monotonic()

    def drain(self) -> list[list[Any]]:
        """The points since the last call."""
        taken = [one.as_json() for one in self.fresh]
        self.fresh.clear()
        return taken

    def recent(self, now_s: float) -> list[list[Any]]:
        """The points of the plotted time."""
        return [one.as_json() for one in self.points if one.at_s > now_s - HISTORY_S]

    def as_json(self, now_s: float, node_problem: str) -> dict[str, Any]:
        """Everything but the points.

        Args:
            now_s: on the page's own clock.
            node_problem: why its node cannot answer; empty if it can.
        """
        level, verdict, why = self._verdict(node_problem)
        status, estimate = self.status, self.estimate
        while self.recent_s and self.recent_s[0] <= now_s - _RATE_S:
            self.recent_s.popleft()
        shown: dict[str, Any] = {
            "name": self.name,
            "node": self.node,
            "level": level,
            "verdict": verdict,
            "why": clipped(why),
            "rate_hz": round(len(self.recent_s) / _RATE_S, 1),
            "age_s": round(time.monotonic() - self.estimate_at, 2) if estimate else None,
        }
        if estimate is not None:
            speed, turn = magnitudes(estimate)
            shown |= {
                "source": estimate.source,
                "model": clipped(estimate.model, 128),
                "speed": [round(speed.value, 4), None if speed.sigma is None else round(speed.sigma, 4)],
                "turn": [round(turn.value, 5), None if turn.sigma is None else round(turn.sigma, 5)],
                "flags": [clipped(flag, 40) for flag in estimate.flags[:16]],
                "events_s": round(estimate.events * 1e6 / (estimate.end_us - estimate.start_us)),
            }
        if status is not None:
            numbers = status.latency_ms
            shown |= {
                "sensor": [status.width, status.height],
                "latency_ms": None if numbers is None else [round(numbers.p50, 2), round(numbers.p99, 2)],
                "lost": status.lost.nonzero(),
                "estimates": status.estimates,
                "refusal": clipped(status.refusal),
            }
        return shown

    def _verdict(self, node_problem: str) -> tuple[str, str, str]:
        """Level, one word, and one sentence."""
        status, estimate = self.status, self.estimate
        window_s = 0.0 if estimate is None else (estimate.end_us - estimate.start_us) / 1e6
        silent_s = time.monotonic() - (self.estimate_at if estimate else self.heard_at)
        if silent_s > max(STALLED_S, 3 * window_s):
            since = f"no estimate for {silent_s:.0f} s"
            if node_problem:
                return "bad", "no service", f"{since}: {node_problem}"
            if status is not None and status.verdict == "idle":
                packet_s = status.last_packet_age_s + time.monotonic() - self.status_at
                return "idle", "idle", f"the driver has published nothing for {packet_s:.0f} s"
            why = status.why if status is not None and status.verdict != "ok" else ""
            return "bad", "stalled", f"{since}: {why or 'neither estimates nor a reason arrive'}"
        if status is None:
            return "ok", "ok", "estimates arrive; no status yet"
        return _LEVEL[status.verdict], status.verdict, status.why
