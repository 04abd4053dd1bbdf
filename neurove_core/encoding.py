"""From a window's counts to the network's input."""

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from neurove_core.kernels import compiled


def to_spikes(counts: Tensor, encoding: str) -> Tensor:
    """A window's event counts as the network's input, channel 2i OFF and 2i + 1 ON of bin i.

    Source: NeuroVE, section III-A, spike encoding.
    Differs: `log1p` keeps how many events a cell saw, as log(1 + count), and learns better (decision 5);
    `binary` is the paper's spike: 1 where there was an event.

    Args:
        counts: (..., 2n, H, W) uint8.
        encoding: of NetworkConfig.

    Returns:
        float32 tensor of the same shape, on the CPU channels last in memory, as the convolution wants it.
    """
    if counts.device.type != "cpu" or counts.dim() < 3 or not counts.is_contiguous() or counts.dtype != torch.uint8:
        return to_spikes_reference(counts, encoding)
    table = _BINARY if encoding == "binary" else _LOG1P
    planes = counts.numpy().reshape(-1, counts.shape[-3], counts.shape[-2] * counts.shape[-1])
    spikes = np.empty((planes.shape[0], planes.shape[2], planes.shape[1]), np.float32)
    _encode(planes, table.numpy(), spikes)
    *before, channels, rows, columns = counts.shape
    return torch.from_numpy(spikes).view(*before, rows, columns, channels).movedim(-1, -3)


def to_spikes_reference(counts: Tensor, encoding: str) -> Tensor:
    """What to_spikes computes, in plain PyTorch."""
    if encoding == "binary":
        return (counts > 0).to(torch.float32)
    return _LOG1P.to(counts.device)[counts.to(torch.int64)]


@compiled
def _encode(
    planes: NDArray[np.uint8], table: NDArray[np.float32], spikes: NDArray[np.float32]
) -> None:  # pragma: no cover (machine code)
    for row in range(planes.shape[0]):
        for cell in range(planes.shape[2]):
            for channel in range(planes.shape[1]):
                spikes[row, cell, channel] = table[planes[row, channel, cell]]


_LOG1P = torch.log1p(torch.arange(256, dtype=torch.float32))
_BINARY = (torch.arange(256) > 0).to(torch.float32)
