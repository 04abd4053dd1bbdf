"""Batch norms folded into the weights before them, in float32 and in 8-bit integers."""

from typing import NamedTuple

import torch
from torch import Tensor, nn

from neurove_core.engine.convolution import Convolution, convolution
from neurove_core.engine.int8 import Int8Layer
from neurove_core.networks import quantisation
from neurove_core.networks.neurove import NeuroVE, SpikingBlock
from neurove_core.networks.tables import LEVELS


class Folded(NamedTuple):
    """A layer of weights with the norm that follows it folded in."""

    weight: Tensor
    bias: Tensor


def folded(weight: Tensor, norm: nn.BatchNorm1d | nn.BatchNorm2d) -> Folded:
    """Fold a norm in evaluation mode into the weights before it; the norm runs over their first axis.

    gamma (w x - mean) / sqrt(var + eps) + beta = (w k) x + (beta - mean k), k = gamma / sqrt(var + eps). Computed in
    float64, so that folding adds one rounding.
    """
    mean, variance, gamma, beta = (
        tensor.double()
        for tensor in (norm.running_mean, norm.running_var, norm.weight, norm.bias)
        if tensor is not None
    )
    k = gamma / torch.sqrt(variance + norm.eps)
    scaled = weight.double() * k.view(-1, *[1] * (weight.dim() - 1))
    return Folded(scaled.to(weight.dtype), (beta - mean * k).to(weight.dtype))


def folded_convolution(block: SpikingBlock, rows: int, columns: int) -> Convolution:
    """A block's convolution with its norm folded in."""
    return convolution(*folded(block.conv.weight, block.norm), rows, columns)


def int8_layer(block: SpikingBlock, at: int) -> Int8Layer:
    """Block number `at` in 8-bit integers; the factor includes the step of its weights, and at 0 that of the input."""
    weights = quantisation.quantised(block.conv.weight)
    steps = weights.step.double() / (LEVELS if at == 0 else 1)
    factor, offset = folded(steps.view(-1, 1), block.norm)
    return Int8Layer(weights, factor.view(-1).float(), offset.float())


def folded_projection(network: NeuroVE, channels: int, rows: int, columns: int) -> Folded:
    """The projection for maps that are flattened with channels last."""
    weight, bias = folded(network.project.weight, network.project_norm)
    return Folded(weight.view(-1, channels, rows, columns).permute(0, 2, 3, 1).flatten(1).contiguous(), bias)


def int8_projection(network: NeuroVE, channels: int, rows: int, columns: int) -> Int8Layer:
    """The projection in 8-bit integers; the norm's factor includes the step of the weights."""
    (q, step), norm = quantisation.quantised(network.project.weight), network.project_norm
    factor, offset = folded(step.double().view(-1, 1), norm)
    q = q.view(-1, channels, rows, columns).permute(0, 2, 3, 1).flatten(1)
    return Int8Layer(quantisation.Quantised(q, step), factor.view(-1).float(), offset.float())
