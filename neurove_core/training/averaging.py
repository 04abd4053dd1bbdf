"""Average the weights of several trained models; the mean is often better than each model on unseen data."""

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
    """Return a model whose weights and norms are the mean of those of other models.

    The models must start from each other or from one common model. Everything except the weights is taken from the last
    model. The result has no uncertainty, because that of another model does not apply; see `calibration`. Its golden
    test is recorded again.

    Source: Wortsman et al., Model soups (ICML 2022).

    Args:
        bundles: 2 to 8 models.

    Raises:
        InvalidField: the number of models is outside 2 to 8.
        BadModel: the models have different networks or different output scalings, so that their weights are not
            comparable.
    """
    if not 2 <= len(bundles) <= _MOST:
        raise InvalidField("model average", "models", len(bundles), f"must be 2 to {_MOST}")
    last = bundles[-1]
    for one in bundles[:-1]:
        check_same_network(one, last.config)
        if one.linear_unit != last.linear_unit or not (
            torch.equal(one.offset, last.offset) and torch.equal(one.scale, last.scale)
        ):
            raise BadModel(one.name, f"its output scaling differs from that of {last.digest[:12]}")
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
    if not values[-1].is_floating_point():  # the number of batches that a norm has seen
        return values[-1]
    return torch.stack([value.double() for value in values]).mean(dim=0).to(values[-1].dtype)


def _made_by(last: Bundle, of: str) -> MadeBy:
    """The `made_by` of the last model, with this program."""
    program = f"neurove bundle average of {of}"
    if last.metadata.made_by is None:
        return MadeBy(program=program, seed=0, commit=commit(), torch=torch.__version__)
    return last.metadata.made_by.model_copy(update={"program": program, "commit": commit(), "torch": torch.__version__})
