"""Progress of a model change: what the caller of a push, an activation or a rollback hears while it goes on."""

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
    """One step, and a sentence about it for people."""

    step: Step
    text: str


OnProgress = Callable[[Progress], None]
"""Hears each step as it is reached; it must not raise."""


def silent(_: Progress) -> None:
    """Tell nobody."""
