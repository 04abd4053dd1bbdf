"""A Runner encodes windows and runs a network: the fast one answers as the plain one does, for any kind of network."""

import numpy as np
import pytest
import torch

from neurove_core.config import CanonicalConfig, ModelConfig, NetworkConfig, WindowConfig
from neurove_core.engine.runner import FastRunner, runner_of
from neurove_core.estimator import Estimator
from neurove_core.models import bundle
from neurove_core.networks.runner import PlainRunner
from neurove_core.networks.state import tensors_of
from tests.builders import SENSOR, make_events

STREAMS = 3


def config_of(**network) -> ModelConfig:
    settings = {"channels": (16, 32), "features": 16, "hidden": 8, "v_th": 0.4} | network
    return ModelConfig(
        window=WindowConfig(duration_us=10_000, bins=2),
        canonical=CanonicalConfig(width=19, height=14),
        network=NetworkConfig(**settings),
    )


def network_of(config: ModelConfig):
    return bundle.untrained(0, config).network.requires_grad_(requires_grad=False)


def counts_of(seed: int, rate: float = 0.6) -> list[np.ndarray]:
    return list(np.random.default_rng(seed).poisson(rate, (STREAMS, 4, 14, 19)).astype(np.uint8))


@pytest.mark.parametrize("channels", [(16, 32), (6, 10)], ids=["over lists", "dense"])
@pytest.mark.parametrize("precision", ["float32", "int8"])
@pytest.mark.parametrize("encoding", ["log1p", "binary"])
def test_the_fast_runner_and_the_plain_one_answer_alike(encoding, precision, channels):
    """On the first window; later ones depend on spikes that rounding may change."""
    network = network_of(config_of(encoding=encoding, precision=precision, channels=channels))
    start = [network.initial_state() for _ in range(STREAMS)]
    counts = counts_of(0)
    fast, plain = (runner.run(counts, start) for runner in (FastRunner(network), PlainRunner(network)))
    for (twists, _), (expected, _) in zip(fast, plain, strict=True):
        assert twists.shape == (2, 6)
        assert twists.dtype == np.float64
        np.testing.assert_allclose(twists, expected, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("kind", ["neurove", "ann", "snn-ang"])
def test_several_streams_are_answered_as_each_alone(kind):
    runner_network = network_of(config_of().model_copy(update={"kind": kind}))
    runner = runner_of(runner_network)
    states = [runner_network.initial_state() for _ in range(STREAMS)]
    alone = list(states)
    for seed in range(3):
        counts = counts_of(seed)
        found = runner.run(counts, states)
        states = [state for _, state in found]
        expected = [runner.run([one], [state])[0] for one, state in zip(counts, alone, strict=True)]
        alone = [state for _, state in expected]
        for (twists, state), (other, other_state) in zip(found, expected, strict=True):
            np.testing.assert_allclose(twists, other, rtol=1e-4, atol=1e-5)
            for one, another in zip(tensors_of(state), tensors_of(other_state), strict=True):
                torch.testing.assert_close(one, another, rtol=1e-4, atol=1e-5)


def test_neurove_has_a_fast_runner_and_a_baseline_a_plain_one():
    assert isinstance(runner_of(network_of(config_of())), FastRunner)
    assert isinstance(runner_of(network_of(config_of().model_copy(update={"kind": "ann"}))), PlainRunner)


def test_an_estimator_uses_the_runner_that_it_receives():
    model = bundle.untrained(0, config_of())
    events = make_events(3_000, seed=0, duration_us=10_000)
    answers = []
    for runner in (None, PlainRunner(model.network)):
        estimator = Estimator(model, runner)
        answers.append(estimator.push(events, estimator.initial_state(SENSOR), 10_000).estimates)
    fast, plain = answers
    assert len(fast) == len(plain) == 1
    np.testing.assert_allclose(fast[0].twists, plain[0].twists, rtol=1e-4, atol=1e-5)
