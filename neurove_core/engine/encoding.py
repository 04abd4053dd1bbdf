"""From a window's counts to what the engine reads: 8-bit codes, or counts with their table."""

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from neurove_core.compiled import compiled
from neurove_core.engine.sparse import Counts
from neurove_core.engine.vectors import BYTES, put_entries
from neurove_core.networks import quantisation
from neurove_core.networks.encoding import BINARY, LOG1P


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
    return Counts(counts, BINARY if encoding == "binary" else LOG1P)


@compiled
def _look_up(
    counts: NDArray[np.uint8], table: NDArray[np.uint8], found: NDArray[np.uint8]
) -> None:  # pragma: no cover (machine code)
    whole = counts.size - counts.size % BYTES
    for i in range(0, whole, BYTES):
        put_entries(table, counts, i, found)
    for i in range(whole, counts.size):
        found[i] = table[counts[i]]


_CODES = {"binary": quantisation.codes(BINARY).numpy(), "log1p": quantisation.codes(LOG1P).numpy()}
