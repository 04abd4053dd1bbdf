"""From a window's counts to the network's input."""

import torch
from torch import Tensor


def to_spikes(counts: Tensor, encoding: str) -> Tensor:
    """A window's event counts as the network's input, channel 2i OFF and 2i + 1 ON of bin i.

    Source: NeuroVE, section III-A, spike encoding.
    Differs: `log1p` keeps how many events a cell saw, as log(1 + count), and learns better (decision 5);
    `binary` is the paper's spike: 1 where there was an event.

    Args:
        counts: (..., 2n, H, W) uint8.
        encoding: of NetworkConfig.

    Returns:
        float32 tensor of the same shape.
    """
    if encoding == "binary":
        return (counts > 0).to(torch.float32)
    return counts.to(torch.float32).log1p_()  # a table of 256 numbers was three times slower
