"""The bias of a gyroscope that moves: the events show how the camera turns, and gravity shows how it tilts.

A Kalman filter has six numbers: the specific force of gravity in the optical frame, and the bias. The gyroscope without
its bias turns the force. Two measurements correct both:

- The events: the gyroscope minus the angular velocity of a refined window is the bias. Estimates of the network alone
  do not count: it is blind to slow turns, and a slow pan would become bias.
- The accelerometer: its specific force minus the acceleration of the camera (dv/dt + w x v by the events) is that of
  gravity. Only with a known height of the camera, because otherwise the scale of v is not known.

Errors of the events last for many windows, so each window counts as a share 1 / CORRELATED of a measurement.
"""

from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from neurove_core.inertial.bias import DRIFT_RAD_S, Bias

CORRELATED: Final = 10.0
"""Windows in a row whose errors are alike."""

EVENTS_RAD_S: Final = 0.03
"""Standard deviation of the angular velocity by the events, in addition to the one that they claim."""

EVENTS_SHARE: Final = 0.6
"""The same, as a share of the angular velocity."""

FORCE_M_S2: Final = 1.0
"""Standard deviation of the force of gravity that one window shows."""

FIRST_FORCE_M_S2: Final = 2.0
"""The same in the first window."""

MAX_SIGMAS: Final = 4.0
"""A difference between gyroscope and events that is larger on some axis is no bias."""

MAX_GAP_US: Final = 1_000_000
"""After a longer time without a window the tilt is not known any more."""

_TURNED_M_S2: Final = 0.03  # growth of sigma of the force in one second, as the gyroscope is not exact
_STEPS: Final = 5  # windows over which the velocity is differentiated

Array = NDArray[np.float64]


class Tilt(NamedTuple):
    """State of the filter, beside the mean of the bias; arrays are never changed in place."""

    force_m_s2: Array | None = None  # (3,) specific force of gravity; None if it is not known
    covariance: Array | None = None  # (6, 6) of the force and the bias; None before the first window
    velocities_m_s: Array = np.empty((0, 3))  # of the newest windows
    end_us: int = 0  # of the newest window


class Seen(NamedTuple):
    """What one window showed."""

    end_us: int
    window_us: int
    gyro_rad_s: Array  # (3,) mean over the window, with the bias
    accel_m_s2: Array | None  # (3,) the same of the accelerometer; None without samples
    velocity_m_s: Array | None  # (3,) by the events; None if its scale is not known
    events_rad_s: Array | None  # (3,) angular velocity by the events; None if they were not refined
    variance: Array  # (3,) of it


def learned(bias: Bias, tilt: Tilt, seen: Seen) -> tuple[Bias, Tilt]:
    """The bias and the tilt after one more window."""
    mean, force, covariance, velocities = _predicted(bias, tilt, seen)
    if seen.velocity_m_s is not None and seen.accel_m_s2 is not None:
        velocities = np.concatenate([velocities, seen.velocity_m_s[None]])[-(_STEPS + 2) :]
    else:
        velocities = velocities[:0]
    if len(velocities) == _STEPS + 2 and seen.accel_m_s2 is not None:
        rate = (velocities[-2:].mean(0) - velocities[:2].mean(0)) / (_STEPS * seen.window_us * 1e-6)
        gravity = seen.accel_m_s2 - rate - np.cross(seen.gyro_rad_s - mean, velocities[-1])
        if force is None:
            force = gravity
            covariance[:3, :3] = np.eye(3) * FIRST_FORCE_M_S2**2
        else:
            change, covariance = _corrected(covariance, 0, gravity - force, np.full(3, FORCE_M_S2**2))
            force, mean = force + change[:3], mean + change[3:]
    if seen.events_rad_s is not None:
        off = seen.gyro_rad_s - seen.events_rad_s - mean
        turn = seen.gyro_rad_s - mean
        variance = seen.variance + EVENTS_RAD_S**2 + EVENTS_SHARE**2 * float(turn @ turn)
        if (off**2 <= MAX_SIGMAS**2 * (np.diagonal(covariance)[3:] + variance)).all():
            change, covariance = _corrected(covariance, 3, off, variance)
            force, mean = None if force is None else force + change[:3], mean + change[3:]
    now = bias._replace(mean_rad_s=mean, variance=np.diagonal(covariance)[3:].copy(), at_us=seen.end_us)
    return now, Tilt(force, covariance, velocities, seen.end_us)


def _predicted(bias: Bias, tilt: Tilt, seen: Seen) -> tuple[Array, Array | None, Array, Array]:
    """Bias, force, covariance and velocities before the measurements of a window."""
    if tilt.covariance is None or not 0 < seen.end_us - tilt.end_us <= MAX_GAP_US:
        covariance = np.zeros((6, 6))
        covariance[range(3, 6), range(3, 6)] = bias.variance_at(seen.end_us)
        return bias.mean_rad_s, None, covariance, tilt.velocities_m_s[:0]
    seconds = (seen.end_us - tilt.end_us) * 1e-6
    velocities = tilt.velocities_m_s if seen.end_us - tilt.end_us == seen.window_us else tilt.velocities_m_s[:0]
    force, covariance = tilt.force_m_s2, tilt.covariance + np.diag([0.0] * 3 + [DRIFT_RAD_S**2 * seconds] * 3)
    if force is not None:
        turn = (seen.gyro_rad_s - bias.mean_rad_s) * seconds
        moves = np.eye(6)
        moves[:3, :3] -= _cross(turn)
        moves[:3, 3:] = -_cross(force) * seconds
        force = force - np.cross(turn, force)
        covariance = moves @ covariance @ moves.T
        covariance[range(3), range(3)] += (_TURNED_M_S2 * seconds) ** 2
    return bias.mean_rad_s, force, covariance, velocities


def _corrected(covariance: Array, first: int, off: Array, variance: Array) -> tuple[Array, Array]:
    """The change (6,) of the state, and its covariance, by a measurement of three of its numbers.

    Args:
        covariance: (6, 6) before.
        first: of the three numbers.
        off: measurement minus expectation.
        variance: (3,) of one window, whose errors go on.
    """
    rows = slice(first, first + 3)
    gain = np.linalg.solve(covariance[rows, rows] + np.diag(variance * CORRELATED), covariance[rows]).T
    after = covariance - gain @ covariance[rows]
    return gain @ off, (after + after.T) / 2


def _cross(a: Array) -> Array:
    """The matrix of the cross product with a vector (3,)."""
    return np.array([[0.0, -a[2], a[1]], [a[2], 0.0, -a[0]], [-a[1], a[0], 0.0]])
