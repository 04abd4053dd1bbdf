"""Progress of a model change: what is told while it is made, step by step."""

from collections.abc import Callable
from typing import Literal, NamedTuple

Step = Literal[
    "fetching",
    "staged",
    "verified",
    "loaded",
    "warmed",
    "priming",
    "shadow",
    "active",
    "probation",
    "done",
    "rolled_back",
    "refused",
]


class Progress(NamedTuple):
    """One step of a model change, in words."""

    step: Step
    text: str


OnProgress = Callable[[Progress], None]


def silent(_: Progress) -> None:
    """Tell nobody."""
