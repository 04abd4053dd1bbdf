"""Weights of a larger network from those of a smaller one that computes the same: more input channels, wider blocks."""

import torch
from torch import Tensor

from neurove_core.config import ModelConfig
from neurove_core.networks.neurove import NeuroVE

_CONVOLUTION = "blocks.{}.conv.weight"
_NORM = "blocks.{}.norm."


def narrowed(wanted: ModelConfig, had: ModelConfig) -> ModelConfig:
    """The configuration with the sizes of a model that it may grow from: equal to `had` in these where it may.

    A NeuroVE may grow from one without subcells, without a history, or with fewer channels in any block but the last.
    """
    if (wanted.kind, had.kind) != ("neurove", "neurove"):
        return wanted
    grid, network = wanted.canonical, wanted.network
    if had.canonical.subcells == 1:
        grid = grid.model_copy(update={"subcells": 1})
    if not had.network.history:
        network = network.model_copy(update={"history": ()})
    widths, before = network.channels, had.network.channels
    wider = len(widths) == len(before) and all(a >= b for a, b in zip(widths, before, strict=True))
    if wider and widths[-1] == before[-1]:
        network = network.model_copy(update={"channels": before})
    return wanted.model_copy(update={"canonical": grid, "network": network})


def grown(weights: dict[str, Tensor], had: ModelConfig, network: NeuroVE) -> dict[str, Tensor]:
    """The weights of a small network, for a larger one that computes the same at first.

    New channels of a block keep the random weights of the larger network; the next block gets zeros for them, so they
    change nothing until training gives them weights (Net2Net, Chen 2016, without copies of neurons). Further channels
    of the input: see `wider_input`.

    Args:
        weights: state of the small network.
        had: its configuration; `narrowed` of that of the larger one.
        network: the larger one, at its random weights. It is not changed.

    Returns:
        a complete state of the larger network.
    """
    found, own = dict(weights), network.state_dict()
    for index in range(len(had.network.channels)):
        name = _CONVOLUTION.format(index)
        weight, made = weights[name], own[name].clone()
        if index == 0:
            weight = wider_input(weight, had, network.config)
        rows, inputs = weight.shape[:2]
        made[:rows] = 0
        made[:rows, :inputs] = weight
        found[name] = made
        for part in ("weight", "bias", "running_mean", "running_var"):
            norm = own[_NORM.format(index) + part].clone()
            norm[:rows] = weights[_NORM.format(index) + part]
            found[_NORM.format(index) + part] = norm
    return found


def wider_input(weight: Tensor, had: ModelConfig, wanted: ModelConfig) -> Tensor:
    """Weights of the first convolution for an input with more channels: those of a model without them, continued.

    Each part of a cell gets the weights of the cell, and the history gets zeros. With one event per cell the network
    computes what it did; with several, the parts count a little more than their sum, because log1p is concave.

    Args:
        weight: (C', C, 3, 3), C that of `had.input_shape`.
        had: configuration of these weights.
        wanted: configuration with the same or more channels.

    Returns:
        (C', C, 3, 3), C that of `wanted.input_shape`.
    """
    found = weight.repeat_interleave(wanted.canonical.parts // had.canonical.parts, dim=1)
    missing = wanted.input_shape[0] - found.shape[1]
    return torch.cat([found, found.new_zeros(len(found), missing, *found.shape[2:])], dim=1)
