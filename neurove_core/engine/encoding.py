"""Encodings of the fast path: a window's counts to 8-bit codes, or counts together with their encoding table."""

import functools
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from neurove_core.engine.fallback import reason_of, vectors_work, warn_once
from neurove_core.networks import quantisation
from neurove_core.networks.encoding import BINARY, LOG1P

Bytes = NDArray[np.uint8]


class CountInput(NamedTuple):
    """Network input as counts and an encoding table: the first layer encodes row by row while it reads them."""

    counts: Tensor  # (T, B, 2n, H, W) uint8
    table: Tensor  # (256) float32

    @property
    def shape(self) -> torch.Size:
        """Shape of the input."""
        return self.counts.shape

    def spikes(self) -> Tensor:
        """The encoded input (T, B, 2n, H, W) float32."""
        return self.table[self.counts.to(torch.int64)]


def to_codes(counts: Tensor, encoding: str) -> Tensor:
    """`quantisation.codes` of `to_spikes` in one step: the input of an int8 network's engine.

    Args:
        counts: (..., 2n, H, W) uint8, contiguous, on the CPU.
        encoding: `encoding` of NetworkConfig.

    Returns:
        uint8 tensor of the same shape, contiguous.
    """
    given = counts.numpy()
    codes = np.empty(given.shape, np.uint8)
    _look_up()(given.reshape(-1), _CODES[encoding], codes.reshape(-1))
    return torch.from_numpy(codes)


def to_count_input(counts: Tensor, encoding: str) -> CountInput:
    """Counts with the table that `to_spikes` uses: the input of an engine that `reads_counts`.

    Args:
        counts: (T, B, 2n, H, W) uint8, on the CPU.
        encoding: `encoding` of NetworkConfig.
    """
    return CountInput(counts, BINARY if encoding == "binary" else LOG1P)


def look_up_reference(counts: Bytes, table: Bytes, codes: Bytes) -> None:
    """Write table[counts] to codes, in plain numpy."""
    np.take(table, counts, out=codes)


@functools.cache
def _look_up() -> Callable[[Bytes, Bytes, Bytes], None]:
    """The compiled look-up where it works on this machine, else the plain one."""
    if not vectors_work():
        return look_up_reference
    try:
        from neurove_core.engine.sparse_int8_kernels import look_up

        counts, table = np.arange(1000).astype(np.uint8), np.arange(256).astype(np.uint8)[::-1].copy()
        codes, want = np.empty_like(counts), np.empty_like(counts)
        look_up(counts, table, codes)
        look_up_reference(counts, table, want)
        if np.array_equal(codes, want):
            return look_up
        reason = "its results differ"
    except Exception as error:  # noqa: BLE001  # numba raises anything while it compiles
        reason = reason_of(error)
    warn_once("8-bit encoding", reason)
    return look_up_reference


_CODES = {"binary": quantisation.codes(BINARY).numpy(), "log1p": quantisation.codes(LOG1P).numpy()}
