"""The bias of a gyroscope: learned at rest at once, and slowly in motion (see `moving`); less certain from then on."""

from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

UNKNOWN_RAD_S: Final = 0.03
"""Standard deviation of the bias of each axis before the first rest (data sheets: 3 to 5 deg/s at most)."""

DRIFT_RAD_S: Final = 1e-4
"""Standard deviation of the change of the bias in one second: warming up."""

FLOOR_RAD_S: Final = 5e-4
"""Standard deviation that no number of samples falls below."""

MOTION_SHARE: Final = np.array([0.45, 0.25, 0.15])
"""Share of sigma of a bias that motion has taught well, for the rates of pitch, yaw and roll: the filter counts a
window as a tenth of a measurement, and expects worse events than those that it gets. Measured on own drives, see
decisions 169 and 178."""

REST_RAD_S: Final = 0.001
"""Standard deviation of the turning of a camera that rest is taken for: a vehicle that stops still settles."""

NOISE_RAD_S: Final = 0.004
"""Standard deviation of one sample before the first rest."""


class Bias(NamedTuple):
    """Mean and variance of the bias, and what rest has shown of the noise."""

    mean_rad_s: NDArray[np.float64] = np.zeros(3)  # (3,); never changed in place
    variance: NDArray[np.float64] = np.full(3, UNKNOWN_RAD_S**2)  # (3,)
    noise_rad_s: float = NOISE_RAD_S
    at_us: int | None = None  # sensor time of the variance; None if nothing was learned yet
    rested: bool = False  # the unit has been at rest

    @property
    def known(self) -> bool:
        """Whether rest has shown the bias, or motion has halved its uncertainty on each axis."""
        return self.rested or bool((self.variance < UNKNOWN_RAD_S**2 / 4).all())

    def variance_at(self, t_us: int) -> NDArray[np.float64]:
        """Variance (3,) at a time [us]: it grows with time, up to that of an unknown bias."""
        if self.at_us is None:
            return self.variance
        grown = self.variance + DRIFT_RAD_S**2 * max(0, t_us - self.at_us) * 1e-6
        return np.minimum(grown, UNKNOWN_RAD_S**2)

    def error_variance_at(self, t_us: int) -> NDArray[np.float64]:
        """Variance (3,) of the error of `mean_rad_s` at a time [us]; that of the filter is larger, see MOTION_SHARE."""
        variance = self.variance_at(t_us)
        if self.rested:
            return variance + REST_RAD_S**2
        share = MOTION_SHARE + (1 - MOTION_SHARE) * np.square(variance / UNKNOWN_RAD_S**2)
        return np.asarray(variance * share**2)


def learned(bias: Bias, gyro_rad_s: NDArray[np.float64], samples: int, noise_rad_s: float, t_us: int) -> Bias:
    """The bias after some more time at rest: one step of a Kalman filter for each axis.

    Args:
        bias: so far.
        gyro_rad_s: mean (3,) of new samples at rest.
        samples: their number.
        noise_rad_s: standard deviation of one of them.
        t_us: their time.
    """
    before = bias.variance_at(t_us)
    measured = noise_rad_s**2 / max(1, samples) + FLOOR_RAD_S**2
    gain = before / (before + measured) if bias.rested else np.ones(3)  # the first rest says all there is to know
    mean = bias.mean_rad_s + gain * (gyro_rad_s - bias.mean_rad_s)
    variance = np.maximum((1 - gain) * before, FLOOR_RAD_S**2) if bias.rested else np.full(3, measured)
    noise = 0.9 * bias.noise_rad_s + 0.1 * noise_rad_s if bias.rested else noise_rad_s
    return Bias(mean, variance, noise, t_us, rested=True)
