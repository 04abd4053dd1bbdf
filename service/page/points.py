"""Points: one estimate as numbers for the plots, and the two magnitudes that the page shows as large numbers."""

import math
import sys
from array import array
from typing import Any, Final, NamedTuple

from neurove_protocol import TwistEstimate

_DIGITS: Final = 4
_WITHOUT_SIGMA: Final = 7
_LEAST_NORM: Final = 1e-6  # below it a direction has no meaning


class Magnitude(NamedTuple):
    """Length of a vector and its standard deviation, None without a covariance."""

    value: float
    sigma: float | None


def magnitudes(estimate: TwistEstimate) -> tuple[Magnitude, Magnitude]:
    """Speed [m/s] and turn rate [rad/s] of the newest twist.

    The variance is that of the component along the vector; of a vector of length 0 it is the largest one of its axes.
    """
    return _magnitude(estimate, 0), _magnitude(estimate, 3)


def _magnitude(estimate: TwistEstimate, first: int) -> Magnitude:
    part, covariance, axes = estimate.twist[first : first + 3], estimate.covariance, range(3)
    norm = math.hypot(*part)
    if covariance is None:
        return Magnitude(norm, None)
    rows = [covariance[6 * (first + i) + first : 6 * (first + i) + first + 3] for i in axes]
    if norm > _LEAST_NORM:
        variance = sum(rows[i][j] * part[i] * part[j] for i in axes for j in axes) / norm**2
    else:
        variance = max(rows[i][i] for i in axes)
    return Magnitude(norm, math.sqrt(max(variance, 0.0)))


class Point(NamedTuple):
    """One estimate of the history, in as few bytes as possible: there are tens of thousands."""

    numbers: "array[float]"  # arrival [s of the page's clock], six of the twist, and six sigmas if there are any
    flags: str  # with spaces between them

    @property
    def at_s(self) -> float:
        """Arrival [s of the page's clock]."""
        return self.numbers[0]

    def as_json(self) -> list[Any]:
        """Arrival, six numbers, six sigmas or None, and the flags."""
        sigmas = () if len(self.numbers) > _WITHOUT_SIGMA else (None,) * 6
        return [*self.numbers, *sigmas, self.flags]


def point(estimate: TwistEstimate, at_s: float) -> Point:
    """An estimate that arrived at this time of the page's clock [s]."""
    numbers = (*estimate.twist, *(estimate.sigma or ()))
    flags = " ".join(estimate.flags[:16])[:300]
    return Point(array("d", (round(at_s, 3), *(round(one, _DIGITS) for one in numbers))), sys.intern(flags))
