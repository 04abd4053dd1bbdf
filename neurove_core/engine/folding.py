"""Norms folded into the weights: in float32 and in 8-bit integers."""

from typing import NamedTuple

import torch
from torch import Tensor, nn

from neurove_core.engine import int8
from neurove_core.engine.convolution import Convolution, convolution
from neurove_core.networks import quantisation
from neurove_core.networks.neurove import NeuroVE, SpikingBlock


class Folded(NamedTuple):
    """One layer of weights with the norm that follows it inside."""

    weight: Tensor
    bias: Tensor


def folded(weight: Tensor, norm: nn.BatchNorm1d | nn.BatchNorm2d) -> Folded:
    """Weights whose first axis a norm in evaluation mode follows, with that norm inside.

    gamma (w x - mean) / sqrt(var + eps) + beta = (w k) x + (beta - mean k), k = gamma / sqrt(var + eps); in float64,
    so that folding itself adds one rounding.
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


def int8_layer(block: SpikingBlock, at: int) -> int8.Layer:
    """A block in whole numbers: the norm's factor takes the step of the weights, and that of the input, with it."""
    weights = quantisation.quantised(block.conv.weight)
    steps = weights.step.double() / (quantisation.LEVELS if at == 0 else 1)
    factor, offset = folded(steps.view(-1, 1), block.norm)
    return int8.Layer(weights, factor.view(-1).float(), offset.float())


def folded_projection(network: NeuroVE, channels: int, rows: int, columns: int) -> Folded:
    """The projection for maps that are flattened with their channels last."""
    weight, bias = folded(network.project.weight, network.project_norm)
    return Folded(weight.view(-1, channels, rows, columns).permute(0, 2, 3, 1).flatten(1).contiguous(), bias)


def int8_projection(network: NeuroVE, channels: int, rows: int, columns: int) -> int8.Layer:
    """The same in whole numbers; the norm's factor takes the step of the weights with it."""
    (q, step), norm = quantisation.quantised(network.project.weight), network.project_norm
    factor, offset = folded(step.double().view(-1, 1), norm)
    q = q.view(-1, channels, rows, columns).permute(0, 2, 3, 1).flatten(1)
    return int8.Layer(quantisation.Quantised(q, step), factor.view(-1).float(), offset.float())
