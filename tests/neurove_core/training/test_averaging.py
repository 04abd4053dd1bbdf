"""The average of models: mean weights, only for equal networks, and without data that belongs to one model only."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from neurove_core import self_test
from neurove_core.estimator import Estimator
from neurove_core.models import bundle
from neurove_core.training.averaging import average
from neurove_protocol.errors import BadModel, InvalidField
from tests.bundles import CONFIG, ORIGINAL


def other(seed=3, config=CONFIG):
    made = bundle.untrained(seed, config)
    return replace(made, name="other", offset=ORIGINAL.offset, scale=ORIGINAL.scale, linear_unit=ORIGINAL.linear_unit)


def test_every_weight_is_the_mean_and_everything_else_is_that_of_the_last_model():
    one, two = ORIGINAL, other().with_digest()
    made = average([one, two])
    a, b = one.network.state_dict(), two.network.state_dict()
    for name, value in made.network.state_dict().items():
        if value.is_floating_point():
            torch.testing.assert_close(value, (a[name] + b[name]) / 2)
    assert (made.name, made.uncertainty) == ("other", None)
    assert one.digest[:12] in made.provenance
    assert two.digest[:12] in made.provenance
    assert made.digest not in ("", one.digest, two.digest)


def test_a_model_averaged_with_itself_gives_the_same_estimates_and_gets_a_new_golden_test():
    counts = np.random.default_rng(0).poisson(0.3, (4, 4, 8, 10)).astype(np.uint8)
    tested = replace(ORIGINAL, golden=self_test.record(Estimator(ORIGINAL), counts)).with_digest()
    made = average([tested, tested])
    self_test.check(Estimator(made))
    np.testing.assert_array_equal(made.golden.twists, tested.golden.twists)


@pytest.mark.parametrize(
    ("models", "error", "says"),
    [
        ([ORIGINAL], InvalidField, "models=1"),
        ([replace(ORIGINAL, scale=2 * ORIGINAL.scale), other()], BadModel, "output scaling differs"),
        (
            [
                ORIGINAL,
                other(config=CONFIG.model_copy(update={"network": CONFIG.network.model_copy(update={"hidden": 5})})),
            ],
            BadModel,
            "hidden",
        ),
    ],
)
def test_models_that_cannot_be_averaged_are_refused(models, error, says):
    with pytest.raises(error, match=says):
        average(models)
