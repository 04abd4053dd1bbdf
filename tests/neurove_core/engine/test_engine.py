"""The engine equals its plain form, and it equals the network up to the rounding of the folded norms."""

import logging
from itertools import chain

import pytest
import torch
from torch import Tensor

from neurove_core.config import CanonicalConfig, ModelConfig, NetworkConfig, WindowConfig
from neurove_core.engine.engine import Engine
from neurove_core.engine.fallback import forget_warnings
from neurove_core.models import bundle
from neurove_core.networks.neurove import NetworkState, NeuroVE
from neurove_core.spiking.plain import plain

STEPS = 6
SMALL = ModelConfig(
    window=WindowConfig(duration_us=10_000, bins=2),
    canonical=CanonicalConfig(width=19, height=14),
    network=NetworkConfig(channels=(6, 8), features=13, hidden=11, cells=3, v_th=0.4),
)
SHIPPED = ModelConfig(network=NetworkConfig(v_th=0.4))
INT8 = SMALL.model_copy(update={"network": SMALL.network.model_copy(update={"precision": "int8"})})
each_shape = pytest.mark.parametrize("config", [SMALL, SHIPPED, INT8], ids=["small", "shipped", "int8"])


def make_network(config: ModelConfig, seed: int = 0) -> NeuroVE:
    return bundle.untrained(seed, config).network.requires_grad_(requires_grad=False)


def make_spikes(config: ModelConfig, batch: int = 1, steps: int = STEPS, seed: int = 1) -> Tensor:
    shape = (steps, batch, 2 * config.window.bins, config.canonical.height, config.canonical.width)
    return torch.poisson(torch.full(shape, 0.4), generator=torch.Generator().manual_seed(seed)).log1p()


def tensors_of(state: NetworkState) -> list[Tensor]:
    return [*chain(*state.membranes, *state.cells), state.readout]


def assert_fire_alike(state: NetworkState, expected: NetworkState) -> None:
    """Membranes and spikes of the cells are equal bit for bit; other cell values up to the rounding of long sums."""
    for membrane, other in zip(state.membranes, expected.membranes, strict=True):
        assert torch.equal(membrane.v, other.v)
        assert 0 < (other.v == 0).double().mean() < 1
    for cell, other_cell in zip(state.cells, expected.cells, strict=True):
        assert torch.equal(cell.s, other_cell.s)
    for one, other_one in zip(tensors_of(state), tensors_of(expected), strict=True):
        torch.testing.assert_close(one, other_one, rtol=1e-4, atol=1e-5)


@each_shape
@pytest.mark.parametrize("batch", [1, 3])
@pytest.mark.parametrize("seed", range(3))
def test_spikes_of_the_engine_and_of_its_plain_form_are_equal_bit_for_bit(seed, batch, config):
    engine, spikes = Engine(make_network(config, seed)), make_spikes(config, batch, seed=seed)
    start = make_network(config, seed).initial_state(batch)
    twists, state = engine(spikes, start)
    with plain():
        expected, expected_state = engine(spikes, start)
    assert_fire_alike(state, expected_state)
    torch.testing.assert_close(twists, expected, rtol=1e-4, atol=1e-5)


@each_shape
@torch.no_grad()
def test_folding_the_norms_changes_answers_by_rounding_only_and_few_spikes(config):
    network, spikes = make_network(config), make_spikes(config, batch=2)
    twists, state = Engine(network)(spikes, network.initial_state(2))
    expected, expected_state = network(spikes, network.initial_state(2))
    for membrane, other in zip(state.membranes, expected_state.membranes, strict=True):
        assert ((membrane.v == 0) != (other.v == 0)).double().mean() < 5e-3  # one spike that flips changes others
    torch.testing.assert_close(twists[0], expected[0], rtol=1e-4, atol=1e-5)  # later ones depend on the spikes above


@torch.no_grad()
def test_a_stream_may_switch_between_network_and_engine():
    network, spikes = make_network(SHIPPED), make_spikes(SHIPPED)
    engine = Engine(network)
    whole, last = engine(spikes, network.initial_state(1))
    answers, state = [], network.initial_state(1)
    for index, window in enumerate(spikes):
        twists, state = (network, engine)[index % 2](window[None], state)
        answers.append(twists)
    torch.testing.assert_close(torch.cat(answers), whole, rtol=1e-3, atol=1e-4)
    for one, other in zip(tensors_of(state), tensors_of(last), strict=True):
        assert one.shape == other.shape
        torch.testing.assert_close(one, other, rtol=1e-3, atol=1e-4)


@each_shape
def test_window_by_window_equals_the_whole_sequence(config):
    network, spikes = make_network(config), make_spikes(config, batch=2)
    engine = Engine(network)
    whole, last = engine(spikes, network.initial_state(2))
    answers, state = [], network.initial_state(2)
    for window in spikes:
        twists, state = engine(window[None], state)
        answers.append(twists)
    torch.testing.assert_close(torch.cat(answers), whole, rtol=1e-4, atol=1e-5)
    for one, other in zip(tensors_of(state), tensors_of(last), strict=True):
        torch.testing.assert_close(one, other, rtol=1e-4, atol=1e-5)


@each_shape
@torch.no_grad()
def test_a_spread_is_the_same_in_engine_plain_form_and_network_and_changes_no_answer(config):
    network, spikes = make_network(config), make_spikes(config, batch=2)
    without, _ = Engine(network)(spikes, network.initial_state(2))
    torch.nn.init.normal_(network.add_spread().weight, generator=torch.Generator().manual_seed(5))
    engine, start = Engine(network), network.initial_state(2)
    twists, state = engine(spikes, start)
    with plain():
        _, plain_state = engine(spikes, start)
    found = network.log_sigma(state)
    assert found.shape == (2, 6)
    assert found.abs().max() > 0
    torch.testing.assert_close(twists, without)
    torch.testing.assert_close(found, network.log_sigma(plain_state), rtol=1e-4, atol=1e-5)
    first = [network.log_sigma(one(spikes[:1], start)[1]) for one in (engine, network)]
    torch.testing.assert_close(*first, rtol=1e-4, atol=1e-5)


def test_the_layout_of_the_input_does_not_matter():
    network, spikes = make_network(SMALL), make_spikes(SMALL)
    engine = Engine(network)
    expected, _ = engine(spikes, network.initial_state(1))
    laid_out = spikes.movedim(2, -1).contiguous().movedim(-1, 2)
    assert torch.equal(engine(laid_out, network.initial_state(1))[0], expected)


def test_an_engine_changes_neither_its_input_nor_the_state_it_receives():
    network, spikes = make_network(SMALL), make_spikes(SMALL)
    engine = Engine(network)
    _, given = engine(spikes[:3], network.initial_state(1))
    before = [tensor.clone() for tensor in (*tensors_of(given), spikes)]
    once, again = engine(spikes[3:], given)[0], engine(spikes[3:], given)[0]
    assert torch.equal(once, again)
    assert all(torch.equal(a, b) for a, b in zip((*tensors_of(given), spikes), before, strict=True))


def test_an_engine_copies_its_weights_and_ignores_later_changes_of_the_network():
    network, spikes = make_network(SMALL), make_spikes(SMALL)
    engine = Engine(network)
    expected, _ = engine(spikes, network.initial_state(1))
    for tensor in network.state_dict().values():
        tensor.zero_()
    assert torch.equal(engine(spikes, network.initial_state(1))[0], expected)


def test_a_membrane_that_is_not_finite_stays_in_the_state_so_that_a_check_finds_it():
    network = make_network(SMALL)
    spikes = make_spikes(SMALL)
    spikes[0, 0, 0, 0, 0] = float("nan")
    assert not Engine(network)(spikes, network.initial_state(1))[1].finite()


@pytest.mark.parametrize("broken", ["missing", "raises", "wrong"])
def test_where_the_prepacked_convolution_fails_the_plain_one_is_used_with_one_warning(broken, monkeypatch, caplog):
    operators = torch.ops.mkldnn
    network, spikes = make_network(SMALL), make_spikes(SMALL)
    expected, _ = Engine(network)(spikes, network.initial_state(1))

    class Broken:
        @staticmethod
        def default(x, weight, bias, *_):
            if broken == "raises":
                raise RuntimeError("no such primitive")
            return torch.nn.functional.conv2d(x, weight.to_dense(), bias, stride=2, padding=1) + 0.1

    class Operators:
        _reorder_convolution_weight = operators._reorder_convolution_weight

    if broken != "missing":
        Operators._convolution_pointwise = Broken
    forget_warnings()
    monkeypatch.setattr(torch.ops, "mkldnn", Operators)
    with caplog.at_level(logging.WARNING):
        engine = Engine(network)
    twists, _ = engine(spikes, network.initial_state(1))
    torch.testing.assert_close(twists, expected, rtol=1e-3, atol=1e-4)
    assert len(caplog.records) == 1
    assert "form=prepacked convolution" in caplog.text


def test_a_state_from_training_with_a_gradient_is_accepted():
    network, spikes = make_network(SMALL).requires_grad_(), make_spikes(SMALL)
    _, given = network(spikes[:2], network.initial_state(1))
    assert given.membranes[0].v.requires_grad
    twists, state = Engine(network)(spikes[2:], given)
    assert torch.isfinite(twists).all()
    assert state.finite()
