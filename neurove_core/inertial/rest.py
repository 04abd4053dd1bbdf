"""Rest, by the spread of the inertial samples: a unit that does not move shows its own noise and nothing else.

The bounds are some two and a half times the noise of the units in event cameras (data sheets of MPU-6500, MPU-6150 and
BMI160: 0.002 to 0.003 rad/s and 0.025 to 0.05 m/s2 at 1 kHz). A motion as smooth as that, such as a slider or a good
road, passes this test. The caller therefore also asks the events.
"""

from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from neurove_protocol.imu import Imu

SPAN_US: Final = 400_000
"""The samples of this time decide."""

MIN_SAMPLES: Final = 12

MAX_GYRO_RAD_S: Final = 0.006
MAX_ACCEL_M_S2: Final = 0.12
"""Bounds of the standard deviation of each axis."""

MAX_RATIO: Final = 1.5
"""Bound of the ratio between the noisiest and the quietest axis of the gyroscope.

The axes of a unit differ by some 20 % in noise, while a motion prefers an axis. So smooth motion is seen in a unit
whose noise is not known yet.
"""

MAX_GYRO_CHANGE_RAD_S: Final = 0.001
MAX_ACCEL_CHANGE_M_S2: Final = 0.03
"""Bounds of the difference between the means of both halves, beyond what noise explains (3 sigma)."""

MAX_BIAS_RAD_S: Final = 0.1
"""A larger mean is no bias but a steady turn."""

GRAVITY_M_S2: Final = (9.0, 10.6)
"""Bounds of the mean specific force of a unit that does not accelerate; a scale error of some percent is usual."""


class Still(NamedTuple):
    """Samples of a unit that does not move."""

    gyro_rad_s: NDArray[np.float64]  # mean (3,): the bias
    noise_rad_s: float  # standard deviation of one sample, the largest of the axes
    samples: int


def still(samples: Imu, end_us: int) -> Still | None:
    """Whether the unit did not move in the last SPAN_US; None if it moved, or if samples are missing.

    Args:
        samples: ordered by time.
        end_us: later samples are ignored.
    """
    first, stop = (int(samples.t.searchsorted(t_us)) for t_us in (end_us - SPAN_US, end_us))
    recent = samples.span(first, stop)
    if recent.n < MIN_SAMPLES or recent.t[-1] - recent.t[0] < 0.85 * SPAN_US:
        return None
    gyro, accel = recent.gyro_rad_s, recent.accel_m_s2
    mean, noise = gyro.mean(0), gyro.std(0)
    if noise.max() > MAX_GYRO_RAD_S or np.linalg.norm(mean) > MAX_BIAS_RAD_S:
        return None
    if noise.max() > MAX_RATIO * noise.min() + 1e-4:  # a simulated unit may have no noise
        return None
    shake = accel.std(0)
    if shake.max() > MAX_ACCEL_M_S2 or not GRAVITY_M_S2[0] <= np.linalg.norm(accel.mean(0)) <= GRAVITY_M_S2[1]:
        return None
    by_chance = 3 * 2 / np.sqrt(recent.n)  # of the difference of two means, in standard deviations of a sample
    for column, spread, bound in ((gyro, noise, MAX_GYRO_CHANGE_RAD_S), (accel, shake, MAX_ACCEL_CHANGE_M_S2)):
        change = np.abs(column[: recent.n // 2].mean(0) - column[recent.n // 2 :].mean(0))
        if (change > bound + by_chance * spread).any():
            return None
    return Still(mean, float(noise.max()), recent.n)
