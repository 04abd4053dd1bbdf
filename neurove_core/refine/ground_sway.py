"""Pitch and roll rates of a vehicle, from those that the events of some windows show.

The tilt of a vehicle stays bounded, so its rates of pitch and roll have no mean: a slow mean is an error, as of the
distance of what the camera sees, and most of it is taken out. That of the roll rate is slower. Both rates are then
drawn towards zero, by the share of their power that is noise (a Wiener filter whose power of the signal is learned),
but not below PITCH_KEPT and ROLL_KEPT. The errors grow with the speed.

A camera that moves many heights in a second shows its yaw rate too fast, by TOO_FAST_S.

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

PITCH_KEPT: Final = 0.8
"""Least share of a pitch rate that is kept: the power of little motion is too uncertain to tell how little it is."""

ROLL_KEPT: Final = 0.7
"""The same for a roll rate."""

TOO_FAST_S: Final = 0.01
"""Error of the yaw rate of a search, as a share of it, by the speed over the height of the camera [s]. It was measured
on own drives with the camera at 0.3 to 2.4 m; its cause is not known, see decision 165."""

MOST_TOO_FAST: Final = 0.2
"""Greatest share that is taken out."""

_PITCH_MEAN_SHARE: Final = 0.2  # of a new window in the mean of the rate
_ROLL_MEAN_SHARE: Final = 0.03
_MEAN_TAKEN: Final = 0.85  # share of the means that is taken out
_POWER_SHARE: Final = 0.05  # of a new window in the power


class Sway(NamedTuple):
    """What is known of the rates; means [rad/s], and powers, mean squares with the noise."""

    pitch_mean: float = 0.0
    roll_mean: float = 0.0
    pitch_power: float = 2 * NOISE_RAD_S**2
    roll_power: float = 2 * NOISE_RAD_S**2


def swayed(twist: Array, pitch: float, sway: Sway, height_m: float = math.inf) -> tuple[Array, Sway]:
    """The twist (6,) with filtered rates of pitch and roll, and what is known after it.

    Args:
        twist: of a search, in the optical frame [m/s, rad/s].
        pitch: of the camera against the ground [rad], positive downwards; yaw is about the normal of the ground.
        sway: from the window before.
        height_m: of the camera above the ground, if its speed is known.
    """
    c, s = math.cos(pitch), math.sin(pitch)
    pitching, yaw, rolling = float(twist[3]), c * twist[4] + s * twist[5], float(c * twist[5] - s * twist[4])
    speed_m_s = float(np.linalg.norm(twist[:3]))
    share = min(1.0, speed_m_s / FAST_M_S)
    yaw = yaw * (1 - min(TOO_FAST_S * speed_m_s / height_m, MOST_TOO_FAST))
    swing = pitching - share * _MEAN_TAKEN * sway.pitch_mean
    roll = rolling - share * _MEAN_TAKEN * sway.roll_mean
    found = Sway(
        sway.pitch_mean + _PITCH_MEAN_SHARE * (pitching - sway.pitch_mean),
        sway.roll_mean + _ROLL_MEAN_SHARE * (rolling - sway.roll_mean),
        sway.pitch_power + _POWER_SHARE * (swing**2 - sway.pitch_power),
        sway.roll_power + _POWER_SHARE * (roll**2 - sway.roll_power),
    )
    noise = (share * NOISE_RAD_S) ** 2
    swing = swing * max(_signal(found.pitch_power, noise), 1 - share * (1 - PITCH_KEPT))
    roll = roll * max(_signal(found.roll_power, noise), 1 - share * (1 - ROLL_KEPT))
    out = twist.copy()
    out[3:] = swing, c * yaw - s * roll, s * yaw + c * roll
    return out, found


def steady(twist: Array, last: Array, pitch: float) -> Array:
    """A twist (6,) with the yaw rate of the last answer (6,), without rates of pitch and roll; see `swayed`."""
    c, s = math.cos(pitch), math.sin(pitch)
    yaw = c * last[4] + s * last[5]
    return np.array([*twist[:3], 0.0, c * yaw, s * yaw])


def _signal(power: float, noise: float) -> float:
    """The share of the signal in a power."""
    return max(0.0, 1 - noise / max(power, 1e-12))
