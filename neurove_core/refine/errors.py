"""Errors of refined motions beyond those that the curvature of a search shows, as terms of their covariance.

The searches assume one depth (rotation) or a vehicle over level ground (ground). Where that does not hold, the errors
last for many windows, and the curvature of the search does not know of them. Each term follows a measured quantity that
shows it: the translation over depth, what the network says, the rates of pitch and roll.

The rules that accept a motion compare covariances without these terms. The constants make 90 % intervals hold on own
sequences; see decisions 115 and 169.
"""

import math
from typing import Final

import numpy as np
from numpy.typing import NDArray

from neurove_core.refine.vehicle import START

Array = NDArray[np.float64]

SEARCH_SHARE: Final = np.array([0.7, 0.7, 0.525])
"""Share of the sigma of the search by rotation, for pitch, yaw and roll; the other terms replace the rest."""

RATE_SHARE: Final = 0.03
"""Error of a rate, as a share of the angular velocity."""

CHANGE: Final = np.array([0.12, 0.12, 0.09])
"""Error of a rate, as a share of its change since the window before."""

SHIFT_SQUARED: Final = np.array([0.7, 0.7, 0.28])
"""Error of a rate by the square of the translation over depth [s]: depths differ."""

SHIFT_CHANGE: Final = np.array([0.6, 0.0, 0.3])
"""Error of a rate by the change of the translation over depth since the window before."""

AHEAD: Final = 0.4
"""Error of the pitch rate by the translation ahead over depth: the ground below is near."""

NETWORK: Final = np.array([0.2, 0.1, 0.1])
"""Error of a rate, as a share of its distance from that of the network."""

TREMBLE_RAD_S: Final = 0.04
"""Error of a rate of a camera in the air: it trembles within a window, while a refined rate changes evenly."""

DEPTH: Final = 0.6
"""Error of the velocity over the height of the camera, by the translation over depth: the depth is not known."""

TURNING: Final = 0.05
"""The same by the angular velocity [1/rad]."""

TILT_FLOOR_RAD_S: Final = 0.015
"""Root mean square rate of pitch and roll that search and network show where there is none."""

TILT: Final = np.array([3.0, 3.0, 0.0, 2.0, 4.0, 2.0])
"""Error of a motion over the ground (velocity over the height, rates) by the rate of pitch and roll: a camera that
tilts, and whose pitch the ground does not show, is not that of a vehicle."""

UNKNOWN_PITCH: Final = math.radians(4)
"""Sigma of the pitch from which on it is unknown."""

YAW: Final = np.array([0.0, 0.0, 0.0, 0.004, 0.0, 0.012])
"""Error of the rates of pitch and roll, as a share of the yaw rate."""

ASIDE_SPEED: Final = 0.03
"""Error of the sideways speed by the sideways acceleration [s]: it changes within the span."""

ASIDE_YAW: Final = 0.01
"""Error of the yaw rate by the sideways acceleration over the height of the camera [s]."""

SLOW_SHARE: Final = np.array([0.42, 0.33, 0.28, 0.55, 0.55, 0.3])
"""Share of the sigma of the search over the ground, for a camera that hardly moves: the search sees it better than its
curvature says."""

FAST_SHARE: Final = np.array([0.5, 0.85, 0.9, 0.85, 0.7, 0.65])
"""The same from SLOW on; linear between."""

SLOW: Final = 2.0
"""Speed over the height of the camera from which on it is fast [1/s]."""

SURE: Final = 2.0
"""Growth of the odds of a vehicle since their start (see `vehicle`) from which on these shares hold in full."""

UNSURE: Final = np.array([2.5, 3.0, 1.0, 4.0, 3.0, 3.0])
"""The same share while the odds are below their start: such a camera is often in the air."""


def of_rotation(motion: Array, covariance: Array, before: Array, network_rad_s: Array) -> Array:
    """Covariance (3, 3) of the angular velocity of a search by rotation.

    Args:
        motion: (6,) angular velocity [rad/s], and translation over depth [1/s].
        covariance: (6, 6) of it by the search.
        before: (6,) the motion of the window before; `motion` where there is none.
        network_rad_s: (3,) what the network says.
    """
    rate, shift = motion[:3], np.abs(motion[3:])
    change, shift_change = (float(np.linalg.norm(part)) for part in np.split(motion - before, 2))
    terms = [
        RATE_SHARE * np.full(3, np.linalg.norm(rate)),
        CHANGE * change,
        SHIFT_SQUARED * float(shift @ shift),
        SHIFT_CHANGE * shift_change,
        np.array([AHEAD * float(shift[2]), 0.0, 0.0]),
        NETWORK * np.abs(rate - network_rad_s),
        np.full(3, TREMBLE_RAD_S),
    ]
    return covariance[:3, :3] * np.outer(SEARCH_SHARE, SEARCH_SHARE) + np.diag(np.square(terms).sum(axis=0))


def of_unknown_depth(covariance: Array, shift: float, rate_rad_s: float, scale_m: float) -> Array:
    """Covariance (6, 6) of a twist whose linear part is the network's.

    Args:
        covariance: (6, 6) so far.
        shift: translation over depth that the events show [1/s]; 0 where nothing shows it.
        rate_rad_s: length of the angular velocity.
        scale_m: height of the camera, or what the linear part assumes.
    """
    more = (scale_m * math.hypot(DEPTH * shift, TURNING * rate_rad_s)) ** 2
    return covariance + np.diag([more] * 3 + [0.0] * 3)


def of_ground(twist: Array, covariance: Array, tilt: float, pitch_sigma: float, height_m: float, odds: float) -> Array:
    """Covariance (6, 6) of a motion over the ground.

    Args:
        twist: (6,) [m/s, rad/s].
        covariance: (6, 6) of it by the search.
        tilt: mean square rate of pitch and roll in the last second, before the search over the ground [rad^2/s^2].
        pitch_sigma: of the pitch [rad].
        height_m: of the camera.
        odds: logarithm of the odds that the camera is on a vehicle; below 0, the angular part is not used.
    """
    fast = min(1.0, float(np.linalg.norm(twist[:3])) / (SLOW * height_m))
    of_vehicle = SLOW_SHARE + (FAST_SHARE - SLOW_SHARE) * fast
    sure = min(max((odds - START) / SURE, 0.0), 1.0)
    shares = UNSURE if 0 <= odds < START else 1 + sure * (of_vehicle - 1)
    tilting = math.sqrt(max(0.0, tilt - TILT_FLOOR_RAD_S**2)) * min(1.0, pitch_sigma / UNKNOWN_PITCH)
    metres = np.array([height_m] * 3 + [1.0] * 3)
    aside_m_s2 = float(np.linalg.norm(twist[:3])) * abs(float(twist[4]))
    aside = np.array([ASIDE_SPEED * aside_m_s2, 0.0, 0.0, 0.0, ASIDE_YAW * aside_m_s2 / height_m, 0.0])
    terms = [TILT * metres * tilting, YAW * abs(float(twist[4])), aside]
    return covariance * np.outer(shares, shares) + np.diag(np.square(terms).sum(axis=0))
