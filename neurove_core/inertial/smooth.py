"""Less noise in the bins of a gyroscope: what a smooth turn does not explain shrinks by the share of it that is noise.

Source: James and Stein, Estimation with quadratic loss (1961), with the positive part; here towards a polynomial.
"""

from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from neurove_protocol.imu import Imu

DEGREE: Final = 2
"""Degree in time of a turn that is smooth over two windows."""

_SECOND_DIFFERENCE: Final = np.sqrt(6) * 0.6745  # median length of that of white noise of sigma 1
_FEWEST: Final = 10  # samples that show the noise

Array = NDArray[np.float64]


class Smoothed(NamedTuple):
    """Rates of bins in a row with less noise."""

    rates_rad_s: Array  # (n, 3)
    left: Array  # (n,) the share of the variance of their noise that is left


def noise_of(samples: Imu) -> float:
    """Standard deviation of the noise of one sample, without the motion [rad/s]; 0 for fewer than 10 samples.

    A motion hardly changes the second differences of samples in a row. The noise of a unit that
    filters its samples is larger than this.
    """
    if samples.n < _FEWEST:
        return 0.0
    return float(np.median(np.abs(np.diff(samples.gyro_rad_s, 2, axis=0))) / _SECOND_DIFFERENCE)


def smoothed(rates_rad_s: Array, variance: float) -> Smoothed:
    """Rates of bins in a row, with less noise.

    A polynomial in time stays. The rest shrinks by max(0, 1 - (p - 2) variance / its square), with its number p of
    dimensions. So a turn that is not smooth stays as it was measured, and noise becomes the polynomial.

    Args:
        rates_rad_s: (n, 3).
        variance: of the noise of each of them [(rad/s)^2].
    """
    n = len(rates_rad_s)
    free = rates_rad_s.shape[1] * (n - DEGREE - 1)
    if free <= 2:
        return Smoothed(rates_rad_s, np.ones(n))
    basis, _ = np.linalg.qr(np.vander(np.linspace(-1, 1, n), DEGREE + 1))
    smooth = basis @ (basis.T @ rates_rad_s)
    rest = rates_rad_s - smooth
    square = float((rest**2).sum())
    kept = max(0.0, 1 - (free - 2) * variance / square) if square > 0 else 0.0
    left = np.square(basis).sum(axis=1)
    return Smoothed(np.asarray(smooth + kept * rest), np.asarray(left + kept * (1 - left)))
