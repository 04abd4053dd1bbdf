"""Spike encoding: a window's event counts to the network's input."""

from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from neurove_core.compiled import compiled
from neurove_core.networks import tables


def to_spikes(counts: Tensor, encoding: str) -> Tensor:
    """A window's event counts as the network's input, channel 2i OFF and 2i + 1 ON of bin i.

    Source: NeuroVE, section III-A, spike encoding.
    Differs: `log1p` keeps the number of events of a cell, as log(1 + count), and trains better (decision 5).
    `binary` is the paper's encoding: 1 where there was an event.

    Args:
        counts: (..., 2n, H, W) uint8.
        encoding: `encoding` of NetworkConfig.

    Returns:
        float32 tensor of the same shape; on the CPU channels last in memory, the fastest layout for the convolution.
    """
    if counts.device.type != "cpu" or counts.dim() < 3 or not counts.is_contiguous() or counts.dtype != torch.uint8:
        return to_spikes_reference(counts, encoding)
    return _channels_last(counts, BINARY if encoding == "binary" else LOG1P)


def to_spikes_reference(counts: Tensor, encoding: str) -> Tensor:
    """The reference implementation of to_spikes, in plain PyTorch."""
    if encoding == "binary":
        return (counts > 0).to(torch.float32)
    return LOG1P.to(counts.device)[counts.to(torch.int64)]


def _channels_last(counts: Tensor, table: Tensor) -> Tensor:
    """The table's entry for each count."""
    *before, channels, rows, columns = counts.shape
    planes = counts.numpy().reshape(-1, channels, rows * columns)
    spikes = np.empty((*before, rows, columns, channels), np.float32)
    _encode(planes, table.numpy(), spikes.reshape(-1, rows * columns, channels))
    return torch.from_numpy(np.moveaxis(spikes, -1, -3))


@compiled
def _encode(
    planes: NDArray[np.uint8], table: NDArray[Any], spikes: NDArray[Any]
) -> None:  # pragma: no cover (machine code)
    for row in range(planes.shape[0]):
        for cell in range(planes.shape[2]):
            for channel in range(planes.shape[1]):
                spikes[row, cell, channel] = table[planes[row, channel, cell]]


LOG1P = torch.from_numpy(tables.of_encoding("log1p"))
BINARY = torch.from_numpy(tables.of_encoding("binary"))
