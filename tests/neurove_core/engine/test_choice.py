"""The form that serves is chosen by time; answers never depend on it."""

import time
from dataclasses import replace

import numpy as np
import pytest

from neurove_core import models
from neurove_core.config import CanonicalConfig, ModelConfig, NetworkConfig
from neurove_core.engine.array_runner import ArrayRunner
from neurove_core.engine.choice import VARIABLE, fastest
from neurove_core.engine.fallback import vectors_work
from neurove_core.estimator import Estimator
from neurove_core.models import bundle
from neurove_core.self_test import answers, record
from neurove_protocol.errors import InvalidField

compiled_only = pytest.mark.skipif(not vectors_work(), reason="no compiled forms with this numba")
CONFIGS = {
    precision: ModelConfig(
        canonical=CanonicalConfig(width=33, height=21),
        network=NetworkConfig(channels=(16, 32, 16), features=32, hidden=12, v_th=0.4, precision=precision),
    )
    for precision in ("float32", "int8")
}


def windows(config: ModelConfig) -> np.ndarray:
    rates = np.array([0.05, 0.3, 1, 200]).reshape(-1, 1, 1, 1)
    rng = np.random.default_rng(20_500)
    return rng.poisson(rates, (4, *config.input_shape)).clip(0, 255).astype(np.uint8)


def runner_of(precision: str) -> ArrayRunner:
    return ArrayRunner(bundle.untrained(3, CONFIGS[precision]).current_weights)


def run(runner: ArrayRunner, given: np.ndarray) -> list[np.ndarray]:
    state, found = runner.initial_state(), []
    for window in given:
        ((twists, state),) = runner.run([window], [state])
        found += [twists, *state.membranes]
    return found


@compiled_only
@pytest.mark.parametrize(("precision", "forms"), [("float32", 2), ("int8", 3)])
def test_every_form_gives_the_same_answers_bit_for_bit(precision, forms, monkeypatch):
    given, found, served = windows(CONFIGS[precision]), [], set()
    for name in ("sparse", "dense", "float32"):
        monkeypatch.setenv(VARIABLE, name)
        runner = runner_of(precision)
        runner.choose(None)
        served.add(runner.choice.form)
        found.append(run(runner, given))
    assert len(served) == forms
    for other in found[1:]:
        for one, same in zip(found[0], other, strict=True):
            np.testing.assert_array_equal(one, same)


@compiled_only
@pytest.mark.parametrize("precision", CONFIGS)
def test_the_chosen_form_answers_as_the_usual_one(precision):
    given, usual, chosen = windows(CONFIGS[precision]), runner_of(precision), runner_of(precision)
    chosen.choose(given)
    assert "fastest on its golden windows" in chosen.choice.why
    assert "differs" not in chosen.choice.why
    for one, same in zip(run(usual, given), run(chosen, given), strict=True):
        np.testing.assert_array_equal(one, same)


def test_a_form_with_other_numbers_never_serves_however_fast_it_is():
    def slow() -> np.ndarray:
        deadline = time.perf_counter() + 0.002
        while time.perf_counter() < deadline:
            pass
        return np.zeros(3, np.float32)

    found = fastest({"sparse": slow, "dense": lambda: np.full(3, -0.0, np.float32)})
    assert found.form == "sparse"
    assert "dense differs" in found.why


def test_the_fastest_of_equal_forms_serves():
    rounds = []

    def slow() -> np.ndarray:
        rounds.append(sum(range(2_000_000)))
        return np.zeros(3, np.float32)

    assert fastest({"sparse": slow, "dense": lambda: np.zeros(3, np.float32)}).form == "dense"
    assert len(rounds) >= 2


@compiled_only
def test_an_estimator_says_which_form_serves_and_the_environment_pins_it(monkeypatch):
    model = models.find(models.DEFAULT)
    assert "golden windows" in Estimator(model).form
    monkeypatch.setenv(VARIABLE, "dense")
    pinned = Estimator(model)
    assert pinned.form == f"dense (named by {VARIABLE})"
    monkeypatch.setenv(VARIABLE, "sparse")
    some = model.golden.counts[:3]
    np.testing.assert_array_equal(answers(pinned, some), answers(Estimator(model), some))


@compiled_only
@pytest.mark.parametrize("change", [{"canonical": {"subcells": 2}}, {"network": {"history": (1, 2)}}])
def test_golden_windows_of_any_input_can_be_timed(change):
    config = CONFIGS["float32"].model_dump()
    for part, fields in change.items():
        config[part] |= fields
    model = bundle.untrained(3, ModelConfig.model_validate(config))
    rng = np.random.default_rng(20_501)
    counts = rng.poisson(0.3, (3, *model.config.window_shape)).astype(np.uint8)
    golden = record(Estimator(model), counts)
    assert "fastest on its golden windows" in Estimator(replace(model, golden=golden)).form


def test_an_unknown_form_is_an_error_that_names_the_known_ones(monkeypatch):
    monkeypatch.setenv(VARIABLE, "quick")
    with pytest.raises(InvalidField, match="NEUROVE_FORM.*quick.*sparse"):
        Estimator(bundle.untrained(3, CONFIGS["float32"]))


@compiled_only
@pytest.mark.parametrize("precision", CONFIGS)
def test_the_parts_of_a_window_together_give_its_answer(precision):
    runner, given = runner_of(precision), windows(CONFIGS[precision])[1]
    parts = runner.parts(given)
    assert [part.name for part in parts] == [
        "first convolution",
        "convolution 2",
        "convolution 3",
        "projection",
        "cells and readout",
    ]
    assert all(part.sums > 0 and part.weights > 0 for part in parts)
    ((twists, _),) = runner.run([given], [runner.initial_state()])
    for _ in range(2):  # a part that is repeated starts from the same state
        np.testing.assert_array_equal(parts[-1].run()[0], twists)
