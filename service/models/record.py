"""Record of a model: whether its estimates are proven, so that another model may be judged by them."""

from typing import NamedTuple

from neurove_core import self_test
from neurove_core.estimator import Estimator
from neurove_core.models.bundle import Bundle
from neurove_protocol.errors import BadModel, Untrained
from neurove_service import logs

log = logs.get(__name__)


def golden_fault(estimator: Estimator) -> str:
    """Why the golden test of a model fails on this machine; empty if it passes, or if the model has none."""
    try:
        self_test.check(estimator)
    except BadModel as error:
        return error.message
    return ""


def why_unproven(model: Bundle, *, passed: bool) -> str:
    """Why the estimates of a model are not a measure for another model; empty if they are.

    Args:
        model: the active model.
        passed: whether it is past its probation and its golden test passes on this machine.
    """
    if not model.trained:
        return "it is untrained"
    if not passed:
        return "it has not passed a probation or its golden test on this node"
    if model.golden is None:
        return "its bundle has no golden test"
    if model.uncertainty is None:
        return "its bundle has no calibration of its errors"
    return ""


class Judgement(NamedTuple):
    """Whether differences from the active model may refuse a new one."""

    compared: bool = True
    text: str = ""  # why not


def judgement(new: Bundle, active: Bundle, *, passed: bool, force: str | None) -> Judgement:
    """How a new model is judged: against the active one if that has a proven record and nobody forces the change.

    Args:
        new: the new model.
        active: the active model.
        passed: as in `why_unproven`.
        force: why the operator forces the change; None if not.
    """
    if force is not None:
        log.warning("model change forced", model=new.name, digest=new.digest[:12], reason=force)
        return Judgement(compared=False, text=f"forced ({force}): no difference from {active.name} refuses it")
    why = why_unproven(active, passed=passed)
    if why:
        text = f"judged by its own limits only: {active.name} has no proven record, because {why}"
        return Judgement(compared=False, text=text)
    return Judgement()


def check_trained(model: Bundle, *, required: bool) -> None:
    """Refuse an untrained model where only trained models are accepted.

    Raises:
        Untrained: the model is untrained.
    """
    if required and not model.trained:
        raise Untrained(model.name)
