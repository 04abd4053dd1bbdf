"""Rounding of weights and input to 8 bits, for networks with precision int8 (decision 38)."""

from typing import NamedTuple

import torch
from torch import Tensor

from neurove_core.networks.tables import LEVELS, MAX_WEIGHT


class Quantised(NamedTuple):
    """Weights as integers with a step for each output channel."""

    q: Tensor  # int8: (C', C, 3, 3) of a convolution, (F, I) of the projection
    step: Tensor  # (C') float32, positive: weight = q * step


def quantised(weight: Tensor) -> Quantised:
    """Round weights to the nearest multiple of a step per output channel: its largest absolute weight / 127."""
    whole, step = _multiples(weight)
    return Quantised(whole.to(torch.int8), step)


def rounded(weight: Tensor) -> Tensor:
    """The values of `quantised` weights, in float32; gradients pass through unchanged (straight-through estimator)."""
    whole, step = _multiples(weight)
    return weight + whole.mul_(_by_output(step, weight)).sub_(weight.detach())  # in place: a projection may be large


def _multiples(weight: Tensor) -> tuple[Tensor, Tensor]:
    largest = torch.linalg.vector_norm(weight.detach().flatten(1), torch.inf, dim=1)
    step = torch.where(largest > 0, largest, torch.ones_like(largest)) / MAX_WEIGHT
    return weight.detach().div(_by_output(step, weight)).round_().clamp_(-MAX_WEIGHT, MAX_WEIGHT), step


def _by_output(step: Tensor, weight: Tensor) -> Tensor:
    return step.view(-1, *[1] * (weight.dim() - 1))


def rounded_input(spikes: Tensor) -> Tensor:
    """The input rounded to steps of 1 / LEVELS."""
    return codes(spikes).to(spikes.dtype) / LEVELS


def codes(spikes: Tensor) -> Tensor:
    """The input in steps of 1 / LEVELS, as uint8 in the same memory layout."""
    return (spikes * LEVELS).round_().clamp_(0, 255).to(torch.uint8)
