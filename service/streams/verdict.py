"""The verdict of one stream: its health in one word and the reason in one sentence."""

import threading
from collections import deque
from typing import NamedTuple

from neurove_protocol.control import Verdict
from neurove_service.streams.activity import IDLE_NS, Activity

STALLED_S = 2.0
"""A stream with packets but without an estimate for this time is stalled."""

LOSSY_S = 5.0
"""A stream with a loss within this time is lossy."""

UNSTABLE_RESETS, UNSTABLE_S = 3, 60.0
"""A stream with so many resets within this time is unstable."""

UNCERTAIN_S = 60.0
"""A stream without a certain estimate for this time is uncertain."""

HOLD_S = 1.0
"""The worst verdict of this time is told, so that it does not flap; `idle` itself lasts until a packet comes."""

_SEVERITY: tuple[Verdict, ...] = ("idle", "ok", "uncertain", "lossy", "unstable", "stalled")


class Judgement(NamedTuple):
    """A verdict and its reason."""

    verdict: Verdict
    why: str


class Verdicts:
    """The verdict of one stream over time; any thread may ask.

    Args:
        activity: of the stream.
    """

    def __init__(self, activity: Activity) -> None:
        self._activity = activity
        self._newest: deque[tuple[int, Judgement]] = deque()
        self._lock = threading.Lock()

    def at(self, now_ns: int) -> Judgement:
        """The worst verdict of the last HOLD_S seconds, with its newest reason."""
        judgement = judge(self._activity, now_ns)
        with self._lock:
            held = self._newest
            if judgement.verdict == "idle":
                held.clear()
            held.append((now_ns, judgement))
            while now_ns - held[0][0] > HOLD_S * 1e9:
                held.popleft()
            if len(held) > 2 and held[-2][1].verdict == held[-3][1].verdict == judgement.verdict:
                del held[-2]  # the one before says the same
            return max(reversed(held), key=lambda one: _SEVERITY.index(one[1].verdict))[1]


def judge(activity: Activity, now_ns: int) -> Judgement:
    """The verdict at one moment.

    Args:
        activity: of the stream.
        now_ns: monotonic clock of this node [ns].
    """
    packet_age_ns = now_ns - activity.newest_packet_ns
    if packet_age_ns > IDLE_NS:
        return Judgement("idle", f"no packet for {packet_age_ns / 1e9:.1f} s")
    estimate_age_s = (now_ns - max(activity.last_estimate_ns, activity.flow_began_ns)) / 1e9
    if estimate_age_s > STALLED_S:
        return Judgement(
            "stalled", f"packets arrive, but no estimate for {estimate_age_s:.1f} s{_cause(activity, now_ns)}"
        )
    unstable = _unstable(activity, now_ns)
    if unstable:
        return Judgement("unstable", unstable)
    if activity.last_loss_ns is not None and (now_ns - activity.last_loss_ns) / 1e9 < LOSSY_S:
        lost = activity.counters.losses().nonzero()
        names = ", ".join(f"{name} {count}" for name, count in lost.items())
        return Judgement("lossy", f"lost since the stream began: {names}{_cause(activity, now_ns)}")
    if activity.grew_within("refused_cameras", LOSSY_S, now_ns):
        return Judgement("lossy", f"camera info refused: {activity.refusal}")
    certain_age_s = (now_ns - activity.certain_ns) / 1e9
    if certain_age_s > UNCERTAIN_S:
        return Judgement("uncertain", f"no estimate without uncertain, settling or frozen for {certain_age_s:.0f} s")
    return Judgement("ok", f"nothing lost in the last {LOSSY_S:g} s")


def _cause(activity: Activity, now_ns: int) -> str:
    if activity.grew_within("malformed_packets", LOSSY_S, now_ns) and activity.refusal:
        return f"; packets are refused: {activity.refusal}"
    if activity.grew_within("unit_hint", LOSSY_S, now_ns):
        return f"; {activity.unit_hint}"
    if activity.grew_within("stale_packets", LOSSY_S, now_ns):
        return "; packets are older than max_age_s: the link, the driver or the clock of the camera is too slow"
    return ""


def _unstable(activity: Activity, now_ns: int) -> str:
    if activity.grew_within("foreign_packets", LOSSY_S, now_ns):
        return f"two drivers publish on this stream: {activity.counters.foreign_packets} packets of the second one"
    if activity.grew_within("unit_hint", LOSSY_S, now_ns):
        return activity.unit_hint
    if activity.grew_within("frozen", LOSSY_S, now_ns):
        return "the camera repeats the same events"
    if activity.grew_within("uncounted_packets", LOSSY_S, now_ns):
        return "the driver sends seq 0 in every packet, so losses cannot be counted"
    resets = sum(now_ns - reset_ns < UNSTABLE_S * 1e9 for reset_ns in list(activity.reset_ns))
    return f"{resets} resets in the last {UNSTABLE_S:g} s" if resets >= UNSTABLE_RESETS else ""
