"""The compiled LIF scan equals the plain one: spikes and potentials bit for bit, gradients up to rounding."""

import pytest
import torch
from torch import Tensor

from neurove_core.spiking.lif import LIFParams, LIFState, lif_scan, lif_scan_reference
from neurove_core.spiking.plain import plain

STEPS, BATCH = 5, 2
MAP = (BATCH, 7, 11, 13)  # more than one block of neurons, and not a multiple of any vector width
LAYOUTS = ("contiguous", "channels_last", "strided")
PARAMS = LIFParams(decay=0.7, v_th=0.9, surrogate_width=0.45)


def make_currents(shape: tuple[int, ...] = MAP, dtype=torch.float32, seed: int = 0, layout: str = "contiguous"):
    generator = torch.Generator().manual_seed(seed)
    currents = torch.randn(STEPS, *shape, generator=generator, dtype=dtype) * 0.8 + 0.2
    state = torch.randn(*shape, generator=generator, dtype=dtype).clamp_max(0.8)
    return laid_out(currents, layout), state


def laid_out(currents: Tensor, layout: str) -> Tensor:
    if layout == "channels_last":
        flat = currents.flatten(0, 1).contiguous(memory_format=torch.channels_last)
        return flat.unflatten(0, currents.shape[:2])
    if layout == "strided":
        return torch.stack([currents, currents], dim=-1)[..., 0]
    return currents


def gradients(scan, currents: Tensor, v: Tensor, params: LIFParams) -> list[Tensor]:
    currents, v = currents.detach().requires_grad_(), v.detach().requires_grad_()
    spikes, state = scan(currents, LIFState(v), params)
    generator = torch.Generator().manual_seed(3)
    by_spikes = torch.randn(spikes.shape, generator=generator, dtype=spikes.dtype)
    by_state = torch.randn(state.v.shape, generator=generator, dtype=spikes.dtype)
    return list(torch.autograd.grad([spikes, state.v], [currents, v], [by_spikes, by_state]))


@pytest.mark.parametrize("layout", LAYOUTS)
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("seed", range(3))
@torch.no_grad()
def test_spikes_and_potentials_equal_the_plain_ones_bit_for_bit(seed, dtype, layout):
    currents, v = make_currents(dtype=dtype, seed=seed, layout=layout)
    spikes, state = lif_scan(currents, LIFState(v), PARAMS)
    expected, expected_state = lif_scan_reference(currents, LIFState(v), PARAMS)
    assert 0.05 < expected.mean() < 0.6
    assert torch.equal(spikes, expected)
    assert torch.equal(state.v, expected_state.v)


@pytest.mark.parametrize("shape", [(1, 1), (3, 5), (2, 1024), (1, 2049), (1, 1, 1, 1), (2, 3, 1, 1)])
@torch.no_grad()
def test_populations_of_any_shape_and_size_are_scanned_completely(shape):
    currents, v = make_currents(shape)
    spikes, state = lif_scan(currents, LIFState(v), PARAMS)
    expected, expected_state = lif_scan_reference(currents, LIFState(v), PARAMS)
    assert torch.equal(spikes, expected)
    assert torch.equal(state.v, expected_state.v)


@pytest.mark.parametrize("layout", LAYOUTS)
@pytest.mark.parametrize("surrogate", ["rectangular", "arctan", "triangle"])
def test_gradients_equal_those_of_autograd_through_plain_steps(surrogate, layout):
    currents, v = make_currents(dtype=torch.float64, layout=layout)
    params = PARAMS._replace(surrogate=surrogate)
    fused, expected = (gradients(scan, currents, v, params) for scan in (lif_scan, lif_scan_reference))
    for one, other in zip(fused, expected, strict=True):
        assert other.any()
        torch.testing.assert_close(one, other, rtol=0, atol=1e-9)


def test_the_gradient_passes_where_the_potential_is_within_half_a_width_of_the_threshold_and_not_beyond():
    params = LIFParams(decay=0.5, v_th=1.0, surrogate_width=0.5)
    potentials = torch.tensor([0.74, 0.75, 0.76, 1.0, 1.24, 1.25, 1.26], dtype=torch.float64)
    currents = potentials[None].requires_grad_()
    spikes, _ = lif_scan(currents, LIFState(torch.zeros_like(potentials)), params)
    spikes.sum().backward()
    assert currents.grad is not None
    assert currents.grad[0].tolist() == [0, 0, 2, 2, 2, 0, 0]


def test_a_gradient_of_only_one_output_is_accepted():
    currents, v = make_currents(dtype=torch.float64)
    for output in (0, 1):
        grads = []
        for scan in (lif_scan, lif_scan_reference):
            leaf = currents.clone().requires_grad_()
            spikes, state = scan(leaf, LIFState(v), PARAMS)
            (spikes, state.v)[output].sum().backward()
            grads.append(leaf.grad)
        torch.testing.assert_close(grads[0], grads[1], rtol=0, atol=1e-9)


@torch.no_grad()
def test_a_sequence_split_in_two_equals_the_whole_one():
    currents, v = make_currents(layout="channels_last")
    whole, last = lif_scan(currents, LIFState(v), PARAMS)
    first, between = lif_scan(currents[:2], LIFState(v), PARAMS)
    second, end = lif_scan(currents[2:], between, PARAMS)
    assert torch.equal(torch.cat([first, second]), whole)
    assert torch.equal(end.v, last.v)


@torch.no_grad()
def test_a_scan_changes_neither_its_currents_nor_the_state_it_receives():
    currents, v = make_currents()
    before = currents.clone(), v.clone()
    lif_scan(currents, LIFState(v), PARAMS)
    assert torch.equal(currents, before[0])
    assert torch.equal(v, before[1])


@pytest.mark.parametrize("value", [float("nan"), float("inf"), -float("inf")])
@torch.no_grad()
def test_a_number_that_is_not_finite_ends_in_the_state_as_it_does_in_plain_steps(value):
    currents, v = make_currents()
    currents[1, 0, 0, 0, 0] = value
    spikes, state = lif_scan(currents, LIFState(v), PARAMS)
    expected, expected_state = lif_scan_reference(currents, LIFState(v), PARAMS)
    assert torch.equal(spikes, expected)
    torch.testing.assert_close(state.v, expected_state.v, rtol=0, atol=0, equal_nan=True)
    assert not torch.isfinite(state.v).all()


@torch.no_grad()
def test_half_precision_and_a_broadcast_state_use_the_plain_path():
    currents, v = make_currents()
    for odd, state in ((currents.bfloat16(), v.bfloat16()), (currents, v[:1])):
        spikes, _ = lif_scan(odd, LIFState(state), PARAMS)
        assert torch.equal(spikes, lif_scan_reference(odd, LIFState(state), PARAMS)[0])


@pytest.mark.parametrize("surrogate", ["rectangular", "arctan", "triangle"])
def test_inside_plain_every_step_uses_autograd_and_outside_it_does_not(surrogate):
    currents, v = make_currents()
    currents.requires_grad_()

    def recorded() -> str:
        return type(lif_scan(currents, LIFState(v), PARAMS._replace(surrogate=surrogate))[0].grad_fn).__name__

    with plain():
        assert "Stack" in recorded()
    assert "Stack" not in recorded()


def test_half_precision_currents_of_autocast_are_scanned_in_float32_as_in_plain_steps():
    currents, v = make_currents()
    leaf = currents.bfloat16().requires_grad_()
    spikes, state = lif_scan(leaf, LIFState(v), PARAMS)
    expected, expected_state = lif_scan_reference(leaf, LIFState(v), PARAMS)
    assert "Stack" not in type(spikes.grad_fn).__name__
    assert torch.equal(spikes, expected)
    assert torch.equal(state.v, expected_state.v)
    spikes.sum().backward()
    assert leaf.grad is not None
    assert leaf.grad.dtype == torch.bfloat16
    assert leaf.grad.any()
