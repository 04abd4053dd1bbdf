"""Constants and roundings that the arrays and the torch form of a network share; needs no torch."""

import math
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float32]

LEVELS: Final = 32
"""Steps of an int8 network's input per unit; log1p of a saturated count, 5.5, becomes 177."""

MAX_WEIGHT: Final = 127
"""Largest absolute value of a rounded weight, in steps."""


def of_encoding(encoding: str) -> Array:
    """The input (256) that each count of a cell becomes, by `encoding` of NetworkConfig."""
    if encoding == "binary":
        return (np.arange(256) > 0).astype(np.float32)
    return np.log1p(np.arange(256, dtype=np.float64)).astype(np.float32)


def codes_of(encoding: str) -> NDArray[np.uint8]:
    """The code (256), in steps of 1 / LEVELS, that each count becomes in an int8 network."""
    codes: NDArray[np.float32] = np.rint(of_encoding(encoding) * np.float32(LEVELS))
    return codes.clip(0, 255).astype(np.uint8)


def sigmoid(logit: float) -> float:
    """1 / (1 + exp(-logit)) in float32, with exp rounded once: the same on every machine.

    >>> sigmoid(0.0)
    0.5
    """
    logit = max(-80.0, min(80.0, logit)) if math.isfinite(logit) else logit
    one = np.float32(1)
    return float(one / (one + np.float32(math.exp(-logit))))


class QuantisedArray(NamedTuple):
    """Weights as integers with a step for each output channel."""

    q: NDArray[np.int8]
    step: Array


def quantised(weight: Array) -> QuantisedArray:
    """As `quantisation.quantised`: weights (C', ...) as multiples of their largest absolute value / 127."""
    largest = np.abs(weight.reshape(weight.shape[0], -1)).max(axis=1)
    step: Array = (np.where(largest > 0, largest, np.float32(1)) / np.float32(MAX_WEIGHT)).astype(np.float32)
    by_output: NDArray[Any] = step.reshape(-1, *[1] * (weight.ndim - 1))
    whole = np.clip(np.rint(weight / by_output), -MAX_WEIGHT, MAX_WEIGHT)
    return QuantisedArray(whole.astype(np.int8), step)
