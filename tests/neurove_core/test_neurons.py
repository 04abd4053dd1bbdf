"""LIF and ALIF against their closed forms."""

import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor

from neurove_core.neurons import ALIFParams, LIFParams, LIFState, alif_step, diffuse, lif_scan, lif_step
from neurove_core.surrogate import surrogate_gradient

LIF = LIFParams(decay=0.9, v_th=1.0)


def at_rest(*shape: int) -> LIFState:
    return LIFState(torch.zeros(*shape, dtype=torch.float64))


def random_currents(seed: int, steps: int = 50, low: float = -0.5, high: float = 1.5) -> Tensor:
    generator = torch.Generator().manual_seed(seed)
    return low + (high - low) * torch.rand(steps, 3, 4, generator=generator, dtype=torch.float64)


@pytest.mark.parametrize("decay", [0.0, 0.5, 0.9])
def test_a_silent_population_leaks_geometrically(decay):
    state = LIFState(torch.full((1, 4), 0.8, dtype=torch.float64))
    for _ in range(10):
        spikes, state = lif_step(torch.zeros(1, 4, dtype=torch.float64), state, LIFParams(decay=decay))
        assert not spikes.any()
    torch.testing.assert_close(state.v, torch.full((1, 4), 0.8 * decay**10, dtype=torch.float64))


@given(current=st.floats(0.11, 2.0), decay=st.floats(0.0, 0.95))
def test_a_constant_current_fires_first_when_its_geometric_sum_reaches_the_threshold(current, decay):
    steps = 60
    spikes, _ = lif_scan(torch.full((steps, 1), current, dtype=torch.float64), at_rest(1), LIFParams(decay=decay))
    v = current * (1 - decay ** torch.arange(1, steps + 1, dtype=torch.float64)) / (1 - decay)
    if (v - 1).abs().min() < 1e-9:
        return  # too near the threshold for the sum and the recursion to round alike
    fired = (v >= 1).nonzero()
    if not len(fired):
        assert not spikes.any()
        return
    period = int(fired[0]) + 1
    assert spikes.flatten().nonzero().flatten().tolist() == list(range(period - 1, steps, period))


@pytest.mark.parametrize("overshoot", [0.0, 0.3, 100.0])
def test_a_neuron_that_fires_is_reset_to_zero_however_far_above_the_threshold_it_was(overshoot):
    current = torch.tensor([[1 + overshoot, 0.999]], dtype=torch.float64)
    spikes, state = lif_step(current, at_rest(1, 2), LIF)
    assert spikes.tolist() == [[1.0, 0.0]]
    assert state.v.tolist() == [[0.0, 0.999]]


@given(v_th=st.floats(0.1, 5.0), seed=st.integers(0, 1_000))
def test_the_threshold_is_the_unit_of_all_potentials(v_th, seed):
    currents = random_currents(seed)
    unit, state = lif_scan(currents, at_rest(3, 4), LIFParams(decay=0.5, v_th=1.0))
    scaled, scaled_state = lif_scan(v_th * currents, at_rest(3, 4), LIFParams(decay=0.5, v_th=v_th))
    assert torch.equal(scaled, unit)
    torch.testing.assert_close(scaled_state.v, v_th * state.v)


@pytest.mark.parametrize("seed", range(5))
def test_a_scan_equals_its_steps_and_may_be_cut_anywhere(seed):
    currents = random_currents(seed)
    whole, last = lif_scan(currents, at_rest(3, 4), LIF)
    state, steps = at_rest(3, 4), []
    for current in currents:
        spikes, state = lif_step(current, state, LIF)
        steps.append(spikes)
    first, middle = lif_scan(currents[:17], at_rest(3, 4), LIF)
    second, end = lif_scan(currents[17:], middle, LIF)
    assert 0 < whole.mean() < 1
    assert torch.equal(torch.stack(steps), whole)
    assert torch.equal(torch.cat((first, second)), whole)
    assert torch.equal(state.v, last.v)
    assert torch.equal(end.v, last.v)


def test_the_gradient_goes_through_the_leak_and_the_surrogate_but_not_through_the_reset():
    current = torch.tensor([0.2, 0.9, 1.2], dtype=torch.float64, requires_grad=True)
    spikes, state = lif_step(current, at_rest(3), LIF)
    (by_state,) = torch.autograd.grad(state.v.sum(), current, retain_graph=True)
    (by_spikes,) = torch.autograd.grad(spikes.sum(), current)
    assert by_state.tolist() == [1.0, 1.0, 0.0]  # a cut reset: 1 where it stayed, 0 where it fired, nothing of spike
    torch.testing.assert_close(by_spikes, surrogate_gradient(current.detach() - LIF.v_th, "rectangular", 1.0))


def run_alif(spikes: Tensor, v: Tensor, params: ALIFParams) -> Tensor:
    """Spikes of a population behind another one, f the identity."""
    state, out = at_rest(*spikes.shape[1:]), []
    for x, v_before in zip(spikes, v, strict=True):
        fired, state = alif_step(x, v_before, state, params, lambda z: 0.4 * z)
        out.append(fired)
    return torch.stack(out)


@pytest.mark.parametrize("seed", range(5))
def test_alif_without_diffusion_is_lif(seed):
    spikes, v = random_currents(seed).round().clamp(0, 1), random_currents(seed + 100)
    alif = run_alif(spikes, v, ALIFParams(LIF, d_space=0.0, d_time=0.0))
    lif, _ = lif_scan(0.4 * spikes, at_rest(3, 4), LIF)
    assert lif.any()
    assert torch.equal(alif, lif)


@given(seed=st.integers(0, 10_000), d_space=st.floats(0.0, 1.0), d_time=st.floats(0.0, 0.5))
def test_diffusion_of_positive_potentials_never_makes_a_neuron_fire_later_or_less(seed, d_space, d_time):
    spikes, v = random_currents(seed).round().clamp(0, 1), random_currents(seed + 1, low=0.0, high=1.0)
    without = run_alif(spikes, v, ALIFParams(LIF, 0.0)).cumsum(0)
    with_diffusion = run_alif(spikes, v, ALIFParams(LIF, d_space, d_time)).cumsum(0)
    assert (with_diffusion >= without).all()


def test_a_potential_below_the_threshold_reaches_the_next_layer_only_by_diffusion():
    silent, v = torch.zeros(30, 1, 2, dtype=torch.float64), torch.full((30, 1, 2), 0.9, dtype=torch.float64)
    assert not run_alif(silent, v, ALIFParams(LIF, d_space=0.0)).any()
    assert run_alif(silent, v, ALIFParams(LIF, d_space=0.5)).any()


def test_each_neuron_may_have_its_own_diffusion_and_f_sees_the_sum():
    spikes, v = torch.tensor([[1.0, 0.0]]), torch.tensor([[0.5, 0.8]])
    d = torch.tensor([0.1, 0.25])
    torch.testing.assert_close(diffuse(spikes, v, d), torch.tensor([[1.05, 0.2]]))
    weight = torch.tensor([[1.0, 2.0], [0.5, -1.0], [0.0, 0.3]])
    params = ALIFParams(LIF, d_space=d, d_time=torch.tensor([0.1, 0.2, 0.3]))
    _, state = alif_step(spikes, v, LIFState(torch.tensor([[0.1, 0.2, 0.3]])), params, lambda z: z @ weight.T)
    by_hand = [0.9 * 0.1 + 1.05 + 0.4 + 0.01, 0.9 * 0.2 + 0.525 - 0.2 + 0.04, 0.9 * 0.3 + 0.06 + 0.09]
    assert by_hand[0] >= 1  # fires, and is reset
    torch.testing.assert_close(state.v, torch.tensor([[0.0, *by_hand[1:]]]))


def test_diffusion_in_time_is_a_slower_leak():
    state = LIFState(torch.full((1, 1), 0.8, dtype=torch.float64))
    silent = torch.zeros(1, 1, dtype=torch.float64)
    for _ in range(6):
        _, state = alif_step(silent, silent, state, ALIFParams(LIFParams(decay=0.5), 0.3, d_time=0.2), lambda z: z)
    assert state.v.item() == pytest.approx(0.8 * math.pow(0.7, 6))
