"""Plan: which models are at work on which streams; SharedPlan: the plan that streams read and a change replaces."""

import contextlib
import threading
import weakref
from collections.abc import Iterator
from typing import Literal, NamedTuple

from neurove_core.estimator import Estimator
from neurove_core.models.bundle import Bundle
from neurove_protocol.errors import Conflict
from neurove_service import logs
from neurove_service.models.precompile import Shapes
from neurove_service.models.progress import OnProgress, Progress
from neurove_service.streams.model_source import StreamView
from neurove_service.streams.roles import Roles, Serving

log = logs.get(__name__)

Phase = Literal["steady", "priming", "shadow", "canary", "probation"]


class Plan(NamedTuple):
    """Which models are at work; streams read it once per packet."""

    active: Serving
    other: Serving | None = None  # priming, shadow, canary: the candidate; probation: the proven model
    only: frozenset[str] = frozenset()  # streams on which the other model works; empty: all
    phase: Phase = "steady"
    promoting: bool = False  # canary: all other streams prime the candidate

    def concerns(self, stream: str) -> bool:
        """Whether the other model works on this stream."""
        return self.other is not None and (not self.only or stream in self.only)

    def roles(self, stream: str) -> Roles:
        """The serving model and the standby model of a stream."""
        if self.other is None:
            return Roles(self.active)
        if not self.concerns(stream):
            return Roles(self.active, self.other if self.promoting else None)
        if self.phase == "canary":
            return Roles(self.other, self.active, probation=True)
        return Roles(self.active, self.other, probation=self.phase == "probation")

    @classmethod
    def resumed(cls, tried: Estimator, proven: Estimator) -> "Plan":
        """A probation that goes on after a restart."""
        return cls(Serving(tried, 0), Serving(proven, 0), phase="probation")

    @property
    def tried(self) -> Serving | None:
        """The model that serves and may still be rolled back."""
        return self.active if self.phase == "probation" else self.other if self.phase == "canary" else None

    @property
    def proven(self) -> Serving | None:
        """The model that serves again after a rollback."""
        return self.other if self.phase == "probation" else self.active if self.phase == "canary" else None


class SharedPlan:
    """The plan, and what belongs to it: previous model, number of changes, text of the newest change, streams.

    Any thread may read it. Hold `condition` to read and replace it in one step.

    Args:
        serving: the first model.
        previous: the model that served before it.
    """

    def __init__(self, serving: Serving, previous: Bundle | None) -> None:
        self.current = Plan(serving)
        self.previous = previous
        self.epoch = serving.epoch
        self.last_change = ""
        self.rollbacks = 0  # automatic ones
        self.rolled_back: Serving | None = None  # the newest model that was rolled back
        self.condition = threading.Condition()  # notified at each new plan
        self.passed: set[str] = set()  # digests of the models that need no probation any more
        self.shapes = Shapes()
        self.closing = threading.Event()
        self._one_change = threading.Lock()
        self._streams: weakref.WeakSet[StreamView] = weakref.WeakSet()

    @contextlib.contextmanager
    def one_change(self, on_progress: OnProgress) -> Iterator[None]:
        """The right to change the model; one caller at a time has it.

        Raises:
            Conflict: another caller has it.
        """
        if not self._one_change.acquire(blocking=False):
            error = Conflict("another model change is in progress")
            on_progress(Progress("refused", error.message))
            raise error
        try:
            yield
        finally:
            self._one_change.release()

    def join(self, stream: StreamView) -> None:
        """Include a stream in every model change from now on, for as long as the stream lives."""
        with self.condition:
            self._streams.add(stream)

    def streams(self, only: frozenset[str]) -> list[StreamView]:
        """The streams with these names; all streams if the set is empty."""
        with self.condition:
            return [stream for stream in self._streams if not only or stream.name in only]

    def set(self, plan: Plan, summary: str | None = None) -> None:
        """Replace the plan.

        Args:
            plan: the new plan.
            summary: text of the newest change; None keeps the present text.
        """
        with self.condition:
            self.current = plan
            if summary is not None:
                self.last_change = summary
            self.condition.notify_all()

    def roll_back(self, summary: str) -> None:
        """Let the proven model serve again; the caller holds the condition, and a model is tried."""
        proven = self.current.proven
        assert proven is not None
        self.rolled_back = self.current.tried
        self.epoch += 1
        self.previous = None
        self.set(Plan(Serving(proven.estimator, self.epoch)), summary)

    def accept_trial(self) -> None:
        """End a probation: its model passes."""
        with self.condition:
            if self.current.phase == "probation":
                self.set(Plan(self.current.active))

    def end_trial(self) -> None:
        """Stop the standby model of a refused change; a canary continues as before."""
        with self.condition:
            plan = self.current
            if plan.phase in ("priming", "shadow"):
                self.set(Plan(plan.active))
            elif plan.promoting:
                self.set(plan._replace(promoting=False))

    def fault(self, serving: Serving, why: str) -> None:
        """Roll back a model on probation at once, on all streams; does nothing if it is not on probation any more."""
        name = serving.estimator.bundle.name
        with self.condition:
            tried = self.current.tried
            if tried is None or tried.estimator is not serving.estimator:
                return
            self.roll_back(f"{name} was rolled back automatically: {why}")
            self.rollbacks += 1
        log.error("model rolled back", model=name, why=why, rollbacks=self.rollbacks)

    def await_probation(self, timeout_s: float) -> bool:
        """Wait until no model is on probation; return False after the timeout."""
        with self.condition:
            return self.condition.wait_for(lambda: self.current.phase != "probation", timeout_s)

    def close(self) -> None:
        """Stop waiting in a change or a probation; no probation passes after this."""
        with self.condition:
            self.closing.set()
            self.condition.notify_all()
