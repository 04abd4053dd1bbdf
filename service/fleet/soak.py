"""Soak: what the answers of a node say about a bundle that it has begun to serve."""

from typing import Final, Literal, NamedTuple

from neurove_protocol.control import HealthReply

_CLOCK_SLACK_S: Final = 5.0  # a node may answer with a health that is somewhat older


class Finding(NamedTuple):
    """What is known of a node now."""

    result: Literal["soaking", "fine", "failed"]
    why: str = ""


class Soak:
    """Watches one node from its activation on; times are seconds of a monotonic clock.

    Args:
        digest: of the bundle.
        began_s: when it became active.
        soak_s: how long it is watched [s].
        grace_s: how long it may be not ok [s].
        patience_s: how long after the soak it may be silent [s].
    """

    def __init__(self, digest: str, began_s: float, soak_s: float, grace_s: float, patience_s: float) -> None:
        self._digest, self._end_s, self._soak_s = digest, began_s + soak_s, soak_s
        self._grace_s, self._patience_s = grace_s, patience_s
        self._newest: tuple[float, HealthReply] | None = None
        self._bad_since_s: float | None = None

    def left_s(self, now_s: float) -> float:
        """What is left of the soak [s]."""
        return max(0.0, self._end_s - now_s)

    def heard(self, reply: HealthReply, now_s: float, asked_s: float | None = None) -> Finding:
        """The finding after an answer. A node is fine only by an answer at the end of its soak or later.

        Args:
            reply: the answer.
            now_s: when it has arrived.
            asked_s: when it was asked for; None: now.
        """
        why = self._fault(reply, now_s if asked_s is None else asked_s)
        self._newest = (now_s, reply)
        if why:
            return Finding("failed", why)
        if not (reply.ok and reply.ready):
            self._bad_since_s = now_s if self._bad_since_s is None else self._bad_since_s
            state = reply.why if not reply.ok else "it shuts down"
            if now_s - self._bad_since_s >= self._grace_s:
                return Finding("failed", f"not ok for {now_s - self._bad_since_s:.0f} s: {state}")
            return Finding("soaking", f"not ok: {state}")
        self._bad_since_s = None
        return Finding("fine" if now_s >= self._end_s else "soaking")

    def silent(self, now_s: float, why: str) -> Finding:
        """The finding without an answer."""
        if now_s < self._end_s + self._patience_s:
            return Finding("soaking", why)
        last = f"; it was heard {now_s - self._newest[0]:.0f} s ago" if self._newest else "; it was never heard"
        return Finding("failed", f"{why} at the end of its soak{last}")

    def _fault(self, reply: HealthReply, asked_s: float) -> str:
        if reply.model.digest != self._digest:
            change = f": {reply.change}" if reply.change else ""
            return f"serves {reply.model.name} ({reply.model.digest[:12]}) again{change}"
        if self._newest is None:
            return ""
        before_s, before = self._newest
        late = reply.uptime_s + _CLOCK_SLACK_S < before.uptime_s + (asked_s - before_s)
        if asked_s < self._end_s and (late or reply.uptime_s < before.uptime_s):
            return "started again during its soak"
        if reply.rollbacks > before.rollbacks:
            return f"rolled back automatically: {reply.change}"
        return ""
