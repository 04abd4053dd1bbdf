"""Points: one estimate as numbers for the plots, and the two magnitudes that the page shows as large numbers."""

import math
from typing import Any, Final, NamedTuple

import numpy as np

from neurove_protocol import TwistEstimate

_DIGITS: Final = 4
_LEAST_NORM: Final = 1e-6  # below it a direction has no meaning


class Magnitude(NamedTuple):
    """Length of a vector and its standard deviation, None without a covariance."""

    value: float
    sigma: float | None


def magnitudes(estimate: TwistEstimate) -> tuple[Magnitude, Magnitude]:
    """Speed [m/s] and turn rate [rad/s] of the newest twist.

    The variance is that of the component along the vector; of a vector of length 0 it is the largest one of its axes.
    """
    twist = np.array(estimate.twist)
    covariance = None if estimate.covariance is None else np.array(estimate.covariance).reshape(6, 6)
    return _magnitude(twist, covariance, 0), _magnitude(twist, covariance, 3)


def _magnitude(twist: np.ndarray[Any, Any], covariance: np.ndarray[Any, Any] | None, first: int) -> Magnitude:
    part = twist[first : first + 3]
    norm = float(np.linalg.norm(part))
    if covariance is None:
        return Magnitude(norm, None)
    block = covariance[first : first + 3, first : first + 3]
    unit = part / norm if norm > _LEAST_NORM else None
    variance = float(block.diagonal().max() if unit is None else unit @ block @ unit)
    return Magnitude(norm, math.sqrt(max(variance, 0.0)))


def point(estimate: TwistEstimate, at_s: float) -> tuple[Any, ...]:
    """Arrival [s of the page's clock], six numbers, six sigmas or None, and the flags as one text with spaces."""
    sigma = estimate.sigma
    sigmas = [None] * 6 if sigma is None else [round(one, _DIGITS) for one in sigma]
    flags = " ".join(estimate.flags[:16])[:300]
    return (round(at_s, 3), *(round(one, _DIGITS) for one in estimate.twist), *sigmas, flags)
