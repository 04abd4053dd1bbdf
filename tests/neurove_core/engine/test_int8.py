"""An int8 network fires and projects in 8-bit integers as in float32, bit for bit, and trains through the rounding."""

import logging

import pytest
import torch

from neurove_core.config import CanonicalConfig, ModelConfig, NetworkConfig, WindowConfig
from neurove_core.engine import int8
from neurove_core.engine.encoding import to_codes
from neurove_core.engine.engine import Engine
from neurove_core.engine.fallback import forget_warnings
from neurove_core.engine.int8 import Int8Layer, Int8Projection, int8_convolution, plain_int8_convolution
from neurove_core.estimator import Estimator
from neurove_core.models import bundle
from neurove_core.networks import quantisation
from neurove_core.networks.encoding import to_spikes
from neurove_core.spiking.plain import plain
from tests.builders import SENSOR, make_events

SMALL = ModelConfig(
    window=WindowConfig(duration_us=10_000, bins=2),
    canonical=CanonicalConfig(width=19, height=14),
    network=NetworkConfig(channels=(6, 40), features=13, hidden=11, v_th=0.4, precision="int8"),
)
SHIPPED = ModelConfig(network=NetworkConfig(v_th=0.4, precision="int8"))


def network_of(config: ModelConfig, seed: int = 0):
    return bundle.untrained(seed, config).network.requires_grad_(requires_grad=False)


def draw(config: ModelConfig, batch: int = 1, steps: int = 5, seed: int = 1):
    shape = (steps, batch, 2 * config.window.bins, config.canonical.height, config.canonical.width)
    return torch.poisson(torch.full(shape, 0.4), generator=torch.Generator().manual_seed(seed)).log1p()


@pytest.mark.parametrize("config", [SMALL, SHIPPED], ids=["small", "shipped"])
@pytest.mark.parametrize("batch", [1, 3])
@pytest.mark.parametrize("seed", range(3))
def test_spikes_in_8_bits_equal_those_of_float32_bit_for_bit(seed, batch, config):
    network = network_of(config, seed)
    engine, spikes = Engine(network), draw(config, batch, seed=seed)
    fired, after = engine.features(spikes, network.initial_state(batch))
    with plain():
        expected, expected_after = engine.features(spikes, network.initial_state(batch))
    assert torch.equal(fired, expected)
    assert 0 < fired.mean() < 1
    for one, other in zip(after, expected_after, strict=True):
        assert torch.equal(one.v, other.v)


@torch.no_grad()
def test_the_engine_answers_as_the_network_in_training_does():
    network, spikes = network_of(SHIPPED), draw(SHIPPED)
    answer, expected = (
        Engine(network)(spikes[:1], network.initial_state(1)),
        network(spikes[:1], network.initial_state(1)),
    )
    torch.testing.assert_close(answer[0], expected[0], rtol=1e-4, atol=1e-5)
    for one, other in zip(answer[1].membranes, expected[1].membranes, strict=True):
        assert ((one.v == 0) != (other.v == 0)).double().mean() < 5e-3


@pytest.mark.parametrize("steps", [1, 2, 5])
@pytest.mark.parametrize("seed", range(3))
def test_window_after_window_fires_and_projects_as_in_float32_bit_for_bit(seed, steps):
    """Calls of odd and even lengths with a continued state; the first input is zero, the third has maximal values."""
    engine, projection = Engine(network_of(SHIPPED, seed)), projection_of(64 * 5 * 6, 128, seed)
    states = [network_of(SHIPPED, seed).initial_state(2) for _ in range(2)]
    for turn in range(5):
        spikes = draw(SHIPPED, 2, steps, seed=turn) if turn else torch.zeros_like(draw(SHIPPED, 2, steps))
        if turn == 2:
            spikes = torch.full_like(spikes, 256.0).log()
        found, after = engine.features(spikes, states[0])
        rows = found.permute(0, 2, 3, 1).flatten(1).to(torch.uint8)
        currents, states[0] = projection(rows), engine(spikes, states[0])[1]
        with plain():
            expected, expected_after = engine.features(spikes, states[1])
            expected_currents, states[1] = projection(rows), engine(spikes, states[1])[1]
        assert torch.equal(found, expected)
        assert torch.equal(currents, expected_currents)
        for one, other in zip(after, expected_after, strict=True):
            assert torch.equal(one.v, other.v)
        for one, other in zip(states[0].cells, states[1].cells, strict=True):
            assert torch.equal(one.s, other.s)


def projection_of(inputs: int, features: int, seed: int = 0, *, q: torch.Tensor | None = None) -> Int8Projection:
    generator = torch.Generator().manual_seed(seed)
    if q is None:
        q = torch.randint(-127, 128, (features, inputs), generator=generator, dtype=torch.int8)
    step, factor, offset = torch.rand(3, features, generator=generator)
    return Int8Projection(Int8Layer(quantisation.Quantised(q, step), factor / 100, offset - 0.5))


@pytest.mark.parametrize("inputs", [1, 255, 256, 257, 700, 25_344])
@pytest.mark.parametrize("features", [1, 13, 64])
@pytest.mark.parametrize("share", [0, 0.15, 1], ids=["no spike", "spikes", "all fire"])
def test_the_projection_equals_float32_bit_for_bit(inputs, features, share):
    projection = projection_of(inputs, features, seed=inputs)
    for rows in (1, 3, 8):
        spikes = (torch.rand(rows, inputs, generator=torch.Generator().manual_seed(rows)) < share).to(torch.uint8)
        with plain():
            expected = projection(spikes)
        assert torch.equal(projection(spikes), expected)
        assert expected.shape == (rows, features)


@pytest.mark.parametrize("inputs", [1000, 132_104, 132_105], ids=["few", "largest below 2**24", "above"])
@pytest.mark.parametrize("sign", [-1, 1])
def test_the_largest_sums_of_a_projection_are_exact(inputs, sign):
    """All weights are maximal and every input fires: 16-bit sums of a block must not wrap, nor may float32 round."""
    projection = projection_of(inputs, 3, q=torch.full((3, inputs), sign * 127, dtype=torch.int8))
    at_zero = projection(torch.zeros(1, inputs, dtype=torch.uint8))  # the offset
    found = projection(torch.ones(2, inputs, dtype=torch.uint8))
    _, factor, _ = projection.layer
    assert torch.equal(found, (torch.full((2, 3), 127.0 * sign * inputs) * factor + at_zero))


@pytest.mark.parametrize("shape", [(5, 4, 3, 3), (5, 36)], ids=["convolution", "projection"])
def test_rounding_moves_weights_by_at_most_half_a_step_and_is_idempotent(shape):
    by_row = (-1, *[1] * (len(shape) - 1))
    weight = torch.randn(shape) * torch.tensor([1e-3, 1.0, 50.0, 0.0, 1.0]).view(by_row)
    rounded, step = quantisation.rounded(weight), quantisation.quantised(weight).step
    assert torch.all((rounded - weight).abs() <= 0.501 * step.view(by_row))
    assert torch.equal(quantisation.quantised(rounded).q, quantisation.quantised(weight).q)


@pytest.mark.parametrize("shape", [(5, 4, 3, 3), (5, 36)], ids=["convolution", "projection"])
def test_gradients_pass_through_the_rounding_unchanged(shape):
    weight = torch.randn(shape, requires_grad=True)
    pull = torch.randn(shape)
    quantisation.rounded(weight).backward(pull)
    torch.testing.assert_close(weight.grad, pull)


@torch.no_grad()
def test_training_uses_the_rounded_projection():
    """Weights moved by a third of a step are rounded back; a network without rounding answers differently."""
    for precision, moves in (("int8", False), ("float32", True)):
        config = SMALL.model_copy(update={"network": SMALL.network.model_copy(update={"precision": precision})})
        network, spikes = network_of(config), draw(config)
        weight = network.project.weight
        q, step = quantisation.quantised(weight)
        weight.copy_(q * step.view(-1, 1))
        before = network(spikes, network.initial_state(1))[0]
        weight.add_(step.view(-1, 1) / 3 * (q.abs() < 127))
        after = network(spikes, network.initial_state(1))[0]
        assert torch.allclose(after, before, rtol=1e-5, atol=1e-6) != moves


@pytest.mark.parametrize("encoding", ["binary", "log1p"])
def test_counts_become_the_codes_of_their_spikes_and_a_network_accepts_both(encoding):
    counts = torch.arange(256, dtype=torch.uint8).repeat(2, 16).reshape(1, 1, 4, 32, 64)[..., :14, :19].contiguous()
    found, spikes = to_codes(counts, encoding), to_spikes(counts, encoding)
    assert torch.equal(found, quantisation.codes(spikes))
    assert found.is_contiguous()
    engine = Engine(network_of(SMALL))
    state = network_of(SMALL).initial_state(1)
    assert torch.equal(engine(found, state)[0], engine(spikes, state)[0])


@pytest.mark.parametrize("top", [1, 255])
def test_the_largest_sums_are_exact(top):
    q = torch.full((4, 58 if top == 255 else 200, 3, 3), 127, dtype=torch.int8)
    x = torch.full((2, q.shape[1], 9, 7), top, dtype=torch.uint8).contiguous(memory_format=torch.channels_last)
    found = int8_convolution(q, top, 9, 7)(x)
    assert found[0, 0, 2, 2] == 9 * q.shape[1] * 127 * top
    assert torch.equal(found, plain_int8_convolution(q, top)(x))


@pytest.mark.parametrize("wrong", ["missing", "other sums"])
def test_without_fast_8_bit_products_the_plain_form_gives_the_same_with_one_warning(monkeypatch, caplog, wrong):
    spikes, network = draw(SMALL), network_of(SMALL)
    expected = Engine(network)(spikes, network.initial_state(1))[0]

    def broken(q, rows, columns):
        if wrong == "missing":
            raise AttributeError("no such operator")
        return lambda x: plain_int8_convolution(q, 255)(x) + 1

    forget_warnings()
    caplog.clear()  # a machine without 8-bit products has warned already
    monkeypatch.setattr(int8, "_prepacked", broken)
    with caplog.at_level(logging.WARNING):
        engine = Engine(network)
    assert torch.equal(engine(spikes, network.initial_state(1))[0], expected)
    assert ["form=8-bit convolution " in record.getMessage() for record in caplog.records] == [True]


def test_an_int8_bundle_is_saved_loaded_and_serves_a_stream(tmp_path):
    made = bundle.untrained(0, SMALL)
    bundle.save(made, tmp_path / "a.safetensors")
    loaded = bundle.load(tmp_path / "a.safetensors")
    assert loaded.config.network.precision == "int8"
    events = make_events(3_000, seed=0, duration_us=60_000)
    answers = []
    for one in (made, loaded):
        estimator = Estimator(one)
        answers.append(estimator.push(events, estimator.initial_state(SENSOR), 60_000).estimates)
    assert len(answers[0]) == 6
    assert [one.twists.tolist() for one in answers[0]] == [one.twists.tolist() for one in answers[1]]
