"""Sigmoid and tanh of arrays, in place, for the compiled loops of recurrence.py and engine/cells.py."""

from collections.abc import Callable
from typing import Any

import numpy as np

from neurove_core.compiled import compile_with


def fused(function: Callable[..., Any]) -> Callable[..., Any]:
    """Compile a loop whose rounding may depend on the machine: sums are reordered, multiplications fused with sums."""
    return compile_with(function, fastmath={"contract", "reassoc", "nsz", "arcp"})


@fused
def sigmoid(values, scale, fast):  # type: ignore[no-untyped-def]  # compiled for its arguments
    """Values <- 1 / (1 + exp(-scale * values)), in place; `fast` is for float32, by a polynomial that vectorises."""
    one = values.dtype.type(1)
    flat = values.reshape(-1)
    n = flat.size
    if not fast:
        for i in range(n):
            flat[i] = one / (one + np.exp(-scale * flat[i]))
        return
    powers = np.empty(n, np.int32)
    rest = np.empty(n, np.float32)
    for i in range(n):
        x = min(max(-scale * flat[i], np.float32(-87.0)), np.float32(87.0))
        k = np.floor(x * np.float32(1.44269504) + np.float32(0.5))
        r = x - k * np.float32(0.693359375) + k * np.float32(2.12194440e-4)
        p = np.float32(1.9875691500e-4)
        p = p * r + np.float32(1.3981999507e-3)
        p = p * r + np.float32(8.3334519073e-3)
        p = p * r + np.float32(4.1665795894e-2)
        p = p * r + np.float32(1.6666665459e-1)
        p = p * r + np.float32(5.0000001201e-1)
        rest[i] = p * r * r + r + np.float32(1.0)
        powers[i] = (np.int32(k) + np.int32(127)) << np.int32(23)
    twos = powers.view(np.float32)
    for i in range(n):
        flat[i] = one / (one + rest[i] * twos[i])


@fused
def tanh(values, fast):  # type: ignore[no-untyped-def]  # compiled for its arguments
    """Replace each value by its tanh; `fast` as in sigmoid."""
    flat = values.reshape(-1)
    one = values.dtype.type(1)
    two = values.dtype.type(2)
    if not fast:
        for i in range(flat.size):
            flat[i] = np.tanh(flat[i])
        return
    sigmoid(values, two, fast)
    for i in range(flat.size):
        flat[i] = two * flat[i] - one
