"""What is asked of each figure of the motion experiment, and the rows of its table."""

import math
from collections.abc import Sequence
from typing import Any, Final, NamedTuple

from neurove_core.experiments.motion.sets import REAL

Span = tuple[float, float]
"""Least and greatest accepted value."""


class Goal(NamedTuple):
    """The requirement and the goal of one figure of a set; a figure of several values has a span for each."""

    group: str
    what: str
    must: tuple[Span, ...]
    goal: tuple[Span, ...]
    must_text: str = ""  # by default, the spans
    goal_text: str = ""


def row(goal: Goal, found: Sequence[float] | None, skipped: str | None = None) -> dict[str, Any]:
    """One row of the table.

    Args:
        goal: what is asked.
        found: the values; None if they were not measured.
        skipped: the reason for that.

    Returns:
        group, what, must and goal (as text), found, reached (`goal`, `must`, `no`, or None if not measured), skipped.
    """
    reached = None
    if found is not None:
        reached = "goal" if _within(found, goal.goal) else "must" if _within(found, goal.must) else "no"
    texts = {"group": goal.group, "what": goal.what, "must": goal.must_text or _text(goal.must)}
    texts["goal"] = goal.goal_text or _text(goal.goal)
    return texts | {"found": None if found is None else list(found), "reached": reached, "skipped": skipped}


def _within(found: Sequence[float], spans: tuple[Span, ...]) -> bool:
    return all(low <= value <= high for value, (low, high) in zip(found, spans, strict=True))  # nan is outside


def _text(spans: tuple[Span, ...]) -> str:
    return ", ".join(dict.fromkeys(map(_span_text, spans)))


def _span_text(span: Span) -> str:
    low, high = span
    if math.isinf(low):
        return f"at most {high:g}"
    return f"at least {low:g}" if math.isinf(high) else f"{low:g} to {high:g}"


def at_most(group: str, what: str, must: float, goal: float) -> Goal:
    """A figure with upper bounds."""
    return Goal(group, what, ((-math.inf, must),), ((-math.inf, goal),))


def at_least(group: str, what: str, must: float, goal: float) -> Goal:
    """A figure with lower bounds."""
    return Goal(group, what, ((must, math.inf),), ((goal, math.inf),))


def around(group: str, what: str, values: Sequence[float], must: Sequence[float], goal: Sequence[float]) -> Goal:
    """A figure with true values, and how far each may be off."""
    first, second = (
        tuple((round(value - off, 6), round(value + off, 6)) for value, off in zip(values, offs, strict=True))
        for offs in (must, goal)
    )
    return Goal(group, what, first, second)


GOALS: Final = (
    at_most("drives", "v_l RE", 0.06, 0.04),
    at_most("drives", "v_l RMSE [m/s]", 0.45, 0.30),
    at_most("drives", "v_a RMSE [deg/s]", 1.5, 0.8),
    at_least("drives", "pitch rate, correlation", 0.7, 0.9),
    at_least("drives", "roll rate, correlation", 0.7, 0.9),
    at_most("aided", "v_a RE", 0.1, 0.05),
    at_most("slow", "v_l RE", 0.06, 0.04),
    at_most("streets", "v_l RE", 0.06, 0.04),
    at_most("cameras", "v_l RE", 0.08, 0.05),
    at_most("heights", "v_l RE", 0.075, 0.05),
    at_most("hand-held", "v_a RE", 0.15, 0.08),
    at_most("trajectories", "v_a RE", 0.35, 0.2),
)
"""Goals of the sets that are measured over all their recordings together."""


def forward_goals(heights_m: Sequence[float], speeds_m_s: Sequence[float]) -> list[Goal]:
    """A constant speed: within 15 % or 0.1 m/s, and within 5 %."""
    must, goal = [max(0.15 * speed, 0.1) for speed in speeds_m_s], [0.05 * speed for speed in speeds_m_s]
    wanted = ", ".join(f"{speed:g}" for speed in speeds_m_s)
    return [
        around("forward", f"vz at {height:g} m [m/s]", speeds_m_s, must, goal)._replace(
            must_text=f"{wanted}; within 15 % or 0.1", goal_text="within 5 %"
        )
        for height in heights_m
    ]


UNCERTAIN: Final = at_most("forward", "share of uncertain estimates", 0.1, 0.0)
PHANTOM_SPEED: Final = at_most("turning", "phantom speed, greatest median [m/s]", 0.1, 0.05)
RATE: Final = at_most("turning", "yaw rate, greatest relative error", 0.1, 0.03)
COST: Final = at_most("cost", "median time of a window, this machine [ms]", 20, 10)
COVERAGE: Final = (0.85, 0.95)
"""Share of the truth that the 90 % intervals should contain."""

REAL_GOALS: Final = {
    ("ecd/shapes_rotation_1.43s.txt", "yaw, correlation"): at_least(
        REAL, "shapes_rotation_1.43s yaw, correlation", 0.99, 0.995
    ),
    ("ecd/shapes_rotation_1.43s.txt", "yaw, RMS error [rad/s]"): at_most(
        REAL, "shapes_rotation_1.43s yaw, RMS error [rad/s]", 0.06, 0.03
    ),
    ("ecd/shapes_rotation/events.txt", "rate of turning at 43.5 s, relative error"): at_most(
        REAL, "shapes_rotation 43.5 s, relative error", 0.15, 0.1
    ),
    ("evbench/seq_0001_e.mat", "rotation about x over its truth"): around(
        REAL, "evbench 1, over the truth", [1], [0.25], [0.1]
    ),
    ("evbench/seq_0002_e.mat", "rotation about x over its truth"): around(
        REAL, "evbench 2, over the truth", [1], [0.25], [0.1]
    ),
    ("slider_depth/events_chunk.txt", "direction of motion, off by [deg]"): at_most(
        REAL, "slider_depth, direction [deg]", 20, 10
    ),
}
"""Checks of `reproduce real` by recording and figure, and what is asked of them here."""

STATIONARY_SPEED: Final = at_most(REAL, "stationary, three recordings: speed at 1 m [m/s]", 0.1, 0.0)
STATIONARY_RATE: Final = at_most(REAL, "stationary, three recordings: turning [rad/s]", 0.05, 0.0)
