"""Cells and output neurons in one compiled pass equal plain steps: values bit for bit, gradients up to rounding."""

import pytest
import torch
from torch import Tensor

from neurove_core.spiking.aslstm import ASLSTM, ASLSTMState
from neurove_core.spiking.plain import plain
from neurove_core.spiking.readout import Readout

STEPS, BATCH, INPUTS, HIDDEN = 6, 3, 5, 7


def numbers(*shape: int, seed: int, dtype=torch.float64) -> Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64).to(dtype)


def layer_of(dtype=torch.float64, **how) -> ASLSTM:
    torch.manual_seed(1)
    layer = ASLSTM(INPUTS, HIDDEN, **{"v_th": 0.3, "surrogate_width": 0.4} | how).to(dtype)
    with torch.no_grad():
        for weight in layer.parameters():
            weight.mul_(2)  # so that cells fire
    return layer


def inputs_of(dtype=torch.float64) -> list[Tensor]:
    """Input, and c, v and s of a state in which some cells have fired."""
    x, c, v = (
        numbers(*shape, seed=seed, dtype=dtype)
        for seed, shape in enumerate(((STEPS, BATCH, INPUTS), (BATCH, HIDDEN), (BATCH, HIDDEN)))
    )
    return [x.requires_grad_(), c.requires_grad_(), v.requires_grad_(), (v > 0).to(dtype)]


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("hidden", [16, 48])
def test_states_of_the_compiled_pass_equal_plain_steps_bit_for_bit(dtype, hidden):
    torch.manual_seed(2)
    layer = ASLSTM(INPUTS, hidden, v_th=0.2).to(dtype)
    x, start = numbers(STEPS, BATCH, INPUTS, seed=3, dtype=dtype), layer.initial_state(BATCH)
    steps, last = layer(x, start)
    with plain():
        expected, expected_last = layer(x, start)
    assert "Layer" in type(steps.v.grad_fn).__name__
    assert 0.02 < expected.s.mean() < 0.9
    for one, other in zip((*steps, *last), (*expected, *expected_last), strict=True):
        assert torch.equal(one, other)


@pytest.mark.parametrize("hidden", [1, 7, 33])
def test_states_of_any_width_equal_plain_steps_up_to_rounding(hidden):
    torch.manual_seed(2)
    layer = ASLSTM(INPUTS, hidden, v_th=0.2).double()
    x, start = numbers(STEPS, BATCH, INPUTS, seed=3), layer.initial_state(BATCH)
    steps, _ = layer(x, start)
    with plain():
        expected, _ = layer(x, start)
    for one, other in zip(steps, expected, strict=True):
        torch.testing.assert_close(one, other, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("how", [{}, {"surrogate": "arctan"}, {"surrogate": "triangle"}, {"diffusion": False}])
def test_gradients_of_a_layer_equal_those_through_plain_steps(how):
    layer, (x, c, v, s) = layer_of(**how), inputs_of()
    leaves = [x, c, v, *layer.parameters()]
    pulls = [numbers(STEPS, BATCH, HIDDEN, seed=seed) for seed in range(10, 13)]
    ends = [numbers(BATCH, HIDDEN, seed=seed) for seed in range(13, 16)]

    def gradients() -> list[Tensor]:
        steps, last = layer(x, ASLSTMState(c, v, s))
        return list(torch.autograd.grad([*steps, *last], leaves, [*pulls, *ends]))

    found = gradients()
    with plain():
        expected = gradients()
    for one, other in zip(found, expected, strict=True):
        assert other.any()
        torch.testing.assert_close(one, other, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("field", range(3))
def test_a_gradient_of_only_one_part_of_the_states_is_accepted(field):
    layer, (x, c, v, s) = layer_of(), inputs_of()

    def gradient() -> Tensor:
        steps, _ = layer(x, ASLSTMState(c, v, s))
        return torch.autograd.grad(steps[field].square().sum(), x)[0]

    found = gradient()
    with plain():
        torch.testing.assert_close(found, gradient(), rtol=1e-9, atol=1e-9)


def test_potentials_of_the_output_neurons_equal_plain_steps_and_so_do_their_gradients():
    torch.manual_seed(4)
    readout = Readout(HIDDEN, 4).double()
    z, y = numbers(STEPS, BATCH, HIDDEN, seed=5).requires_grad_(), numbers(BATCH, 4, seed=6).requires_grad_()
    leaves, pulls = [z, y, *readout.parameters()], (numbers(STEPS, BATCH, 4, seed=7), numbers(BATCH, 4, seed=8))
    found = readout(z, y)
    with plain():
        expected = readout(z, y)
    assert "LeakySums" in type(found[0].grad_fn).__name__
    for one, other in zip(found, expected, strict=True):
        assert torch.equal(one, other)
    for one, other in zip(
        torch.autograd.grad(found, leaves, pulls), torch.autograd.grad(expected, leaves, pulls), strict=True
    ):
        torch.testing.assert_close(one, other, rtol=1e-9, atol=1e-9)


def test_under_autocast_and_without_gradients_the_steps_are_plain():
    layer, x = layer_of(torch.float32), numbers(STEPS, BATCH, INPUTS, seed=3, dtype=torch.float32)
    start = layer.initial_state(BATCH)
    with torch.autocast("cpu", torch.bfloat16):
        steps, _ = layer(x, start)
    assert "Stack" in type(steps.v.grad_fn).__name__
    with torch.no_grad():
        assert layer(x, start)[0].v.grad_fn is None
