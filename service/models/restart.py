"""Restart: the models that serve when a node starts again."""

from neurove_core import self_test
from neurove_core.estimator import Estimator
from neurove_core.models.bundle import Bundle
from neurove_protocol.errors import BadModel, UnknownModel, Untrained
from neurove_service import logs
from neurove_service.models.change import Context
from neurove_service.models.library import Library
from neurove_service.models.plan import Plan, SharedPlan
from neurove_service.models.probation import Probation
from neurove_service.models.progress import silent
from neurove_service.models.record import check_trained, judgement

log = logs.get(__name__)


def first(library: Library, model: str, last: Bundle | None, trained_only: bool) -> Bundle:
    """The model that a node starts with: the last active one, else the configured one.

    Raises:
        BadModel, UnknownModel, Untrained: the configured model cannot serve, and there is no other.
    """
    try:
        configured = library.open(model)
        check_trained(configured, required=trained_only and last is None)
    except (BadModel, UnknownModel) as error:
        if last is None:
            raise
        log.warning("configured model not loaded", model=model, why=error.message, serving=last.name)
        return last
    if last is not None and last.digest != configured.digest:
        why = "it was activated on this node; `neurove activate` changes it"
        log.warning("another model than the configured one serves", configured=model, serving=last.name, why=why)
    return last or configured


def kept(library: Library, digest: str, trained_only: bool) -> Bundle | None:
    """A model that was active before the restart; None if it cannot serve any more."""
    try:
        found = library.find(digest)
        check_trained(found, required=trained_only)
        return found
    except (BadModel, UnknownModel, Untrained) as error:
        log.warning("cannot restore the last active model", digest=digest, why=error.message)
        return None


def try_again(shared: SharedPlan, estimator: Estimator) -> None:
    """Let a model serve whose probation waited for windows before the restart; `resume` goes on with the probation."""
    first, tried = shared.current.active.estimator, estimator.bundle
    try:
        estimator.warm_up()
        self_test.check(estimator)
    except BadModel as error:
        log.warning("model on probation not loaded", model=tried.name, why=error.message)
        return
    shared.previous = first.bundle
    shared.set(Plan.resumed(estimator, first), f"{tried.name} is active, but its probation waits for windows")
    log.warning("model on probation serves again", model=tried.name, before=first.bundle.name)


def resume(context: Context) -> None:
    """Go on with the probation that waited for windows before the restart; does nothing without one."""
    plan = context.plan.current
    if plan.tried is None or plan.proven is None:
        return
    model, active = plan.tried.estimator.bundle, plan.proven.estimator.bundle
    judged = judgement(model, active, passed=active.digest in context.plan.passed, force=None)
    limits = context.rules.probation.and_of(model)._replace(compared=judged.compared)
    calls = context.on_changed, silent, context.on_trial
    Probation(context.plan, plan.tried, context.rules.probation_s, limits, context.guard, *calls).start()
