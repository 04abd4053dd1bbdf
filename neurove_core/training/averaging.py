"""The mean of several trainings of one model: often better than each of them on what none has seen."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Final

import torch
from torch import Tensor

from neurove_core import self_test
from neurove_core.estimator import Estimator
from neurove_core.models.bundle import Bundle
from neurove_core.models.metadata import MadeBy, Metadata
from neurove_core.networks import kinds
from neurove_core.training.loop import commit
from neurove_core.training.run import check_same_network
from neurove_protocol.errors import BadModel, InvalidField

_PROVENANCE_CHARS: Final = 1000
_MOST: Final = 8


def average(bundles: Sequence[Bundle]) -> Bundle:
    """A model whose weights and norms are the mean of those of others, which began from one another or from one model.

    Source: Wortsman et al., Model soups (ICML 2022). What is no weight is the last one's. A measure of errors is left
    out, for it is of another model: see `calibration`. A golden test is recorded anew.

    Args:
        bundles: 2 to 8 models.

    Raises:
        InvalidField: so many are not taken. BadModel: they are of different networks, or scale their outputs
            differently, so that a weight of one means something else in another.
    """
    if not 2 <= len(bundles) <= _MOST:
        raise InvalidField("model average", "models", len(bundles), f"must be 2 to {_MOST}")
    last = bundles[-1]
    for one in bundles[:-1]:
        check_same_network(one, last.config)
        if one.linear_unit != last.linear_unit or not (
            torch.equal(one.offset, last.offset) and torch.equal(one.scale, last.scale)
        ):
            raise BadModel(one.name, f"its outputs are scaled otherwise than those of {last.digest[:12]}")
    network = kinds.make(last.config)
    network.load_state_dict({name: _mean(bundles, name) for name in network.state_dict()})
    of = ", ".join(one.digest[:12] for one in bundles)
    made = replace(
        last,
        provenance=f"neurove bundle average of {of}; the last: {last.provenance}"[:_PROVENANCE_CHARS],
        network=network.eval(),
        metadata=Metadata(made_by=_made_by(last, of)),
        uncertainty=None,
    )
    if made.golden:
        made = replace(made, golden=self_test.record(Estimator(made), made.golden.counts, made.golden.tolerance))
    return made.with_digest()


def _mean(bundles: Sequence[Bundle], name: str) -> Tensor:
    values: list[Tensor] = [one.network.state_dict()[name] for one in bundles]
    if not values[-1].is_floating_point():  # how many batches a norm has seen
        return values[-1]
    return torch.stack([value.double() for value in values]).mean(dim=0).to(values[-1].dtype)


def _made_by(last: Bundle, of: str) -> MadeBy:
    """As the last one was made, by another program."""
    program = f"neurove bundle average of {of}"
    if last.metadata.made_by is None:
        return MadeBy(program=program, seed=0, commit=commit(), torch=torch.__version__)
    return last.metadata.made_by.model_copy(update={"program": program, "commit": commit(), "torch": torch.__version__})
