"""Change: one change of the active model, step by step.

Verify, load, warm up, run the self-test, prime, optionally compare in shadow, switch, watch on probation; or roll back.
The previous model serves until the switch. A change that is refused leaves no trace.
"""

import contextlib
import time
from collections.abc import Callable, Iterator
from typing import NamedTuple

from neurove_core import self_test
from neurove_core.estimator import Estimator
from neurove_core.models.bounds import UNSET, Bounds
from neurove_core.models.bundle import Bundle
from neurove_protocol.errors import Conflict, InternalError, InvalidField, NeuroVEError, NothingBefore
from neurove_service import logs
from neurove_service.guard import Guard
from neurove_service.models import admission, precompile, swap
from neurove_service.models.library import MIN_DIGEST, Library
from neurove_service.models.plan import Plan, SharedPlan
from neurove_service.models.probation import OnTrial, Probation, no_trial
from neurove_service.models.progress import OnProgress, Progress, Step
from neurove_service.models.record import Judgement, check_trained, judgement
from neurove_service.streams.comparison import TrialLimits
from neurove_service.streams.model_source import StreamView
from neurove_service.streams.roles import Serving

log = logs.get(__name__)


class Rules(NamedTuple):
    """The limits and times of a model change."""

    probation_s: float = 10.0
    shadow: TrialLimits = TrialLimits()
    probation: TrialLimits = TrialLimits(divergence=3.0)  # wide, because the node rolls back without an operator
    prime_s: float = 15.0  # maximum wait for windows that a bundle needs beyond those that are kept [s]
    warm_up_share: float = 1.0  # bound of the 99th percentile of the time for a window, as a share of its duration
    bounds: Bounds = UNSET  # of sigma, for the flag `uncertain`; they take precedence over those of a bundle
    refine: bool = False  # whether models may refine their estimates, see `Estimator`


class Context(NamedTuple):
    """What every change of one node works with."""

    plan: SharedPlan
    library: Library
    rules: Rules
    on_changed: Callable[[Bundle], None]
    free_bytes: Callable[[], int | None]
    guard: Guard
    trained_only: bool = False  # untrained models are refused
    on_trial: OnTrial = no_trial


class Change:
    """One change; make a new one for each. The caller holds `SharedPlan.one_change`.

    Args:
        context: of the node.
        on_progress: called at each step.
    """

    def __init__(self, context: Context, on_progress: OnProgress) -> None:
        self._context = context
        self._plan, self._library, self._rules = context.plan, context.library, context.rules
        self._on_progress = on_progress
        self._judged = Judgement()

    def activate(
        self, model: str, expect: str | None, shadow_s: float, canary: frozenset[str], force: str | None
    ) -> tuple[Bundle, Serving]:
        """Make a model the active one, see `ModelSlot.activate`."""
        with self._reporting(model):
            found = self._library.find(model)
            if self._is_active(found):
                return found, self._keep_active(found)
            _check_expected(self._plan.current, expect)
            check_trained(found, required=self._context.trained_only)
            candidate = _running_canary(self._plan.current, found, canary)
            active = self._plan.current.active.estimator.bundle
            self._judged = judgement(found, active, passed=active.digest in self._plan.passed, force=force)
            try:
                if candidate is not None:
                    self._prime(candidate, canary)
                else:
                    candidate = self._prepare(found, canary, shadow_s)
                before = self._switch(candidate, canary)
                limits = self._limits(self._rules.probation, candidate)
                context, probation_s = self._context, self._rules.probation_s
                calls = context.on_changed, self._on_progress, context.on_trial
                Probation(self._plan, candidate, probation_s, limits, context.guard, *calls).start()
            except BaseException:
                if candidate is not None:  # without its probation it must not serve
                    self._plan.fault(candidate, "its change ended by an internal error")
                self._plan.end_trial()
                raise
            return before.estimator.bundle, candidate

    def rollback(self, expect: str | None) -> tuple[Bundle, Serving]:
        """Activate the previous model again, see `ModelSlot.rollback`."""
        plan = self._plan.current
        _check_expected(plan, expect)
        if plan.tried is not None:
            with self._plan.condition:
                removed = (self._plan.current.tried or plan.tried).estimator.bundle
                if self._plan.current.tried is not None:  # a fault may have rolled it back in the meantime
                    self._plan.roll_back(f"{removed.name} was rolled back")
            active = self._plan.current.active
            self._on_progress(Progress("rolled_back", f"to {active.estimator.bundle.name}"))
            return removed, active
        previous = self._plan.previous
        if previous is None:
            raise NothingBefore
        removed = plan.active.estimator.bundle
        with self._reporting(previous.name):
            check_trained(previous, required=self._context.trained_only)
            estimator = self._load(previous)
            self._plan.epoch += 1
            serving = Serving(estimator, self._plan.epoch)
            try:
                self._prime(serving, frozenset())
            except BaseException:
                self._plan.end_trial()
                raise
            self._plan.set(Plan(serving), f"{removed.name} was rolled back")
            self._plan.previous = None
            self._report("rolled_back", f"to {previous.name}; it was primed, because it did not run in standby")
        with self._context.guard.at("saving the active model", model=estimator.bundle.name):
            self._context.on_changed(estimator.bundle)
        return removed, serving

    def _is_active(self, found: Bundle) -> bool:
        plan = self._plan.current
        return plan.phase in ("steady", "probation") and plan.active.estimator.bundle.digest == found.digest

    def _keep_active(self, found: Bundle) -> Serving:
        """Change nothing, so that the previous model stays the way back."""
        self._report("done", f"{found.name} is already the active model; nothing changed")
        return self._plan.current.active

    def _limits(self, limits: TrialLimits, candidate: Serving) -> TrialLimits:
        return limits.and_of(candidate.estimator.bundle)._replace(compared=self._judged.compared)

    def _report(self, step: Step, text: str) -> None:
        log.info("model change", step=step, text=text)
        self._on_progress(Progress(step, text))

    @contextlib.contextmanager
    def _reporting(self, model: str) -> Iterator[None]:
        """Report an error as the last step. A bug is counted and refuses the change like any other error."""
        try:
            yield
        except NeuroVEError as error:
            self._refuse(model, error)
            raise
        except Exception as error:
            self._context.guard.caught("model change", error, model=model)
            refused = InternalError()
            self._refuse(model, refused)
            raise refused from error

    def _refuse(self, model: str, error: NeuroVEError) -> None:
        self._plan.last_change = f"{model} was refused: {error.message}"
        self._report("refused", error.message)

    def _prepare(self, found: Bundle, canary: frozenset[str], shadow_s: float) -> Serving:
        """A model that is ready to serve: loaded, fast enough, primed, and compared in shadow if requested."""
        self._report("verified", f"{found.name} {found.digest[:12]}")
        estimator = self._load(found)
        self._plan.accept_trial()
        candidate = Serving(estimator, self._plan.epoch + 1)
        self._prime(candidate, canary)
        if shadow_s > 0:
            self._compare_in_shadow(candidate, canary, shadow_s)
        return candidate

    def _load(self, found: Bundle) -> Estimator:
        """Load a model, warm it up, and check its memory, its golden test and its speed."""
        free, share = self._context.free_bytes(), self._rules.warm_up_share
        admission.check_cost(found, free, share)
        if self._plan.shapes.need_child(found.config, free):
            self._report("compiling", "code for a network of this shape, in a process of its own")
            precompile.in_child(found.config, self._plan.closing)
        estimator = Estimator(found, bounds=self._rules.bounds, refine=self._rules.refine)
        self._report("loaded", f"{found.info.parameters:,} parameters")
        admission.check_first_windows(estimator, share)
        estimator.warm_up()
        self._plan.shapes.add(found.config)
        self_test.check(estimator)
        p99_ms = admission.check_speed(estimator, share)
        self._report("warmed", f"p99 {p99_ms:.1f} ms for a window of {found.config.window.duration_us / 1e3:g} ms")
        return estimator

    def _prime(self, candidate: Serving, canary: frozenset[str]) -> None:
        """Run a model over the newest windows of its streams; a promoted canary over those of all other streams."""
        self._report("priming", f"{len(self._plan.streams(canary))} streams")
        plan = self._plan.current
        promoted = plan.phase == "canary"
        if not plan.active.estimator.has_same_windows(candidate.estimator):
            if not promoted:
                self._start_cold(candidate, canary)
            return
        served = plan.only if promoted else frozenset[str]()
        standby = plan._replace(promoting=True) if promoted else Plan(plan.active, candidate, canary, "priming")
        self._plan.set(standby)

        def streams() -> list[StreamView]:
            return [one for one in self._plan.streams(canary) if one.name not in served]

        primed, left = swap.prime(candidate, streams, self._rules.prime_s, self._plan.closing.wait)
        self._report("priming", f"{primed} streams replayed their newest windows, {left} streams had none")

    def _start_cold(self, candidate: Serving, canary: frozenset[str]) -> None:
        """Run a model with other windows in standby, from the zero state, until it has settled."""
        self._report("priming", "its windows or its grid differ from the active model's: it starts cold in standby")
        active = self._plan.current.active
        self._plan.set(Plan(active, candidate, canary, "shadow"))
        deadline = time.monotonic() + swap.max_settling_s(candidate)
        while not swap.settled(candidate, self._plan.streams(canary)) and time.monotonic() < deadline:
            if self._plan.closing.wait(swap.POLL_S):
                break

    def _compare_in_shadow(self, candidate: Serving, canary: frozenset[str], seconds: float) -> None:
        active = self._plan.current.active
        self._report("shadow", f"for {seconds:g} s in parallel with {active.estimator.bundle.name}")
        self._plan.set(Plan(self._plan.current.active, candidate, canary, "shadow"))
        limits = self._limits(self._rules.shadow, candidate)
        wait = self._plan.closing.wait
        found = swap.compare_in_shadow(candidate, lambda: self._plan.streams(canary), seconds, limits, wait)
        self._report("shadow", "; ".join(f"{name}: {figures}" for name, figures in found.items()))

    def _switch(self, candidate: Serving, canary: frozenset[str]) -> Serving:
        """Let a model serve, on the canary's streams or on all; return the model that was active."""
        with self._plan.condition:
            old, new = self._plan.current.active, candidate.estimator.bundle
            self._plan.epoch = max(self._plan.epoch, candidate.epoch)
            if canary:
                self._plan.set(Plan(old, candidate, canary, "canary"), f"{new.name} is a canary")
            else:
                self._plan.previous = old.estimator.bundle
                how = f", {self._judged.text}" if self._judged.text else ""
                self._plan.set(Plan(candidate, old, phase="probation"), f"{new.name} is active{how}")
        log.info("model changed", model=new.name, digest=new.digest[:12], canary=sorted(canary))
        missing = sorted(canary - {stream.name for stream in self._plan.streams(canary)})
        where = f"on {', '.join(sorted(canary))}" if canary else "on all streams"
        self._report("active", f"{where}{f'; these streams do not exist yet: {missing}' if missing else ''}")
        probation = f"for {self._rules.probation_s:g} s"
        ends = "until it is promoted or rolled back" if canary else probation
        self._report("probation", f"{ends}; {self._judged.text}" if self._judged.text else ends)
        return old


def _check_expected(plan: Plan, expect: str | None) -> None:
    """Check that the expected model is the tried one, or the active one if none is tried.

    Raises:
        Conflict: another model is.
    """
    if expect is None:
        return
    if len(expect) < MIN_DIGEST:
        raise InvalidField("model change", "expect", expect, f"at least {MIN_DIGEST} digits of a digest")
    active = (plan.tried or plan.active).estimator.bundle
    if not active.digest.startswith(expect):
        raise Conflict(f"expected {expect} to be active, but {active.name} {active.digest} is active")


def _running_canary(plan: Plan, found: Bundle, canary: frozenset[str]) -> Serving | None:
    """The canary of this model, which serves all streams without being loaded again.

    Raises:
        Conflict: there is a canary, and this change does not promote it.
    """
    if plan.phase != "canary" or plan.other is None:
        return None
    running = plan.other.estimator.bundle
    if canary or running.digest != found.digest:
        raise Conflict(f"a canary of {running.name} {running.digest} is running: promote it or roll it back first")
    return plan.other
