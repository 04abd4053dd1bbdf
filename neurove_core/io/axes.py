"""Axes of the inertial units in iniVation cameras: from those of libcaer and DV to the optical frame."""

from typing import Final

import numpy as np
from numpy.typing import NDArray

from neurove_protocol.imu import Imu

G_M_S2: Final = 9.80665
"""Standard gravity, the unit of accelerations in these formats."""

OPTICAL: Final = np.array([-1.0, 1.0, -1.0])
"""Factor of each axis (3,), for the accelerometer and the gyroscope alike.

libcaer and DV align the unit with the camera: x right, y up, z forward. An acceleration has the sign of gravity, and a
turn is positive counter-clockwise along the axis, against the right-hand rule. Both give this factor. Sources:
docs.inivation.com/hardware/hardware-advanced-usage/imu.html; the ROS driver rpg_dvs_ros applies the same signs. In
`davis346.aedat4` of DV, whose images look down on a street, the specific force along the optical axis is then negative.
"""


def optical_samples(t: NDArray[np.int64], accel_g: NDArray[np.float64], gyro_deg_s: NDArray[np.float64]) -> Imu:
    """Samples of libcaer or DV as SI units in the camera's optical frame.

    Args:
        t: (N,) sensor clock [us].
        accel_g: (N, 3) acceleration [g].
        gyro_deg_s: (N, 3) angular velocity [deg/s].
    """
    return Imu(t, accel_g * (OPTICAL * G_M_S2), np.radians(gyro_deg_s) * OPTICAL)
