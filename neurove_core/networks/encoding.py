"""From a window's counts to the network's input."""

from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from neurove_core.engine import int8
from neurove_core.engine.sparse import Counts
from neurove_core.engine.vectors import BYTES, put_entries
from neurove_core.ingest.counting import compiled


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
    return _channels_last(counts, _BINARY if encoding == "binary" else _LOG1P)


def to_codes(counts: Tensor, encoding: str) -> Tensor:
    """What `int8.codes` makes of `to_spikes`, at once: the input of an int8 network's engine.

    Args:
        counts: (..., 2n, H, W) uint8, contiguous, on the CPU.
        encoding: of NetworkConfig.

    Returns:
        uint8 tensor of the same shape, contiguous.
    """
    given = counts.numpy()
    found = np.empty(given.shape, np.uint8)
    _look_up(given.reshape(-1), _CODES[encoding], found.reshape(-1))
    return torch.from_numpy(found)


def to_counts(counts: Tensor, encoding: str) -> Counts:
    """What `to_spikes` makes of counts, made where it is read: the input of an engine that `reads_counts`.

    Args:
        counts: (T, B, 2n, H, W) uint8, on the CPU.
        encoding: of NetworkConfig.
    """
    return Counts(counts, _BINARY if encoding == "binary" else _LOG1P)


def to_spikes_reference(counts: Tensor, encoding: str) -> Tensor:
    """What to_spikes computes, in plain PyTorch."""
    if encoding == "binary":
        return (counts > 0).to(torch.float32)
    return _LOG1P.to(counts.device)[counts.to(torch.int64)]


def _channels_last(counts: Tensor, table: Tensor) -> Tensor:
    """Each count's entry of the table."""
    *before, channels, rows, columns = counts.shape
    planes = counts.numpy().reshape(-1, channels, rows * columns)
    spikes = np.empty((*before, rows, columns, channels), np.float32)
    _encode(planes, table.numpy(), spikes.reshape(-1, rows * columns, channels))
    return torch.from_numpy(np.moveaxis(spikes, -1, -3))


@compiled
def _look_up(
    counts: NDArray[np.uint8], table: NDArray[np.uint8], found: NDArray[np.uint8]
) -> None:  # pragma: no cover (machine code)
    whole = counts.size - counts.size % BYTES
    for i in range(0, whole, BYTES):
        put_entries(table, counts, i, found)
    for i in range(whole, counts.size):
        found[i] = table[counts[i]]


@compiled
def _encode(
    planes: NDArray[np.uint8], table: NDArray[Any], spikes: NDArray[Any]
) -> None:  # pragma: no cover (machine code)
    for row in range(planes.shape[0]):
        for cell in range(planes.shape[2]):
            for channel in range(planes.shape[1]):
                spikes[row, cell, channel] = table[planes[row, channel, cell]]


_LOG1P = torch.log1p(torch.arange(256, dtype=torch.float32))
_BINARY = (torch.arange(256) > 0).to(torch.float32)
_CODES = {"binary": int8.codes(_BINARY).numpy(), "log1p": int8.codes(_LOG1P).numpy()}
