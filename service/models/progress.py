"""Progress of a push, an activation or a rollback: the steps that its caller gets while it runs."""

from collections.abc import Callable
from typing import Literal, NamedTuple

Step = Literal[
    "fetching",
    "staged",
    "verified",
    "compiling",
    "loaded",
    "warmed",
    "priming",
    "shadow",
    "active",
    "probation",
    "waiting",
    "done",
    "rolled_back",
    "refused",
]


class Progress(NamedTuple):
    """One step, and a sentence about it for people."""

    step: Step
    text: str


OnProgress = Callable[[Progress], None]
"""Called at each step; must not raise."""


def silent(_: Progress) -> None:
    """Ignore progress."""
