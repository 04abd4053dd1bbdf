"""Standing: a vehicle that came to a stop is known by the events that it no longer makes.

After a stop, the few events of noise that are left tell the network nothing, and its state goes on with a speed of its
own. But moving edges make events: a camera whose last motion over the ground was slow, and whose window has a fraction
of the events of `low_activity`, hardly moves. So the network's twist gets a second measurement, of zero, and both are
fused by their covariances. Its sigma is proportional to the events. When they grow again, it is also at most what a
vehicle gains since it stood.

Few events alone do not tell a stop: dark ground or lost data look alike. A vehicle cannot stop at once, so the motion
over the ground has to have become slow before.
"""

from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

SLOW: Final = 0.5
"""Greatest speed over the height of the camera of a slow motion [1/s]."""

FEW: Final = 0.25
"""Greatest number of events at a stop, over that below which a window is `low_activity`."""

SPEED: Final = 1.0
"""Sigma of the speed over the height of the camera, where the events are just as many as low activity asks [1/s].
Streets make so many at 0.3 (own seeds, see decision 134)."""

RATE: Final = 0.1
"""The same of the angular velocity [rad/s]."""

SPEED_FLOOR: Final = 0.02
"""Least sigma of the speed over the height [1/s]."""

RATE_FLOOR: Final = 0.005
"""The same of the angular velocity [rad/s]."""

ACCELERATION_M_S2: Final = 1.5
"""Sigma of the acceleration of a vehicle that starts."""

TURN_RAD_S2: Final = 0.5
"""The same for its angular velocity."""

SIGMAS: Final = 2.0
"""A motion that is faster than SLOW by so many sigmas is not slow."""

UNSEEN: Final = 0.05
"""Speed over its sigma at which a speed of the network is halved. Where it sees next to nothing, it says 0.1 heights
a second, with a sigma of 1.4 to 1.7, whether the camera stands or crawls (decision 167)."""

KEPT_US: Final = 500_000
"""Time after which an answer or a stop says nothing of the present."""


class Standing(NamedTuple):
    """What is known of a stop."""

    slow_us: int | None = None  # end of the newest window with a slow motion over the ground, or at a stop
    stood_us: int | None = None  # end of the newest window at a stop
    few: bool = False  # whether the newest window has FEW events
    sigma_m_s: float | None = None  # of the speed in the newest window; None if no stop is known


class Held(NamedTuple):
    """A twist by the network and by what is known of a stop."""

    twists: Array  # (n, 6) [m/s, rad/s]
    covariance: Array  # (6, 6) of each of them
    standing: Standing


def hold(twists: Array, covariance: Array, end_us: int, share: float, height_m: float, before: Standing) -> Held:
    """Fuse the twists of a window with the measurement that the camera stands, where a stop is known.

    Args:
        twists: (n, 6) of the network [m/s, rad/s].
        covariance: (6, 6) of each of them.
        end_us: end of the window.
        share: number of its events over that below which it is `low_activity`.
        height_m: of the camera.
        before: what was known.
    """
    slow_us, stood_us = (None if one is None or end_us - one > KEPT_US else one for one in before[:2])
    few = share < FEW
    if few and slow_us is not None:
        slow_us, stood_us = end_us, end_us
    if stood_us is None:
        return Held(twists, covariance, Standing(slow_us, None, few))
    speed_m_s, rate_rad_s = height_m * SPEED * share, RATE * share
    if not few:
        since_s = (end_us - stood_us) / 1e6
        speed_m_s, rate_rad_s = min(speed_m_s, ACCELERATION_M_S2 * since_s), min(rate_rad_s, TURN_RAD_S2 * since_s)
    sigma = [max(speed_m_s, SPEED_FLOOR * height_m)] * 3 + [max(rate_rad_s, RATE_FLOOR)] * 3
    stands = np.diag(np.square(sigma))
    both = np.linalg.inv(covariance + stands)
    fused = stands @ both @ covariance
    return Held(twists @ both @ stands, (fused + fused.T) / 2, Standing(slow_us, stood_us, few, sigma[0]))


def outweighs(standing: Standing, sigma_m_s: float) -> bool:
    """Whether a stop is more certain than a motion over the ground whose speed ahead has this sigma."""
    return standing.sigma_m_s is not None and standing.sigma_m_s < sigma_m_s


def answered(standing: Standing, end_us: int, speed: float, sigma: float) -> Standing:
    """What is known of a stop after a motion over the ground was accepted.

    Args:
        standing: what was known before.
        end_us: end of the window.
        speed: of the motion over the height [1/s].
        sigma: of the speed. An answer that may be slow as well does not end what is known: the few events of a vehicle
            that comes to a stop leave the answer to the network.
    """
    if speed - SIGMAS * sigma > SLOW:
        return Standing(few=standing.few)
    if speed > SLOW:
        return standing
    return standing._replace(slow_us=end_us, stood_us=standing.stood_us if standing.few else None)


def towards_zero(twists: Array, covariance: Array) -> Array:
    """Twists (n, 6) of the network whose linear part is shrunk where it is small against its sigma.

    A network that sees nothing answers with the mean of what it learned. Its sigma shows that, and stays as it is.

    Args:
        twists: (n, 6) of the network [m/s, rad/s].
        covariance: (6, 6) of each of them.
    """
    mean = twists[:, :3].mean(axis=0)
    square = float(mean @ mean)
    share = square / (square + UNSEEN**2 * float(np.trace(covariance[:3, :3])) + 1e-12)
    shrunk: Array = twists * np.repeat([share, 1.0], 3)
    return shrunk
