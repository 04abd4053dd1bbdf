"""spike: a step in the forward pass, the surrogate in the backward pass."""

import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from neurove_core.spiking.surrogate import spike, surrogate_gradient

KINDS = ("rectangular", "arctan", "triangle")
each_kind = pytest.mark.parametrize("kind", KINDS)
each_width = pytest.mark.parametrize("width", [0.25, 1.0, 3.0])


@given(u=st.lists(st.floats(allow_nan=False, width=32), min_size=1), kind=st.sampled_from(KINDS))
def test_a_spike_is_one_from_the_threshold_on_and_zero_below_it(u, kind):
    assert spike(torch.tensor(u), kind).tolist() == [1.0 if value >= 0 else 0.0 for value in u]


@each_kind
@each_width
def test_the_surrogate_has_area_one_over_u(kind, width):
    s = torch.linspace(-math.pi / 2, math.pi / 2, 400_003, dtype=torch.float64)[1:-1]
    u = width * torch.tan(s)  # wide enough for the tails of arctan
    area = torch.trapezoid(surrogate_gradient(u, kind, width) * width / torch.cos(s).square(), s)
    assert area.item() == pytest.approx(1, abs=1e-4)


@each_kind
@each_width
def test_the_surrogate_is_even_positive_at_the_threshold_and_falls_away_from_it(kind, width):
    u = torch.linspace(0, 3 * width, 500, dtype=torch.float64)
    right, left = surrogate_gradient(u, kind, width), surrogate_gradient(-u, kind, width)
    assert torch.equal(right, left)
    assert right[0].item() == pytest.approx(1 / width)
    assert (right.diff() <= 0).all()


@each_kind
@each_width
def test_the_gradient_of_a_spike_is_the_surrogate_times_the_incoming_gradient(kind, width):
    u = torch.linspace(-2, 2, 81, dtype=torch.float64).requires_grad_()
    above = torch.linspace(-1, 3, 81, dtype=torch.float64)
    (gradient,) = torch.autograd.grad(spike(u, kind, width), u, above)
    torch.testing.assert_close(gradient, above * surrogate_gradient(u.detach(), kind, width))
    assert gradient.any()


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_a_spike_has_the_precision_of_its_input(dtype):
    assert spike(torch.zeros(2, dtype=dtype)).dtype == dtype
