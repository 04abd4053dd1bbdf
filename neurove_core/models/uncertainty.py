"""How far off an estimate may be: from the network's log sigma to the covariance of a twist, and whether it holds.

A sigma here is that of a normal distribution whose middle 90 % is as wide as the interval that holds 90 % of the
errors. True errors have heavier tails and a sharper peak: read it as the width of that interval, over 2 * 1.645.
"""

from dataclasses import dataclass
from statistics import NormalDist
from typing import Final

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

LEVEL: Final = 0.9
"""Which share of the errors the calibration makes lie within their interval."""

LEVELS: Final = (0.5, 0.68, 0.8, LEVEL, 0.95, 0.99)
"""Nominal coverages that are compared with the measured ones."""

MIN_SPEED_M_S: Final = 0.5
"""A slower motion counts as so fast where its uncertainty is held against it: at rest any share would be endless."""

_MAX_LOG: Final = 20.0  # of a log sigma, either way: far beyond any sense, and exp stays finite
_LEAST_EIGENVALUE: Final = 1e-4

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Uncertainty:
    """What a calibrated bundle says of its errors, beside the network's own log sigma.

    Args:
        correlation: (6, 6) float32, of the errors of a twist's axes.
        uncertain_above: an estimate whose linear sigma is a larger share of its speed is flagged `uncertain`.
        provenance: one line: how it was calibrated.
    """

    correlation: Tensor
    uncertain_above: float
    provenance: str

    def covariance(self, log_sigma: Array, scale: Array) -> Array:
        """D R D (6, 6) for log sigma (6) in units of the scale (6), in the scale's units squared."""
        sigma = np.exp(np.clip(log_sigma, -_MAX_LOG, _MAX_LOG)) * scale
        covariance: Array = self.correlation.double().numpy() * np.outer(sigma, sigma)
        return (covariance + covariance.T) / 2  # symmetric to the last bit, as the wire wants it

    def is_uncertain(self, twists: Array, covariance: Array) -> bool:
        """Whether the linear part of a window's twists (n, 6) [m/s] is too unsure.

        Its sigma is the root of the three variances' sum; its speed that of the mean twist, at least MIN_SPEED_M_S.
        """
        speed = max(float(np.linalg.norm(twists[:, :3].mean(0))), MIN_SPEED_M_S)
        return float(np.sqrt(np.trace(covariance[:3, :3]))) > self.uncertain_above * speed


def why_no_correlation(matrix: Tensor) -> str | None:
    """What keeps a finite matrix (6, 6) from being the correlation of six numbers; None if nothing does."""
    if not torch.equal(matrix, matrix.T):
        return "is not symmetric"
    if not torch.equal(torch.diagonal(matrix), torch.ones(len(matrix))):
        return "has a diagonal that is not 1"
    least = float(torch.linalg.eigvalsh(matrix.double())[0])
    return None if least >= _LEAST_EIGENVALUE else f"is not positive definite: its least eigenvalue is {least:.3g}"


def half_width(level: float) -> float:
    """How many sigma to either side hold this share of a normal distribution.

    >>> round(half_width(0.9), 3)
    1.645
    """
    return NormalDist().inv_cdf((1 + level) / 2)


def coverage(error: Array, sigma: Array, level: float) -> Array:
    """Which share of the errors (N, 6) lies within the interval of this level, by axis (6); sigma is (N, 6) > 0."""
    covered: Array = (np.abs(error) <= half_width(level) * sigma).mean(0)
    return covered
