"""ModelSlot: which models serve the streams of a node, and the entry to a model change while they run."""

from collections.abc import Callable
from pathlib import Path

from neurove_core.estimator import Estimator
from neurove_core.models.bundle import Bundle
from neurove_protocol.control import ModelInfo
from neurove_protocol.errors import Untrained
from neurove_service import logs
from neurove_service.guard import Guard
from neurove_service.models import admission, precompile, restart
from neurove_service.models.change import Change, Context, Rules
from neurove_service.models.library import Available, Files, Library, nothing_pushed
from neurove_service.models.plan import Plan, SharedPlan
from neurove_service.models.probation import OnTrial, no_trial
from neurove_service.models.progress import OnProgress, silent
from neurove_service.models.record import golden_fault
from neurove_service.streams.model_source import StreamView
from neurove_service.streams.roles import Roles, Serving

log = logs.get(__name__)


class ModelSlot:
    """Holds the active model. A change replaces it as a whole, after the new model is loaded, checked and warm.

    Args:
        model: name of a built-in model or of one in the folder, or path of a bundle file.
        models_dir: folder of bundles that may be activated.
        rules: limits and times of a change.
        on_changed: called with the model to save, after it passed its probation or after a rollback; on a thread of
            the slot or of the caller, never on a stream's.
        free_bytes: free memory [bytes].
        pushed: files of the bundles that were pushed to this node, by digest.
        kept: digests of the last active model and the one before; if they can be loaded, they take precedence over
            `model`.
        trained_only: whether the node refuses untrained models.
        trial: digest of the model whose probation waited for windows; it serves first, on probation.
        on_trial: see `probation.OnTrial`.
        guard: counts internal errors of a model change.

    Raises:
        BadModel, UnknownModel: the first model cannot be loaded.
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
        trained_only: bool = False,
        trial: str | None = None,
        on_trial: OnTrial = no_trial,
        guard: Guard | None = None,
    ) -> None:
        library = Library(models_dir, pushed)
        active, previous = (restart.kept(library, digest, trained_only) if digest else None for digest in kept)
        first = restart.first(library, model, active, trained_only)
        takes = "a second; up to 30 s where kernels have to be compiled, as at the first start on a machine"
        log.info("loading the kernels of the model; `ready` follows", model=first.name, takes=takes)
        precompile.at_start(first.config, free_bytes)
        estimator = Estimator(first, bounds=rules.bounds, refine=rules.refine)
        estimator.warm_up()
        self._shared = SharedPlan(Serving(estimator, 0), previous)
        self._shared.shapes.add(estimator.config)
        self._golden_fault = golden_fault(estimator)
        if self._golden_fault:
            log.error("golden test of the first model fails", why=self._golden_fault)
        else:
            self._shared.passed.add(estimator.bundle.digest)
        self._first = estimator
        self.closing = self._shared.closing  # set when the node stops; a probation then ends without a last step
        self._context = Context(
            self._shared, library, rules, on_changed, free_bytes, guard or Guard(), trained_only, on_trial
        )
        tried = restart.kept(library, trial, trained_only) if trial else None
        if tried is not None and tried.digest != estimator.bundle.digest:
            restart.try_again(self._shared, Estimator(tried, bounds=rules.bounds, refine=rules.refine))

    def resume(self) -> None:
        """Go on with the probation that waited for windows before a restart; does nothing without one."""
        restart.resume(self._context)

    @property
    def active(self) -> Serving:
        """The active model; during a canary it serves all other streams."""
        return self._shared.current.active

    @property
    def previous(self) -> Bundle | None:
        """The model that a rollback activates."""
        return self._shared.previous

    @property
    def plan(self) -> Plan:
        """Which models are at work."""
        return self._shared.current

    @property
    def last_change(self) -> str:
        """One sentence about the newest change; empty before the first one."""
        return self._shared.last_change

    @property
    def rollbacks(self) -> int:
        """Number of automatic rollbacks since the start."""
        return self._shared.rollbacks

    @property
    def faults(self) -> list[str]:
        """What is wrong with the models that answer now, one sentence each."""
        plan = self._shared.current
        answering = [plan.active, plan.other] if plan.phase == "canary" else [plan.active]
        bundles = [one.estimator.bundle for one in answering if one is not None]
        found = [f"model {one.name} is untrained: its estimates have no meaning" for one in bundles if not one.trained]
        if self._golden_fault and plan.active.estimator is self._first:
            found.append(self._golden_fault)
        return found

    def is_built_in(self, digest: str) -> bool:
        """Whether a model belongs to this installation."""
        return self._context.library.is_built_in(digest)

    def check_trained(self, info: ModelInfo) -> None:
        """Refuse an untrained model on a node that takes only trained ones.

        Raises:
            Untrained: the model is untrained.
        """
        if self._context.trained_only and not info.trained:
            raise Untrained(info.name)

    def roles(self, stream: str) -> Roles:
        """Which models work on a stream from its next packet on."""
        return self._shared.current.roles(stream)

    def join(self, stream: StreamView) -> None:
        """Include a stream in every change from now on, for as long as the stream lives."""
        self._shared.join(stream)

    def fault(self, serving: Serving, why: str) -> None:
        """Roll back a model on probation at once, on all streams; does nothing if it is not on probation any more."""
        self._shared.fault(serving, why)

    def available(self) -> Available:
        """Every model that can be activated, and the files that are no models."""
        return self._context.library.available()

    def activate(
        self,
        model: str,
        *,
        expect: str | None = None,
        shadow_s: float = 0.0,
        canary: frozenset[str] = frozenset(),
        force: str | None = None,
        on_progress: OnProgress = silent,
    ) -> tuple[Bundle, Serving]:
        """Make a model the active one; if it is active already, nothing changes.

        The previous model serves until the new one is ready; it stays after a refusal.
        The call returns when streams answer with the new model. Its probation goes on; its end is the last step that
        `on_progress` gets. A change during a probation ends it: the model on probation passes.

        Args:
            model: its name, or at least the first 8 digits of its digest.
            expect: the first 8 or more digits of the digest of the active model; another active model is a conflict.
            shadow_s: time in shadow before activation, in which the model is compared with the active one [s].
            canary: change only these streams; a second call without it changes the other streams too.
            force: why no difference from the active model may refuse the new one; None: differences count if the active
                model has a proven record, see `record.why_unproven`.
            on_progress: called at each step, on this thread; after the return on a thread of the slot.

        Returns:
            the previous model, or the model itself if it was active already, and the model that now serves the streams
            concerned.

        Raises:
            UnknownModel, BadModel, Untrained, Conflict, NoMemory, TooSlow, Diverged, InternalError: nothing changed.
        """
        with self._shared.one_change(on_progress):
            return Change(self._context, on_progress).activate(model, expect, shadow_s, canary, force)

    def rollback(self, *, expect: str | None = None, on_progress: OnProgress = silent) -> tuple[Bundle, Serving]:
        """Activate the previous model again.

        During probation and a canary it runs in standby, so its estimates are those of a run without the change.

        Args:
            expect: as in activate; refers to the tried model, if there is one.
            on_progress: called at each step.

        Returns:
            the model that was rolled back, and the model that serves now.

        Raises:
            Conflict: another change is in progress, or another model is active.
            NothingBefore: there is no previous model.
        """
        with self._shared.one_change(on_progress):
            return Change(self._context, on_progress).rollback(expect)

    def await_probation(self, timeout_s: float) -> bool:
        """Wait until no model is on probation; return False after the timeout."""
        return self._shared.await_probation(timeout_s)

    def close(self) -> None:
        """Stop waiting in a change or a probation; no probation passes after this."""
        self._shared.close()
