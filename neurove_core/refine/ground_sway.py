"""Pitch and roll rates of a vehicle, from those that the events of some windows show.

The tilt of a vehicle stays bounded, so its pitch rate has no mean: a slow mean is an error, as of the distance of what
the camera sees, and most of it is taken out. Both rates are then drawn towards zero, by the share of their power that
is noise (a Wiener filter whose power of the signal is learned). The errors grow with the speed.

A slow camera may be in a hand, so its rates stay as they are.
"""

import math
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

NOISE_RAD_S: Final = 0.012
"""Root mean square error of the rates of a search, from FAST_M_S on; it grows with speed."""

FAST_M_S: Final = 4.0
"""From this speed on the rates are filtered in full."""

_MEAN_SHARE: Final = 0.2  # of a new window in the mean of the pitch rate
_MEAN_TAKEN: Final = 0.85  # share of the mean that is taken out
_POWER_SHARE: Final = 0.05  # of a new window in the power


class Sway(NamedTuple):
    """What is known of the rates; powers are mean squares with the noise."""

    mean_rad_s: float = 0.0  # of the pitch rate
    pitch_power: float = 2 * NOISE_RAD_S**2
    roll_power: float = 2 * NOISE_RAD_S**2


def swayed(twist: Array, pitch: float, sway: Sway) -> tuple[Array, Sway]:
    """The twist (6,) with filtered rates of pitch and roll, and what is known after it.

    Args:
        twist: of a search, in the optical frame [m/s, rad/s].
        pitch: of the camera against the ground [rad], positive downwards; yaw is about the normal of the ground.
        sway: from the window before.
    """
    c, s = math.cos(pitch), math.sin(pitch)
    rate, yaw, roll = float(twist[3]), c * twist[4] + s * twist[5], c * twist[5] - s * twist[4]
    share = min(1.0, float(np.linalg.norm(twist[:3])) / FAST_M_S)
    swing = rate - share * _MEAN_TAKEN * sway.mean_rad_s
    found = Sway(
        sway.mean_rad_s + _MEAN_SHARE * (rate - sway.mean_rad_s),
        sway.pitch_power + _POWER_SHARE * (swing**2 - sway.pitch_power),
        sway.roll_power + _POWER_SHARE * (float(roll) ** 2 - sway.roll_power),
    )
    noise = (share * NOISE_RAD_S) ** 2
    swing, roll = swing * _signal(found.pitch_power, noise), roll * _signal(found.roll_power, noise)
    out = twist.copy()
    out[3:] = swing, c * yaw - s * roll, s * yaw + c * roll
    return out, found


def _signal(power: float, noise: float) -> float:
    """The share of the signal in a power."""
    return max(0.0, 1 - noise / max(power, 1e-12))
