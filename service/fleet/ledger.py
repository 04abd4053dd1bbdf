"""Ledger: the state of every node of a rollout, as a function of the events of its journal."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final, Literal, NamedTuple

from neurove_protocol.errors import InvalidField
from neurove_service.fleet import journal
from neurove_service.fleet.journal import Event
from neurove_service.fleet.selection import Selection

State = Literal["pending", "changing", "active", "fine", "failed", "reverted", "skipped"]
"""pending: not asked yet, or not connected. changing: asked, result unknown. active: in its soak. fine: the soak is
over, and it was heard then. failed. reverted: it serves another model again. skipped: it must not be changed."""

OnFailure = Literal["batch", "all", "stop"]

_WITH_MODEL: Final = ("changing", "active", "fine", "failed")


class Terms(NamedTuple):
    """What the user asked for; part of the first event."""

    bundle: str  # path
    name: str
    digest: str
    steps: tuple[str, ...]
    soak_s: float
    grace_s: float  # a node may be not ok for so long
    max_failed: int
    patience_s: float  # how long nodes that do not answer are retried, in each step
    shadow_s: float = 0.0
    expect: str | None = None
    on_failure: OnFailure = "batch"
    parallel: int = 8


@dataclass
class Target:
    """A node of the plan."""

    node: str
    state: State = "pending"
    why: str = ""
    before: str = ""  # digest of the model that it served before; empty if not known
    rollbacks: int = 0  # automatic rollbacks before the change
    fault: str = ""  # why it failed; stays when it is reverted
    step: int = 0  # in which it was changed, from 1

    @property
    def failed(self) -> bool:
        """Whether it failed, reverted or not."""
        return bool(self.fault)


class Ledger:
    """Nodes and their states.

    Args:
        events: of a journal; the first one is its start.

    Raises:
        InvalidField: they do not begin with a start of this format.
    """

    def __init__(self, events: Sequence[Event]) -> None:
        start: Event = events[0] if events else {"event": "nothing"}
        if start["event"] != "start" or start.get("format") != journal.FORMAT:
            raise InvalidField(
                "rollout", "--resume", start["event"], f"a journal of format {journal.FORMAT} is expected"
            )
        self.terms = Terms(**(start["terms"] | {"steps": tuple(start["terms"]["steps"])}))
        self.targets = {node: Target(node) for node in start["targets"]}  # in the order in which they are changed
        self.already: tuple[str, ...] = tuple(start["already"])  # they served the bundle before
        self.unknown: dict[str, str] = dict(start["unknown"])  # node -> why nobody knows whether it is concerned
        self.skipped: dict[str, str] = dict(start["skipped"])  # node -> why it must not be changed
        self.max_failed = self.terms.max_failed
        self.step = 0
        self.stopped = ""  # why; the rollout changes no further node
        for event in events[1:]:
            self.apply(event)

    def apply(self, event: Event) -> None:
        """Take the next event."""
        kind = event["event"]
        target = self.targets.get(str(event.get("node")))
        if kind == "step":
            self.step = event["number"]
        elif kind == "stop":
            self.stopped = event["why"]
        elif kind == "resume":
            self._resume(event["max_failed"])
        elif target is not None:
            self._of_node(kind, target, event)

    def _resume(self, max_failed: int) -> None:
        if self.stopped and max_failed > self.max_failed:  # the user accepts the failures
            self.stopped = ""
            for one in self.targets.values():
                if one.state == "reverted" and not one.failed:
                    one.state, one.why = "pending", ""
        self.max_failed = max_failed

    def _of_node(self, kind: str, target: Target, event: Event) -> None:
        states: dict[str, State] = {
            "change": "changing",
            "active": "active",
            "offline": "pending",
            "fine": "fine",
            "failed": "failed",
            "reverted": "reverted",
            "skipped": "skipped",
        }
        if kind not in states:
            return
        target.state, target.why = states[kind], event.get("why", "")
        if kind == "change":
            target.before, target.rollbacks, target.step = event["before"], event["rollbacks"], self.step
        if kind == "failed":
            target.fault = target.why

    @property
    def failed(self) -> list[Target]:
        """The nodes that failed, also those that were reverted."""
        return [one for one in self.targets.values() if one.failed]

    @property
    def too_many(self) -> str:
        """Why the rollout must stop, if more nodes failed than may; else empty."""
        failed = self.failed
        if len(failed) <= self.max_failed:
            return ""
        newest = ", ".join(f"{one.node} {one.fault}" for one in failed[-3:])
        return f"{len(failed)} failed, at most {self.max_failed} may: {newest}"

    def of(self, *states: State) -> list[Target]:
        """The nodes in these states, in order."""
        return [one for one in self.targets.values() if one.state in states]

    def to_revert(self) -> list[Target]:
        """The nodes that must serve their model before again, once the rollout has stopped."""
        wanted = self.terms.on_failure
        if wanted == "stop":
            return []
        return [one for one in self.of(*_WITH_MODEL) if wanted == "all" or one.step == self.step or one.state != "fine"]


def start_fields(terms: Terms, selection: Selection) -> dict[str, Any]:
    """The fields of the first event of a journal."""
    return {
        "format": journal.FORMAT,
        "terms": terms._asdict(),
        "targets": [node for node in selection.targets if node not in selection.skipped],
        "already": list(selection.already),
        "skipped": selection.skipped,
        "unknown": selection.unknown,
    }
