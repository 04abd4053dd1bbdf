"""Spike lists: the neurons of a feature map that fired, by their index, and conversions between memory layouts."""

from functools import lru_cache
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from neurove_core.compiled import compiled
from neurove_core.engine.tiles import LANES

if TYPE_CHECKING:  # lists need no torch, only their conversion to tensors does
    from torch import Tensor

Array = NDArray[np.float32]
Indices = NDArray[np.int32]

SPARE: Final = 2 * LANES
"""Unused numbers at the end of a list: kernels read and write whole vectors there."""


class SpikeList(NamedTuple):
    """The neurons that fired in R maps of shape (H, W, C)."""

    indices: Indices  # index of each spike in its map, channels last, ascending; one map after the other, then SPARE
    starts: Indices  # (R * H * W + 1): where in `indices` each cell begins
    shape: tuple[int, int, int, int]  # (R, H, W, C)
    total: int  # number of spikes


def to_maps(spikes: SpikeList, kind: type[np.generic] = np.float32) -> "Tensor":
    """Spikes of 0 and 1 (R, C, H, W), channels last in memory."""
    maps = np.zeros((spikes.shape[0], spikes.shape[1] * spikes.shape[2] * spikes.shape[3]), kind)
    fill_spikes(spikes.indices, spikes.starts, maps)
    return channels_first(maps.reshape(spikes.shape))


def to_list(maps: "Tensor") -> SpikeList:
    """The spike list of maps (R, C, H, W); the inverse of `to_maps`."""
    return list_of(channels_last(maps))


def list_of(maps: NDArray[Any]) -> SpikeList:
    """The spike list of maps (R, H, W, C), channels last."""
    found = np.nonzero(maps.reshape(maps.shape[0], -1))[1]
    indices = np.zeros(found.size + SPARE, np.int32)
    indices[: found.size] = found
    cells = np.count_nonzero(maps.reshape(-1, maps.shape[3]), axis=1)
    starts = np.concatenate([[0], np.cumsum(cells)]).astype(np.int32)
    return SpikeList(indices, starts, maps.shape, found.size)


def output_shape(given: tuple[int, ...], weights: tuple[int, int], v: Array) -> tuple[int, int, int, int]:
    """Shape (R, H', W', C') after a convolution of 3x3 with stride 2; checks what compiled code does not check.

    Args:
        given: shape (R, H, W, C) of the input.
        weights: C and C' of the layer.
        v: membrane potentials (B, H', W', C'), R a multiple of B.

    Raises:
        ValueError: input, weights and potentials do not fit together.
    """
    shape, fits = _fitted(given, weights, v.shape)
    if not fits or v.dtype != np.float32:
        have = f"{v.dtype} {v.shape}"
        raise ValueError(f"maps {given} and weights {weights} give {shape[1:]} for each stream, potentials are {have}")
    return shape


@lru_cache(256)
def _fitted(
    given: tuple[int, ...], weights: tuple[int, int], potentials: tuple[int, ...]
) -> tuple[tuple[int, int, int, int], bool]:
    """The shape of `output_shape`, and whether the shapes fit together; the same few for all windows of a model."""
    maps, rows, columns, inputs = given
    shape = (rows + 1) // 2, (columns + 1) // 2, weights[1]
    return (maps, *shape), potentials[1:] == shape and not maps % potentials[0] and inputs == weights[0]


def as_numpy(x: "Tensor") -> NDArray[Any]:
    """The values of a tensor without its gradient. It is detached only where needed, because each call costs time."""
    values: NDArray[Any] = (x.detach() if x.requires_grad else x).numpy()
    return values


def channels_last(maps: "Tensor") -> NDArray[Any]:
    """Maps (R, C, H, W) as an array (R, H, W, C); no copy where they are channels last in memory."""
    return np.ascontiguousarray(as_numpy(maps).transpose(0, 2, 3, 1))


def channels_first(cells: Array) -> "Tensor":
    """An array (R, H, W, C) as a tensor (R, C, H, W) of the same memory; the inverse of `channels_last`."""
    import torch

    return torch.from_numpy(cells.transpose(0, 3, 1, 2))


def empty_list(shape: tuple[int, int, int, int]) -> tuple[Indices, Indices]:
    """Memory for `indices` and `starts` of a list, enough for every neuron of these maps."""
    cells = shape[0] * shape[1] * shape[2]
    return np.empty(cells * shape[3] + SPARE, np.int32), np.empty(cells + 1, np.int32)


@compiled
def fill_spikes(indices: Indices, starts: Indices, maps: NDArray[Any]) -> None:  # pragma: no cover (machine code)
    """Write 1 for each spike into maps (R, H * W * C) of zeros."""
    cells = (starts.size - 1) // maps.shape[0]
    for r in range(maps.shape[0]):
        for i in range(starts[r * cells], starts[(r + 1) * cells]):
            maps[r, indices[i]] = 1


def in_groups(weight: NDArray[np.int8], group: int) -> NDArray[np.signedinteger[Any]]:
    """Weights (3, 3, C, C') as (3, groups of channels, 3, C', group), flat: int8 for groups of four, int16 for two."""
    inputs, outputs = weight.shape[2:]
    groups = -(-inputs // group)
    by_input = np.zeros((3, groups * group, 3, outputs), np.int8 if group == 4 else np.int16)
    by_input[:, :inputs] = weight.transpose(0, 2, 1, 3)
    return np.ascontiguousarray(by_input.reshape(3, groups, group, 3, outputs).transpose(0, 1, 3, 4, 2)).reshape(-1)
