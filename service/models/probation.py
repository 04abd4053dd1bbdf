"""Probation: watch a new model on the streams that it serves; roll it back if it breaks a limit.

The time of a probation runs from the first window that the model answers. Without windows it waits for them.
"""

import threading
import time
from collections.abc import Callable

from neurove_core.models.bundle import Bundle
from neurove_service import logs
from neurove_service.guard import Guard
from neurove_service.models import swap
from neurove_service.models.plan import Plan, SharedPlan
from neurove_service.models.progress import OnProgress, Progress
from neurove_service.streams.comparison import MIN_WINDOWS, TrialLimits
from neurove_service.streams.roles import Serving

log = logs.get(__name__)

_EARLY = "a later change ended its probation"

OnTrial = Callable[[Bundle | None, Bundle], None]
"""Gets the model whose probation waits for windows, or None when it waits no more; and the model before it."""


def no_trial(_tried: Bundle | None, _proven: Bundle) -> None:
    """Ignore that a probation waits."""


class Probation:
    """Watches one model on a thread of its own until its probation or its canary has ended.

    Args:
        plan: in which the model is tried.
        candidate: the model.
        probation_s: duration of the probation [s]; 0: it passes at once; a canary has no end of its own.
        limits: the limits of the model.
        guard: counts internal errors; one in the probation itself rolls the model back.
        on_changed: called with the model to save: the candidate after its probation, or the model after a rollback.
        on_progress: called with the last step.
        on_trial: called when the probation begins to wait for windows, and when they have come.
    """

    def __init__(
        self,
        plan: SharedPlan,
        candidate: Serving,
        probation_s: float,
        limits: TrialLimits,
        guard: Guard,
        on_changed: Callable[[Bundle], None],
        on_progress: OnProgress,
        on_trial: OnTrial = no_trial,
    ) -> None:
        self._plan, self._candidate = plan, candidate
        self._phase, self._probation_s = plan.current.phase, probation_s
        self._deadline = time.monotonic() + probation_s
        self._windows = 0  # that the model has answered; without enough of them no time ends its probation
        self._began = self._told = False
        self._limits, self._guard = limits, guard
        self._changed, self._on_progress, self._trial = on_changed, on_progress, on_trial

    def start(self) -> None:
        """Start the thread."""
        threading.Thread(target=self._run, name="probation", daemon=True).start()

    def _run(self) -> None:
        try:
            self._watch()
        except Exception as error:  # noqa: BLE001  # without its watch the model must not serve
            self._guard.caught("probation", error, model=self._candidate.estimator.bundle.name)
            self._plan.fault(self._candidate, "its probation ended by an internal error")
        if not self._plan.closing.is_set():
            with self._guard.at("end of a probation"):
                self._end()

    def _on_changed(self, model: Bundle) -> None:
        with self._guard.at("saving the active model", model=model.name):
            self._changed(model)

    def _on_trial(self, tried: Bundle | None, proven: Bundle) -> None:
        with self._guard.at("saving the active model", model=proven.name):
            self._trial(tried, proven)

    def _watch(self) -> None:
        while (plan := self._still_tried()) is not None:
            if self._is_late() and not self._told:
                self._wait_for_windows(plan)
            figures = swap.figures(self._candidate, self._plan.streams(plan.only), serving_is_tried=True)
            self._count(plan, sum(len(one.tried_ms) for one in figures.values()))
            wrong = swap.first_violation(figures, self._limits, swap.PROBATION_WINDOWS)
            if wrong is not None:
                self._plan.fault(self._candidate, f"stream {wrong[0]}: {wrong[1]}")
                continue
            with self._plan.condition:
                if self._plan.current is plan:
                    left_s = self._deadline - time.monotonic()
                    self._plan.condition.wait(min(swap.POLL_S, left_s) if left_s > 0 else swap.POLL_S)

    def _still_tried(self) -> Plan | None:
        """The plan, if the model is still tried in the same phase; at the end of its probation it passes."""
        with self._plan.condition:
            plan = self._plan.current
            if plan.tried is not self._candidate or plan.phase != self._phase or self._plan.closing.is_set():
                return None
            if self._is_late() and (self._windows >= MIN_WINDOWS or self._probation_s <= 0):
                model = self._candidate.estimator.bundle
                self._plan.passed.add(model.digest)
                self._plan.set(Plan(self._candidate), f"{model.name} is active: it passed its probation")
                return None
            return plan

    def _is_late(self) -> bool:
        return self._phase == "probation" and time.monotonic() >= self._deadline

    def _count(self, plan: Plan, windows: int) -> None:
        """Note the windows that the model has answered; the time of the probation runs from the first one."""
        if windows and not self._began:
            self._began = True
            self._deadline = time.monotonic() + self._probation_s
            if self._told and plan.proven is not None:
                self._on_trial(None, plan.proven.estimator.bundle)
        self._windows = max(self._windows, windows)

    def _wait_for_windows(self, plan: Plan) -> None:
        self._told, model = True, self._candidate.estimator.bundle
        if plan.proven is not None:
            self._on_trial(model, plan.proven.estimator.bundle)
        text = f"its probation waits for windows: {self._windows} so far, at least {MIN_WINDOWS} are needed"
        log.warning("probation waits for windows", model=model.name, windows=self._windows, needed=MIN_WINDOWS)
        self._plan.last_change = f"{model.name} is active, but {text}"
        self._on_progress(Progress("waiting", text))

    def _end(self) -> None:
        with self._plan.condition:
            plan, summary = self._plan.current, self._plan.last_change
        model = self._candidate.estimator.bundle
        if plan.active is self._candidate:
            if plan.phase == "steady":
                self._pass(model, summary)
            return  # otherwise the canary was promoted, and its probation has its own thread
        if self._plan.rolled_back is self._candidate:
            self._on_changed(plan.active.estimator.bundle)
            self._on_progress(Progress("rolled_back", summary))
        else:
            self._on_progress(Progress("done", f"{model.name}: {_EARLY}"))

    def _pass(self, model: Bundle, summary: str) -> None:
        """End a probation in time, or early because of a later change; without windows the model is not saved then."""
        in_time = model.digest in self._plan.passed
        if in_time:
            log.info("probation passed", model=model.name)
        if in_time or self._windows >= MIN_WINDOWS:
            self._on_changed(model)
        self._on_progress(Progress("done", summary if in_time else f"{model.name}: {_EARLY}"))
