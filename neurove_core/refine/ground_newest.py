"""The roll rate of the newest events over the ground.

A search has one motion for its span. The rate at which a vehicle rolls changes within that time, and the mean of the
span is old: the mean of 200 ms has a correlation of .76 with that of the newest 50 ms. The speed, the pitch of the
plane and the walls change less. So one Newton step from the motion of the span, with the events of the last NEWEST_US
alone, gives the roll rate of that time. The step may change the other unknowns a little, so that their errors do not
become a roll rate; what it says of them is not used, because a short time does not distinguish pitching from sinking.
"""

import math
from typing import Final

import numpy as np
from numpy.typing import NDArray

from neurove_core.refine.ground_kernels import Image, Rays
from neurove_core.refine.ground_search import UNKNOWNS, Prior, bent, motion_of

Array = NDArray[np.float64]

NEWEST_US: Final = 100_000
"""Time whose events are used. They are as many as those of a whole span: with half of them nothing is gained."""

FROM_M_S: Final = 1.0
"""Up to this speed the roll rate is that of the span: it is small there, and that of a short time has more noise."""

FULL_M_S: Final = 4.0
"""From this speed on it is that of the newest events alone; linear between."""

WEIGHT: Final = 0.03
"""Weight of the distance from the motion of the span. That of a search counts .02, for twice the time."""

_VELOCITY_M_S: Final = 0.1  # sigma of the change of the velocity
_RATE_RAD_S: Final = 0.1  # the same of each angular rate
_PITCH_RAD: Final = 0.01  # the same of the pitch of the plane
_WALL: Final = 0.03  # the same of the inverse distance of a wall [1/m]
_LONGEST: Final = 1.5  # greatest change of an unknown [sigma]
_FLAT: Final = 1e-12


def rates(rays: Rays, image: Image, unknowns: Array, pitch: float, height_m: float) -> Array:
    """The angular velocity (3,) of some events [rad/s].

    Args:
        rays: the newest events, with their time from the middle of the newest time.
        image: into which they are moved.
        unknowns: (9,) of the whole span, see `ground_search.UNKNOWNS`.
        pitch: of the plane that the depth of the rays belongs to [rad].
        height_m: of the camera above the ground.
    """
    turning, walls = [_RATE_RAD_S] * 3, [_WALL * height_m] * 2
    sigma = np.array([*[_VELOCITY_M_S / height_m] * 3, *turning, _PITCH_RAD, *walls])
    _, gradient, information = bent(np.zeros(UNKNOWNS), rays, image, Prior(unknowns, sigma, WEIGHT, pitch))
    step = np.linalg.solve(information + WEIGHT * np.eye(UNKNOWNS), gradient)
    step = step * min(1.0, _LONGEST / max(float(np.abs(step).max()), _FLAT))
    return motion_of(unknowns + sigma * step, pitch)[3:6]


def with_roll(twist: Array, newest_rad_s: Array, pitch: float) -> Array:
    """A twist (6,) with the roll rate of an angular velocity (3,), as far as its speed asks for it, see FULL_M_S.

    The roll is about the axis ahead along the ground; the yaw rate about the normal of the ground stays. `pitch` is
    that of the camera against the ground [rad].
    """
    c, s = math.cos(pitch), math.sin(pitch)
    share = min(max((float(np.linalg.norm(twist[:3])) - FROM_M_S) / (FULL_M_S - FROM_M_S), 0.0), 1.0)
    more = share * ((c * newest_rad_s[2] - s * newest_rad_s[1]) - (c * twist[5] - s * twist[4]))
    return np.array([*twist[:4], twist[4] - s * more, twist[5] + c * more])
