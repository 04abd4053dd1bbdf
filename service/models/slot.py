"""ModelSlot: which model answers, which came before, and how one takes the place of another while streams run."""

import contextlib
import threading
import time
import weakref
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple

from neurove_core import self_test
from neurove_core.estimator import Estimator
from neurove_core.models.bundle import Bundle
from neurove_protocol.errors import BadModel, Conflict, InvalidField, NeuroVEError, NothingBefore, UnknownModel
from neurove_service import logs
from neurove_service.models import admission, swap
from neurove_service.models.library import MIN_DIGEST, Available, Files, Library, nothing_pushed
from neurove_service.models.progress import OnProgress, Progress, Step, silent
from neurove_service.models.swap import Plan, Subject
from neurove_service.streams.comparison import TrialLimits
from neurove_service.streams.lane import Serving
from neurove_service.streams.lanes import Roles

log = logs.get(__name__)


class Rules(NamedTuple):
    """How a model change is judged."""

    probation_s: float = 10.0
    shadow: TrialLimits = TrialLimits()
    probation: TrialLimits = TrialLimits(divergence=3.0)  # it acts by itself: only on what can not be meant
    prime_s: float = 15.0  # longest that a new model waits for windows that its bundle wants beyond those that are kept
    warm_up_share: float = 1.0  # 99th percentile of the time for a window, in the window's duration


class ModelSlot:
    """Holds the active model; replaces it whole, and only by one that was loaded, checked and warm.

    Args:
        model: name of a built-in model or of one in the folder, or the path of a bundle's file.
        models_dir: folder of bundles that may be activated.
        rules: how a change is judged.
        on_changed: told the model that may be kept, when its probation has ended well or after a rollback; on a thread
            of the slot or of the caller, never on a stream's.
        free_bytes: memory that may still be taken.
        pushed: the files of bundles that were pushed to this node, by digest.
        kept: digests of the models that served last and before that, which go before `model` where they can be loaded.

    Raises:
        BadModel, UnknownModel: the first model can not be loaded.
    """

    def __init__(
        self,
        model: str,
        models_dir: Path | None = None,
        rules: Rules = Rules(),  # noqa: B008  # immutable
        on_changed: Callable[[Bundle], None] = lambda _: None,
        free_bytes: Callable[[], int | None] = admission.free_bytes,
        *,
        pushed: Files = nothing_pushed,
        kept: tuple[str | None, str | None] = (None, None),
    ) -> None:
        self._library, self._rules = Library(models_dir, pushed), rules
        self._on_changed, self._free_bytes = on_changed, free_bytes
        self._changing = threading.Lock()  # held by the one change that is under way
        self._turn = threading.Condition()  # of the plan
        self._closing = threading.Event()
        self._subjects: weakref.WeakSet[Subject] = weakref.WeakSet()
        self.rollbacks = 0  # by itself
        self._fallen: Serving | None = None  # the newest that was taken back
        self.last_change = ""
        active, self.previous = (self._kept(digest) if digest else None for digest in kept)
        estimator = Estimator(self._first(model, active))
        estimator.warm_up()
        self._epoch = 0
        self._plan = Plan(Serving(estimator, 0))

    # --- what streams ask

    @property
    def active(self) -> Serving:
        """The model that serves now; while a canary is on, the one that serves all other streams."""
        return self._plan.active

    @property
    def plan(self) -> Plan:
        """Which models are at work."""
        return self._plan

    def roles(self, stream: str) -> Roles:
        """What a stream answers with from its next packet on, and what runs beside."""
        return self._plan.roles(stream)

    def join(self, stream: Subject) -> None:
        """Have a stream be part of every change from now on, for as long as it lives."""
        with self._turn:
            self._subjects.add(stream)

    def fault(self, serving: Serving, why: str) -> None:
        """Take a model on probation back at once, for all streams; nothing where it is not on probation any more."""
        with self._turn:
            plan = self._plan
            if plan.tried is None or plan.tried.estimator is not serving.estimator:
                return
            self._retreat(f"{serving.estimator.bundle.name} was rolled back by itself: {why}")
            self.rollbacks += 1
        log.error("model rolled back", model=serving.estimator.bundle.name, why=why, rollbacks=self.rollbacks)

    # --- what operators ask

    def available(self) -> Available:
        """Every model that could be activated, and what lies among them but is none."""
        return self._library.available()

    def activate(
        self,
        model: str,
        *,
        expect: str | None = None,
        shadow_s: float = 0.0,
        canary: frozenset[str] = frozenset(),
        on_progress: OnProgress = silent,
    ) -> tuple[Bundle, Serving]:
        """Make a model the active one; until it is ready the old one serves, and if it is not fit it stays.

        Returns when streams answer with the new model; its probation goes on, and `on_progress` is told how it ends.
        A change during a probation ends it well.

        Args:
            model: its name, or at least the first 8 digits of its digest.
            expect: the first 8 or more digits of the digest of the model that must be active for the change to be made.
            shadow_s: run it beside the active one for so long first, and compare.
            canary: switch these streams alone; a second call without it switches the others too.
            on_progress: told every step; on this thread, after the return on one of the slot.

        Returns:
            the model before, and what the streams concerned answer with now.

        Raises:
            UnknownModel, BadModel, Conflict, NoMemory, TooSlow, Diverged: nothing was changed.
        """
        with self._change(on_progress), self._told(model, on_progress) as tell:
            self._expected(expect)
            found = self._library.find(model)
            candidate = self._promoted(found, canary)
            try:
                if candidate is not None:  # it was tried on the canary's streams
                    self._prime(candidate, canary, tell)
                else:
                    candidate = self._tried(found, canary, shadow_s, tell)
                before = self._switch(candidate, canary, tell)
            except BaseException:
                self._end_trial()
                raise
            self._watch(candidate, on_progress)
            return before.estimator.bundle, candidate

    def rollback(self, *, expect: str | None = None, on_progress: OnProgress = silent) -> tuple[Bundle, Serving]:
        """Go back to the model before; on probation and from a canary it was kept fed, and goes on as if never swapped.

        Args:
            expect: as of activate; of the model that is tried, where one is.
            on_progress: told every step.

        Returns:
            the model that was taken back, and what serves now.

        Raises:
            Conflict: another change is under way, or another model is active.
            NothingBefore: there is none before it.
        """
        with self._change(on_progress):
            plan = self._expected(expect)
            if plan.tried is not None:
                with self._turn:
                    taken = (self._plan.tried or plan.tried).estimator.bundle
                    if self._plan.tried is not None:  # it may have fallen by itself meanwhile
                        self._retreat(f"{taken.name} was rolled back")
                on_progress(Progress("rolled_back", f"to {self._plan.active.estimator.bundle.name}"))
                return taken, self._plan.active
            if self.previous is None:
                raise NothingBefore
            with self._told(self.previous.name, on_progress) as tell:
                taken = plan.active.estimator.bundle
                estimator = self._fit(self.previous, tell)
                self._epoch += 1
                serving = Serving(estimator, self._epoch)
                try:
                    self._prime(serving, frozenset(), tell)
                except BaseException:
                    self._end_trial()
                    raise
                self._set(Plan(serving), f"{taken.name} was rolled back")
                self.previous = None
                tell("rolled_back", f"to {serving.estimator.bundle.name}; primed, not kept fed")
            self._on_changed(serving.estimator.bundle)
            return taken, serving

    @property
    def closing(self) -> bool:
        """Whether the node ends; a probation then ends without a word."""
        return self._closing.is_set()

    def await_probation(self, timeout_s: float) -> bool:
        """Wait until no model is on probation; whether that came about in time."""
        with self._turn:
            return self._turn.wait_for(lambda: self._plan.phase != "probation", timeout_s)

    def close(self) -> None:
        """End what runs behind: no probation ends well after this."""
        with self._turn:
            self._closing.set()
            self._turn.notify_all()

    # --- one change, step by step

    @contextlib.contextmanager
    def _change(self, on_progress: OnProgress) -> Iterator[None]:
        if not self._changing.acquire(blocking=False):
            error = Conflict("another one is under way")
            on_progress(Progress("refused", error.message))
            raise error
        try:
            yield
        finally:
            self._changing.release()

    @contextlib.contextmanager
    def _told(self, model: str, on_progress: OnProgress) -> Iterator[Callable[[Step, str], None]]:
        def tell(step: Step, text: str) -> None:
            log.info("model change", step=step, text=text)
            on_progress(Progress(step, text))

        try:
            yield tell
        except NeuroVEError as error:
            self.last_change = f"{model} was refused: {error.message}"
            tell("refused", error.message)
            raise

    def _expected(self, expect: str | None) -> Plan:
        plan = self._plan
        if expect is None:
            return plan
        if len(expect) < MIN_DIGEST:
            raise InvalidField("model change", "expect", expect, f"at least {MIN_DIGEST} digits of a digest")
        active = (plan.tried or plan.active).estimator.bundle
        if not active.digest.startswith(expect):
            raise Conflict(f"{expect} is expected to be active, but {active.name} {active.digest} is")
        return plan

    def _promoted(self, found: Bundle, canary: frozenset[str]) -> Serving | None:
        """The canary of this model, which needs no loading to serve all streams."""
        plan = self._plan
        if plan.phase != "canary" or plan.other is None:
            return None
        on = plan.other.estimator.bundle
        if canary or on.digest != found.digest:
            raise Conflict(f"a canary of {on.name} {on.digest} is on: promote it or roll it back first")
        return plan.other

    def _tried(
        self, found: Bundle, canary: frozenset[str], shadow_s: float, tell: Callable[[Step, str], None]
    ) -> Serving:
        """A model that is ready to answer: loaded, fast enough, primed, and where asked compared in shadow."""
        tell("verified", f"{found.name} {found.digest[:12]}")
        estimator = self._fit(found, tell)
        self._accept_trial()
        candidate = Serving(estimator, self._epoch + 1)
        self._prime(candidate, canary, tell)
        if shadow_s > 0:
            self._shadow(candidate, canary, shadow_s, tell)
        return candidate

    def _fit(self, found: Bundle, tell: Callable[[Step, str], None]) -> Estimator:
        admission.check_memory(found.name, admission.weight_bytes(found), self._free_bytes())
        estimator = Estimator(found)
        tell("loaded", f"{found.info.parameters:,} parameters")
        estimator.warm_up()
        self_test.check(estimator)
        p99_ms = admission.check_speed(estimator, self._rules.warm_up_share)
        tell("warmed", f"p99 {p99_ms:.1f} ms of a window of {estimator.config.window.duration_us / 1e3:g} ms")
        return estimator

    def _end_trial(self) -> None:
        """Leave nothing running beside of a change that is refused; a canary goes on as it was."""
        with self._turn:
            plan = self._plan
            if plan.phase in ("priming", "shadow"):
                self._set(Plan(plan.active), self.last_change)
            elif plan.promoting:
                self._set(plan._replace(promoting=False), self.last_change)

    def _accept_trial(self) -> None:
        with self._turn:
            if self._plan.phase == "probation":
                self._set(Plan(self._plan.active), self.last_change)

    def _prime(self, candidate: Serving, canary: frozenset[str], tell: Callable[[Step, str], None]) -> None:
        tell("priming", f"{len(self._streams(canary))} streams")
        plan = self._plan
        promoted = plan.phase == "canary"
        if plan.active.estimator.has_same_windows(candidate.estimator):
            with self._turn:
                beside = Plan(plan.active, candidate, canary, "priming")
                self._set(plan._replace(promoting=True) if promoted else beside, self.last_change)
            served = plan.only if promoted else frozenset[str]()

            def streams() -> list[Subject]:
                return [one for one in self._streams(canary) if one.name not in served]

            primed, left = swap.prime(candidate, streams, self._rules.prime_s, self._closing.wait)
            tell("priming", f"{primed} streams replayed their newest windows, {left} had none")
            return
        if promoted:
            return
        tell("priming", "it cuts or sees otherwise than the active model: nothing to replay, it starts cold beside it")
        self._set(Plan(plan.active, candidate, canary, "shadow"), self.last_change)
        deadline = time.monotonic() + swap.settling_s(candidate)
        while not swap.settled(candidate, self._streams(canary)) and time.monotonic() < deadline:
            if self._closing.wait(swap.POLL_S):
                break

    def _shadow(
        self, candidate: Serving, canary: frozenset[str], seconds: float, tell: Callable[[Step, str], None]
    ) -> None:
        tell("shadow", f"for {seconds:g} s beside {self.active.estimator.bundle.name}")
        self._set(Plan(self._plan.active, candidate, canary, "shadow"), self.last_change)
        limits, wait = self._rules.shadow.and_of(candidate.estimator.bundle), self._closing.wait
        found = swap.shadow(candidate, lambda: self._streams(canary), seconds, limits, wait)
        tell("shadow", "; ".join(f"{name}: {one}" for name, one in found.items()))

    def _switch(self, candidate: Serving, canary: frozenset[str], tell: Callable[[Step, str], None]) -> Serving:
        with self._turn:
            old, new = self._plan.active, candidate.estimator.bundle
            self._epoch = max(self._epoch, candidate.epoch)
            if canary:
                self._set(Plan(old, candidate, canary, "canary"), f"{new.name} is a canary")
            else:
                self.previous = old.estimator.bundle
                self._set(Plan(candidate, old, phase="probation"), f"{new.name} is active")
        log.info("model changed", model=new.name, digest=new.digest[:12], canary=sorted(canary))
        missing = canary - {stream.name for stream in self._streams(canary)}
        where = f"on {', '.join(sorted(canary))}" if canary else "on all streams"
        tell("active", f"{where}{f'; not here yet: {sorted(missing)}' if missing else ''}")
        tell("probation", "until it is promoted or rolled back" if canary else f"for {self._rules.probation_s:g} s")
        return old

    def _watch(self, candidate: Serving, on_progress: OnProgress) -> None:
        watcher = threading.Thread(target=self._probation, args=(candidate, on_progress), name="probation", daemon=True)
        watcher.start()

    def _probation(self, candidate: Serving, on_progress: OnProgress) -> None:
        """Until a trial has ended: look at streams, take the model back where it broke a limit."""
        phase, deadline = self._plan.phase, time.monotonic() + self._rules.probation_s
        limits = self._rules.probation.and_of(candidate.estimator.bundle)
        while True:
            with self._turn:
                plan = self._plan
                if plan.tried is not candidate or plan.phase != phase or self._closing.is_set():
                    break
                if phase == "probation" and time.monotonic() >= deadline:
                    self._set(Plan(candidate), f"{candidate.estimator.bundle.name} is active, its probation ended well")
                    break
            found = swap.measured(candidate, self._streams(plan.only), front_is_tried=True)
            wrong = swap.worst(found, limits, swap.JUDGED_WINDOWS)
            if wrong is not None:
                self.fault(candidate, f"stream {wrong[0]}: {wrong[1]}")
                continue
            with self._turn:
                if self._plan is plan:
                    self._turn.wait(min(swap.POLL_S, max(0.001, deadline - time.monotonic())))
        if self._closing.is_set():
            return
        self._end(candidate, on_progress)

    def _end(self, candidate: Serving, on_progress: OnProgress) -> None:
        with self._turn:
            plan, how = self._plan, self.last_change
        name = candidate.estimator.bundle.name
        if plan.active is candidate:
            if plan.phase == "steady":
                log.info("probation ended well", model=name)
                self._on_changed(candidate.estimator.bundle)
                on_progress(Progress("done", how))
            return  # promoted: another watcher goes on
        if self._fallen is candidate:
            self._on_changed(plan.active.estimator.bundle)
            on_progress(Progress("rolled_back", how))
        else:
            on_progress(Progress("done", f"{name}: a later change ended its probation"))

    def _retreat(self, how: str) -> None:
        """To the proven model; the caller holds the turn."""
        proven = self._plan.proven
        assert proven is not None
        self._fallen = self._plan.tried
        self._epoch += 1
        self.previous = None
        self._set(Plan(Serving(proven.estimator, self._epoch)), how)

    def _set(self, plan: Plan, how: str) -> None:
        with self._turn:
            self._plan, self.last_change = plan, how
            self._turn.notify_all()

    def _streams(self, only: frozenset[str]) -> list[Subject]:
        with self._turn:
            return [stream for stream in self._subjects if not only or stream.name in only]

    # --- the first model

    def _first(self, model: str, kept: Bundle | None) -> Bundle:
        try:
            configured = self._library.open(model)
        except (BadModel, UnknownModel) as error:
            if kept is None:
                raise
            log.warning("configured model not loaded", model=model, why=error.message, serves=kept.name)
            return kept
        return kept or configured

    def _kept(self, digest: str) -> Bundle | None:
        try:
            return self._library.find(digest)
        except (BadModel, UnknownModel) as error:
            log.warning("model that served last not loaded", digest=digest, why=error.message)
            return None
