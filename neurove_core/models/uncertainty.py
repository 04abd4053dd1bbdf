"""Uncertainty of an estimate: from the network's log sigma to the covariance of a twist, and its measured coverage.

Here sigma is the width of the interval that holds 90 % of the errors, divided by 2 * 1.645. A normal distribution with
this sigma has the same 90 % interval. The true errors have heavier tails and a sharper peak than a normal distribution.
"""

from dataclasses import dataclass
from statistics import NormalDist
from typing import TYPE_CHECKING, Final

import numpy as np
from numpy.typing import NDArray

from neurove_core.models.bounds import DEFAULT, UNSET, Bounds
from neurove_core.models.lazy import TensorField, as_array

if TYPE_CHECKING:
    from torch import Tensor

LEVEL: Final = 0.9
"""The share of errors that the calibration places within their intervals."""

LEVELS: Final = (0.5, 0.68, 0.8, LEVEL, 0.95, 0.99)
"""Nominal coverages that are compared with measured coverages."""

_MAX_LOG: Final = 20.0  # bound of |log sigma|: far beyond realistic values, and exp stays finite
_LEAST_EIGENVALUE: Final = 1e-4

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Uncertainty:
    """The calibrated error model of a bundle; it complements the network's log sigma.

    Args:
        correlation: (6, 6) float32, between the errors of the axes of a twist.
        uncertain_above: relative bound: sigma / speed of the linear part, sigma / rate of the angular part.
        provenance: one line: how the model was calibrated.
        bounds: absolute bounds of sigma; those of bounds.DEFAULT where they are not set.
    """

    correlation: "Tensor"  # given as such or as an array, see lazy.py
    uncertain_above: float
    provenance: str
    bounds: Bounds = UNSET

    @property
    def matrix(self) -> NDArray[np.float32]:
        """The correlation as an array."""
        return as_array(_CORRELATION.stored(self))

    def covariance(self, log_sigma: Array, scale: Array) -> Array:
        """D R D (6, 6) for log sigma (6) in units of the scale (6), in the scale's units squared."""
        sigma = np.exp(np.clip(log_sigma, -_MAX_LOG, _MAX_LOG)) * scale
        covariance: Array = self.matrix.astype(np.float64) * np.outer(sigma, sigma)
        return (covariance + covariance.T) / 2  # symmetric to the last bit, as the wire format requires

    def is_uncertain(self, twists: Array, covariance: Array, node: Bounds = UNSET) -> bool:
        """Whether the linear or the angular part of a window's twists is too uncertain.

        A part is uncertain if its sigma exceeds both the relative and the absolute bound. Its sigma is the root of the
        sum of its three variances. Its speed is the length of its mean over the window. At low speed the absolute bound
        decides, because no sigma is small compared with a speed of 0.

        Args:
            twists: (n, 6) [m/s, rad/s].
            covariance: (6, 6) of each of them.
            node: absolute bounds that take precedence over those of the bundle.
        """
        mean, sides = twists.mean(0), (slice(0, 3), slice(3, 6))
        absolute = node.or_else(self.bounds).or_else(DEFAULT)
        for side, bound in zip(sides, absolute, strict=True):
            relative = self.uncertain_above * float(np.linalg.norm(mean[side]))
            sigma = float(np.sqrt(np.trace(covariance[side, side])))
            if sigma > max(relative, bound or 0.0):
                return True
        return False


_CORRELATION = TensorField(Uncertainty, "correlation")


def why_no_correlation(matrix: NDArray[np.float32]) -> str | None:
    """Why a finite matrix (6, 6) is not a correlation matrix; None if it is one."""
    if not np.array_equal(matrix, matrix.T):
        return "is not symmetric"
    if not (np.diagonal(matrix) == 1).all():
        return "has a diagonal that is not 1"
    least = float(np.linalg.eigvalsh(matrix.astype(np.float64))[0])
    return None if least >= _LEAST_EIGENVALUE else f"is not positive definite: its least eigenvalue is {least:.3g}"


def half_width(level: float) -> float:
    """Half width [sigma] of the central interval that holds this share of a normal distribution.

    >>> round(half_width(0.9), 3)
    1.645
    """
    return NormalDist().inv_cdf((1 + level) / 2)


def coverage(error: Array, sigma: Array, level: float) -> Array:
    """The share by axis (6) of the errors (N, 6) within the interval of this level; sigma is (N, 6) > 0."""
    covered: Array = (np.abs(error) <= half_width(level) * sigma).mean(0)
    return covered
