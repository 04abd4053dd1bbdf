"""Rounding of weights and input to 8 bits, for networks whose bundle asks for int8 (decision 38)."""

from typing import Final, NamedTuple

import torch
from torch import Tensor

LEVELS: Final = 32
"""Of the input per unit; log1p of a saturated count, 5.5, becomes 177."""


MAX_WEIGHT: Final = 127  # of a weight


class Quantised(NamedTuple):
    """Weights as whole numbers."""

    q: Tensor  # (C', C, 3, 3) of a convolution, (F, I) of the projection, int8
    step: Tensor  # (C') float32, positive: weight = q * step


def quantised(weight: Tensor) -> Quantised:
    """The nearest multiples of a step per output channel, which is its largest weight / 127."""
    whole, step = _multiples(weight)
    return Quantised(whole.to(torch.int8), step)


def rounded(weight: Tensor) -> Tensor:
    """The weights that `quantised` stands for, in float32; gradients pass as if nothing were rounded."""
    whole, step = _multiples(weight)
    return weight + whole.mul_(_by_output(step, weight)).sub_(weight.detach())  # in place: a projection may be large


def _multiples(weight: Tensor) -> tuple[Tensor, Tensor]:
    largest = torch.linalg.vector_norm(weight.detach().flatten(1), torch.inf, dim=1)
    step = torch.where(largest > 0, largest, torch.ones_like(largest)) / MAX_WEIGHT
    return weight.detach().div(_by_output(step, weight)).round_().clamp_(-MAX_WEIGHT, MAX_WEIGHT), step


def _by_output(step: Tensor, weight: Tensor) -> Tensor:
    return step.view(-1, *[1] * (weight.dim() - 1))


def rounded_input(spikes: Tensor) -> Tensor:
    """The input in steps of 1 / LEVELS."""
    return codes(spikes).to(spikes.dtype) / LEVELS


def codes(spikes: Tensor) -> Tensor:
    """The input as whole numbers, uint8, layout kept."""
    return (spikes * LEVELS).round_().clamp_(0, 255).to(torch.uint8)
