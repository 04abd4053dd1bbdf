"""NeuroVE: state continues between calls, streams are independent, and every parameter learns."""

from itertools import chain

import pytest
import torch
from torch import Tensor

from neurove_core.config import CanonicalConfig, ModelConfig, NetworkConfig, WindowConfig
from neurove_core.models import bundle
from neurove_core.networks.neurove import NetworkState, NeuroVE

STEPS, BATCH = 6, 3
each_form = pytest.mark.parametrize("diffusion", [True, False], ids=["neurove", "without_diffusion"])


def make_config(width: int = 19, height: int = 14, diffusion: bool = True, **network) -> ModelConfig:
    options = {"channels": (6, 8), "features": 12, "hidden": 10, "v_th": 0.5, "diffusion": diffusion, **network}
    return ModelConfig(
        window=WindowConfig(duration_us=10_000, bins=2),
        canonical=CanonicalConfig(width=width, height=height),
        network=NetworkConfig(**options),
    )


def make_network(config: ModelConfig, seed: int = 0) -> NeuroVE:
    """A network in evaluation mode and float64, with adapted norms, so that its neurons fire."""
    return bundle.untrained(seed, config).network.double()


def make_spikes(config: ModelConfig, steps: int = STEPS, batch: int = BATCH, seed: int = 1) -> Tensor:
    generator = torch.Generator().manual_seed(seed)
    shape = (steps, batch, 2 * config.window.bins, config.canonical.height, config.canonical.width)
    return torch.poisson(torch.full(shape, 0.4, dtype=torch.float64), generator=generator).log1p()


def tensors_of(state: NetworkState) -> list[Tensor]:
    return [*chain(*state.membranes, *state.cells), state.readout]


def row_of(state: NetworkState, row: int) -> list[Tensor]:
    return [tensor[row] for tensor in tensors_of(state)]


def step_by_step(network: NeuroVE, spikes: Tensor, state: NetworkState) -> tuple[Tensor, NetworkState]:
    answers = []
    for window in spikes:
        twists, state = network(window[None], state)
        answers.append(twists)
    return torch.cat(answers), state


@each_form
@pytest.mark.parametrize("seed", range(3))
@torch.no_grad()
def test_window_by_window_equals_the_whole_sequence(seed, diffusion):
    config = make_config(diffusion=diffusion)
    network, spikes = make_network(config, seed), make_spikes(config)
    whole, last = network(spikes, network.initial_state(BATCH))
    single, end = step_by_step(network, spikes, network.initial_state(BATCH))
    torch.testing.assert_close(single, whole, rtol=0, atol=1e-9)
    for cell, other_cell in zip(end.cells, last.cells, strict=True):
        assert torch.equal(cell.s, other_cell.s)
    for membrane, other_membrane in zip(end.membranes, last.membranes, strict=True):
        fired = membrane.v == 0  # just reset
        assert torch.equal(fired, other_membrane.v == 0)
        assert 0 < fired.double().mean() < 1
    for one, other in zip(tensors_of(end), tensors_of(last), strict=True):
        torch.testing.assert_close(one, other, rtol=0, atol=1e-9)


@each_form
@torch.no_grad()
def test_streams_in_a_batch_do_not_leak_into_each_other(diffusion):
    config = make_config(diffusion=diffusion)
    network, spikes = make_network(config), make_spikes(config)
    together, last = network(spikes, network.initial_state(BATCH))
    for row in range(BATCH):
        disturbed = 3 * make_spikes(config, seed=9)
        disturbed[:, row] = spikes[:, row]
        twists, state = network(disturbed, network.initial_state(BATCH))
        torch.testing.assert_close(twists[:, row], together[:, row], rtol=0, atol=1e-12)
        for one, other in zip(row_of(state, row), row_of(last, row), strict=True):
            torch.testing.assert_close(one, other, rtol=0, atol=1e-12)
        alone, _ = network(spikes[:, row : row + 1], network.initial_state(1))
        torch.testing.assert_close(alone[:, 0], together[:, row], rtol=0, atol=1e-9)


@pytest.mark.parametrize("part", ["membranes", "cells", "readout"])
@torch.no_grad()
def test_every_part_of_the_state_affects_the_next_answer(part):
    config = make_config()
    network, spikes = make_network(config), make_spikes(config, steps=2)
    rest = network.initial_state(BATCH)
    _, carried = network(spikes[:1], rest)
    with_state, _ = network(spikes[1:], carried)
    partly_fresh, _ = network(spikes[1:], carried._replace(**{part: getattr(rest, part)}))
    assert (with_state - partly_fresh).abs().max() > 1e-4


@torch.no_grad()
def test_a_call_changes_neither_the_state_it_receives_nor_the_network():
    config = make_config()
    network, spikes = make_network(config), make_spikes(config)
    _, carried = network(spikes[:3], network.initial_state(BATCH))
    before, weights = [t.clone() for t in tensors_of(carried)], [t.clone() for t in network.state_dict().values()]
    once, again = network(spikes[3:], carried)[0], network(spikes[3:], carried)[0]
    assert torch.equal(once, again)
    assert all(torch.equal(a, b) for a, b in zip(tensors_of(carried), before, strict=True))
    assert all(torch.equal(a, b) for a, b in zip(network.state_dict().values(), weights, strict=True))


@each_form
@pytest.mark.parametrize("surrogate", ["rectangular", "arctan", "triangle"])
def test_every_parameter_gets_a_finite_gradient_when_training_on_log_counts(surrogate, diffusion):
    config = make_config(diffusion=diffusion, surrogate=surrogate)
    network = make_network(config).train().float()
    twists, _ = network(make_spikes(config).float(), network.initial_state(BATCH))
    twists.square().sum().backward()
    for name, parameter in network.named_parameters():
        assert parameter.grad is not None, name
        assert torch.isfinite(parameter.grad).all(), name
        assert parameter.grad.any(), name


def test_the_gradient_flows_back_through_windows_and_every_part_of_the_state():
    config = make_config()
    network, spikes = make_network(config), make_spikes(config).requires_grad_()
    _, carried = network(spikes[:3], network.initial_state(BATCH))
    twists, _ = network(spikes[3:], carried)
    by_spikes, by_readout, *by_state = torch.autograd.grad(
        twists[-1].sum(),
        [spikes, carried.readout, *(m.v for m in carried.membranes), *(t for c in carried.cells for t in (c.c, c.v))],
    )
    assert by_spikes[0].any()
    assert by_readout.any()
    assert all(gradient.any() for gradient in by_state)


def test_without_diffusion_there_are_no_diffusion_parameters_and_all_others_stay():
    network, without = NeuroVE(make_config()), NeuroVE(make_config(diffusion=False))
    diffusion = {"d_space", "cells.0.d_time", "cells.1.d_time"}
    assert network.state_dict().keys() - without.state_dict().keys() == diffusion
    assert without.state_dict().keys() < network.state_dict().keys()
    assert dict(network.named_parameters()).keys() - dict(without.named_parameters()).keys() == diffusion


@torch.no_grad()
def test_without_diffusion_answers_equal_those_with_zero_diffusion():
    network, without = make_network(make_config()), make_network(make_config(diffusion=False))
    without.load_state_dict(network.state_dict(), strict=False)
    spikes = make_spikes(make_config())
    with_diffusion, _ = network(spikes, network.initial_state(BATCH))
    for name, parameter in network.named_parameters():
        if "d_" in name:
            parameter.zero_()
    zeroed, _ = network(spikes, network.initial_state(BATCH))
    plain, _ = without(spikes, without.initial_state(BATCH))
    assert torch.equal(plain, zeroed)
    assert not torch.allclose(plain, with_diffusion)


@pytest.mark.parametrize(("width", "height"), [(8, 8), (9, 8), (13, 17), (31, 10), (86, 65)])
@pytest.mark.parametrize("channels", [(2,), (3, 2, 4), (2, 2, 2, 2, 2)])
@torch.no_grad()
def test_map_sizes_are_those_of_the_real_maps_for_odd_and_even_grids(width, height, channels):
    config = make_config(width, height, channels=channels)
    network = NeuroVE(config).eval().double()
    _, state = network(make_spikes(config, steps=1, batch=1), network.initial_state(1))
    assert network.map_sizes() == [tuple(membrane.v.shape[-2:]) for membrane in state.membranes]
    assert [t.shape for t in tensors_of(state)] == [t.shape for t in tensors_of(network.initial_state(1))]


@torch.no_grad()
def test_the_readout_is_split_into_bins_and_axes_in_order():
    config = make_config()
    network, spikes = make_network(config), make_spikes(config)
    twists, state = network(spikes, network.initial_state(BATCH))
    assert twists.shape == (STEPS, BATCH, config.window.bins, 6)
    assert torch.equal(twists[-1].flatten(1), state.readout)


@pytest.mark.parametrize("value", [float("nan"), float("inf"), -float("inf")])
def test_a_state_is_finite_only_if_every_number_is(value):
    network = NeuroVE(make_config())
    assert network.initial_state(2).finite()
    for number in range(len(tensors_of(network.initial_state(2)))):
        state = network.initial_state(2)
        broken = [tensor.clone() for tensor in tensors_of(state)]
        broken[number][(-1,) * broken[number].dim()] = value
        membranes = tuple(type(m)(broken[i]) for i, m in enumerate(state.membranes))
        cells = tuple(type(c)(*broken[2 + 3 * i : 5 + 3 * i]) for i, c in enumerate(state.cells))
        assert not NetworkState(membranes, cells, broken[-1]).finite()
