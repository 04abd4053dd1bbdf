"""Angular velocity over the bins of a window, from the samples of a gyroscope at hand.

The signal is linear between two samples. After the last one it stays constant for at most EXTRAPOLATED_US, with a
variance that grows: a window never waits for samples.
"""

from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from neurove_core.inertial import smooth
from neurove_protocol.imu import Imu

EXTRAPOLATED_US: Final = 10_000
"""Longest time over which the last sample stands for those that are missing."""

MAX_GAP_US: Final = 25_000
"""Longest time between two samples: a unit of 40 Hz is the slowest."""

ACCELERATION_RAD_S2: Final = 5.0
"""Standard deviation of the angular acceleration where no sample says how it is: hand motion."""

SCALE: Final = 0.01
"""Standard deviation of the scale of each axis (data sheet of the MPU-6500: 1 to 3 %)."""

MOUNTING_RAD: Final = 0.03
"""Standard deviation of the mounting about each axis, if the driver gives no calibrated one."""

LEAST_NOISE_RAD_S: Final = 0.001
"""Least noise of a sample: a unit that filters its samples shows less by their differences than it has."""

LEAST_OF_BIN_RAD_S: Final = 0.0004
"""The same of a bin: the noise of such a unit does not shrink with the number of its samples."""

Array = NDArray[np.float64]


class Rates(NamedTuple):
    """What the gyroscope measured over the bins of one window, with its bias."""

    gyro_rad_s: Array  # (n, 3)
    variance: Array  # (3,) of each of them, without the variance of the bias [(rad/s)^2]
    samples: int  # in the window
    extrapolated_us: int  # time after the last sample
    noise_variance: float = 0.0  # the part of `variance` that is the noise of the samples


class Smooth(NamedTuple):
    """The rates of the bins of one window with less noise."""

    gyro_rad_s: Array  # (n, 3)
    variance: Array  # (3,) of each of them, without the variance of the bias [(rad/s)^2]


def rates(samples: Imu, edges_us: NDArray[np.int64], noise_rad_s: float) -> Rates | None:
    """The mean angular velocity of each bin; None where samples are missing.

    Args:
        samples: ordered by time; those after the last edge only serve the interpolation.
        edges_us: (n + 1,) the bins [us].
        noise_rad_s: standard deviation of one sample.
    """
    start_us, end_us = int(edges_us[0]), int(edges_us[-1])
    first = max(0, int(samples.t.searchsorted(start_us, "right")) - 1)
    stop = min(samples.n, int(samples.t.searchsorted(end_us)) + 1)
    near = samples.span(first, stop)
    if not near.n:
        return None
    extrapolated_us = max(0, end_us - int(near.t[-1]))
    gaps_us = np.diff(near.t, prepend=min(start_us, int(near.t[0])))
    if extrapolated_us > EXTRAPOLATED_US or gaps_us.max() > MAX_GAP_US or near.t[0] - start_us > EXTRAPOLATED_US:
        return None
    means = _means(near, edges_us)
    inside = int(samples.t.searchsorted(end_us)) - int(samples.t.searchsorted(start_us))
    bins = edges_us.size - 1
    bin_us = (end_us - start_us) / bins
    noise_variance = noise_rad_s**2 / max(1.0, inside / bins)
    variance = np.full(3, noise_variance)
    longest_us = float(gaps_us.max())
    variance += (ACCELERATION_RAD_S2 * longest_us**2 / bin_us * 1e-6 / 8) ** 2
    variance += (ACCELERATION_RAD_S2 * extrapolated_us * min(1.0, extrapolated_us / bin_us) * 1e-6 / 2) ** 2
    mean_square = (means**2).mean(0)
    variance += SCALE**2 * mean_square + MOUNTING_RAD**2 * (mean_square.sum() - mean_square)
    return Rates(means, variance, inside, extrapolated_us, noise_variance)


def smooth_rates(samples: Imu, edges_us: NDArray[np.int64], found: Rates, *, rested: bool = False) -> Smooth:
    """The rates with less noise, where the samples of an equal time before the bins are at hand; see `smooth`.

    Args:
        samples: see `rates`.
        edges_us: (n + 1,) the bins [us].
        found: the rates of these bins.
        rested: whether their noise is what rest has shown; otherwise the samples show it while they move.
    """
    bins, start_us = edges_us.size - 1, int(edges_us[0])
    earlier_us = start_us - (edges_us[:0:-1] - start_us)
    longer = rates(samples, np.concatenate([earlier_us, edges_us]), 0.0)
    if longer is None or samples.t[0] > earlier_us[0] or not longer.samples:
        return Smooth(found.gyro_rad_s, found.variance)
    first, stop = (int(samples.t.searchsorted(t_us)) for t_us in (earlier_us[0], edges_us[-1]))
    noise_rad_s, of_bin = smooth.noise_of(samples.span(first, stop)), max(1.0, longer.samples / (2 * bins))
    less = smooth.smoothed(longer.gyro_rad_s, noise_rad_s**2 / of_bin)
    before = found.noise_variance if rested or not noise_rad_s else max(noise_rad_s, LEAST_NOISE_RAD_S) ** 2 / of_bin
    left = max(before * float(less.left[bins:].mean()), LEAST_OF_BIN_RAD_S**2)
    return Smooth(less.rates_rad_s[bins:], found.variance - found.noise_variance + left)


def turned(samples: Imu, at_us: NDArray[np.int64]) -> Array:
    """The angle (N, 3) [rad] turned through from the first sample up to some times (N,), none of them before it."""
    t = np.union1d(samples.t, at_us)
    gyro = np.stack([np.interp(t, samples.t, axis) for axis in samples.gyro_rad_s.T], axis=1)
    steps = np.diff(t)[:, None] * (gyro[1:] + gyro[:-1]) * 0.5e-6
    total = np.concatenate([np.zeros((1, 3)), np.cumsum(steps, axis=0)])
    found: Array = total[np.searchsorted(t, at_us)]
    return found


def _means(near: Imu, edges_us: NDArray[np.int64]) -> Array:
    angles = turned(near, edges_us)
    return np.asarray(np.diff(angles, axis=0) / (np.diff(edges_us) * 1e-6)[:, None])
