"""The loss of the paper, and the scaling between its parts."""

import pytest
import torch

from neurove_core.training.loss import Balance, group_loss, scaled_sum


def test_the_loss_of_a_group_is_half_the_mean_length_of_its_errors():
    error = torch.randn(7, 4, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    assert float(group_loss(error)) == pytest.approx(
        float((error @ error.mT).diagonal(dim1=-2, dim2=-1).sqrt().mean() / 2)
    )


def test_the_gradient_of_a_zero_error_is_zero():
    error = torch.zeros(2, 3, requires_grad=True)
    group_loss(error).backward()
    assert error.grad is not None
    assert (error.grad == 0).all()


@pytest.mark.parametrize("unit", [1.0, 1e-3, 1e3])
def test_the_scaled_sum_does_not_depend_on_the_unit_of_a_part(unit):
    linear, angular = torch.rand(2, 30, generator=torch.Generator().manual_seed(1))
    one, other = Balance.initial(), Balance.initial()
    for a, b in zip(linear, angular, strict=True):
        loss, one = scaled_sum(a, b, one, 0.9)
        same, other = scaled_sum(a, unit * b, other, 0.9)
        assert float(loss) == pytest.approx(float(same), rel=1e-4)


def test_both_parts_have_the_same_weight_at_any_size():
    linear, angular = torch.tensor(3.0, requires_grad=True), torch.tensor(0.02, requires_grad=True)
    loss, balance = scaled_sum(linear, angular, Balance.initial(), 0.99)
    loss.backward()
    assert loss.item() == pytest.approx(2)
    assert (linear.grad * linear).item() == pytest.approx((angular.grad * angular).item())
    assert not any(mean.requires_grad for mean in balance)


def test_the_means_follow_the_losses_slowly():
    balance = Balance.initial()
    for _ in range(200):
        _, balance = scaled_sum(torch.tensor(2.0), torch.tensor(1.0), balance, 0.99)
    loss, _ = scaled_sum(torch.tensor(1.0), torch.tensor(1.0), balance, 0.99)
    assert float(loss) == pytest.approx(1.5, abs=0.01)
