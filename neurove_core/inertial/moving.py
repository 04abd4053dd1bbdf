"""The bias of a gyroscope that moves: the events show how the camera turns, and gravity shows how it tilts.

A Kalman filter has nine numbers: the specific force of gravity in the optical frame, the bias, and the force that the
camera has on average. The gyroscope without its bias turns the force. Three measurements correct them:

- The events: the gyroscope minus the angular velocity of a refined window is the bias. Estimates of the network alone
  do not count: it is blind to slow turns, and a slow pan would become bias.
- The accelerometer: its specific force minus the acceleration of the camera (dv/dt + w x v by the events) is that of
  gravity. Only with a known height of the camera, because otherwise the scale of v is not known.
- A vehicle: its tilt stays bounded, so the force is that on average. It shows the bias of the level axes where the
  accelerometer cannot: braking looks like tilt. A camera in a hand tilts as it likes.

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

SWAY_M_S2: Final = 0.15
"""Standard deviation of the force of gravity by the tilt of a vehicle: 0.9 deg of springs and bumps."""

SLOPE_M_S2: Final = 0.1
"""Standard deviation of the change of its average in one second, by the slope of the road: 1 %."""

RAMP_SIGMAS: Final = 3.0
"""A force that differs by more from its average on some axis is that of a new slope."""

MAX_SIGMAS: Final = 4.0
"""A difference between gyroscope and events that is larger on some axis is no bias."""

MAX_GAP_US: Final = 1_000_000
"""After a longer time without a window the tilt is not known any more."""

_TURNED_M_S2: Final = 0.03  # growth of sigma of the force in one second, as the gyroscope is not exact
_STEPS: Final = 5  # windows over which the velocity is differentiated
_FORCE, _BIAS, _AVERAGE = slice(0, 3), slice(3, 6), slice(6, 9)  # places of the nine numbers

Array = NDArray[np.float64]


class Tilt(NamedTuple):
    """State of the filter, beside the mean of the bias; arrays are never changed in place."""

    force_m_s2: Array | None = None  # (3,) specific force of gravity; None if it is not known
    covariance: Array | None = None  # (9, 9) of the force, the bias and the average; None before the first window
    velocities_m_s: Array = np.empty((0, 3))  # of the newest windows
    end_us: int = 0  # of the newest window
    average_m_s2: Array | None = None  # (3,) of the force; None if the camera is on no vehicle, or it is not known


class Seen(NamedTuple):
    """What one window showed."""

    end_us: int
    window_us: int
    gyro_rad_s: Array  # (3,) mean over the window, with the bias
    accel_m_s2: Array | None  # (3,) the same of the accelerometer; None without samples
    velocity_m_s: Array | None  # (3,) by the events; None if its scale is not known
    events_rad_s: Array | None  # (3,) angular velocity by the events; None if they were not refined
    variance: Array  # (3,) of it
    vehicle: bool = False  # the camera is on a vehicle


class _State(NamedTuple):
    """The nine numbers: force, bias and average; without a known force or average its rows of the covariance are 0."""

    numbers: Array  # (9,)
    covariance: Array  # (9, 9)
    forced: bool  # the force is known
    averaged: bool  # the average is known


def learned(bias: Bias, tilt: Tilt, seen: Seen) -> tuple[Bias, Tilt]:
    """The bias and the tilt after one more window."""
    now, velocities = _predicted(bias, tilt, seen)
    if seen.velocity_m_s is not None and seen.accel_m_s2 is not None:
        velocities = np.concatenate([velocities, seen.velocity_m_s[None]])[-(_STEPS + 2) :]
    else:
        velocities = velocities[:0]
    if len(velocities) == _STEPS + 2 and seen.accel_m_s2 is not None:
        rate = (velocities[-2:].mean(0) - velocities[:2].mean(0)) / (_STEPS * seen.window_us * 1e-6)
        gravity = seen.accel_m_s2 - rate - np.cross(seen.gyro_rad_s - now.numbers[_BIAS], velocities[-1])
        now = _forced(now, gravity) if now.forced else _first_forced(now, gravity)
    now = _level(now, vehicle=seen.vehicle)
    if seen.events_rad_s is not None:
        turn = seen.gyro_rad_s - now.numbers[_BIAS]
        off = turn - seen.events_rad_s
        variance = seen.variance + EVENTS_RAD_S**2 + EVENTS_SHARE**2 * float(turn @ turn)
        if (off**2 <= MAX_SIGMAS**2 * (np.diagonal(now.covariance)[_BIAS] + variance)).all():
            now = _corrected(now, np.eye(9)[_BIAS], off, variance)
    force, mean, average = now.numbers.reshape(3, 3)
    found = Tilt(
        force if now.forced else None, now.covariance, velocities, seen.end_us, average if now.averaged else None
    )
    variance = np.diagonal(now.covariance)[_BIAS].copy()
    return bias._replace(mean_rad_s=mean, variance=variance, at_us=seen.end_us), found


def _predicted(bias: Bias, tilt: Tilt, seen: Seen) -> tuple[_State, Array]:
    """The state and the velocities before the measurements of a window."""
    numbers = np.zeros(9)
    numbers[_BIAS] = bias.mean_rad_s
    if tilt.covariance is None or not 0 < seen.end_us - tilt.end_us <= MAX_GAP_US:
        covariance = np.zeros((9, 9))
        covariance[range(3, 6), range(3, 6)] = bias.variance_at(seen.end_us)
        return _State(numbers, covariance, forced=False, averaged=False), tilt.velocities_m_s[:0]
    seconds = (seen.end_us - tilt.end_us) * 1e-6
    velocities = tilt.velocities_m_s if seen.end_us - tilt.end_us == seen.window_us else tilt.velocities_m_s[:0]
    covariance = tilt.covariance + np.diag([0.0] * 3 + [DRIFT_RAD_S**2 * seconds] * 3 + [0.0] * 3)
    if tilt.force_m_s2 is not None:
        turn = (seen.gyro_rad_s - bias.mean_rad_s) * seconds
        moves = np.eye(9)
        moves[_FORCE, _FORCE] -= _cross(turn)
        moves[_FORCE, _BIAS] = -_cross(tilt.force_m_s2) * seconds
        numbers[_FORCE] = tilt.force_m_s2 - np.cross(turn, tilt.force_m_s2)
        covariance = moves @ covariance @ moves.T
        covariance[range(3), range(3)] += (_TURNED_M_S2 * seconds) ** 2
    if tilt.average_m_s2 is not None:
        numbers[_AVERAGE] = tilt.average_m_s2
        covariance[range(6, 9), range(6, 9)] += SLOPE_M_S2**2 * seconds
    return _State(numbers, covariance, tilt.force_m_s2 is not None, tilt.average_m_s2 is not None), velocities


def _first_forced(state: _State, gravity: Array) -> _State:
    numbers, covariance = state.numbers.copy(), state.covariance.copy()
    numbers[_FORCE] = gravity
    covariance[_FORCE, _FORCE] = np.eye(3) * FIRST_FORCE_M_S2**2
    return state._replace(numbers=numbers, covariance=covariance, forced=True)


def _forced(state: _State, gravity: Array) -> _State:
    return _corrected(state, np.eye(9)[_FORCE], gravity - state.numbers[_FORCE], np.full(3, FORCE_M_S2**2))


def _level(state: _State, *, vehicle: bool) -> _State:
    """The state after what a vehicle shows by its bounded tilt; its average begins with the force, and on each ramp."""
    numbers = state.numbers
    if vehicle and state.averaged:
        off = numbers[_AVERAGE] - numbers[_FORCE]
        shows = np.eye(9)[_FORCE] - np.eye(9)[_AVERAGE]
        expected = np.diagonal(shows @ state.covariance @ shows.T) + SWAY_M_S2**2
        if (off**2 <= RAMP_SIGMAS**2 * expected).all():
            return _corrected(state, shows, off, np.full(3, SWAY_M_S2**2))
    if vehicle and state.forced:
        copies = np.eye(9)
        copies[_AVERAGE, _FORCE], copies[_AVERAGE, _AVERAGE] = np.eye(3), 0.0
        covariance = copies @ state.covariance @ copies.T
        covariance[range(6, 9), range(6, 9)] += SWAY_M_S2**2
        return state._replace(numbers=copies @ numbers, covariance=covariance, averaged=True)
    if state.averaged:  # it is on no vehicle any more
        covariance = state.covariance.copy()
        covariance[_AVERAGE] = covariance[:, _AVERAGE] = 0.0
        return state._replace(covariance=covariance, averaged=False)
    return state


def _corrected(state: _State, shows: Array, off: Array, variance: Array) -> _State:
    """The state after a measurement.

    Args:
        state: before.
        shows: (3, 9) what the measurement is of the numbers.
        off: (3,) measurement minus expectation.
        variance: (3,) of one window, whose errors go on.
    """
    part = shows @ state.covariance
    gain = np.linalg.solve(part @ shows.T + np.diag(variance * CORRELATED), part).T
    after = state.covariance - gain @ part
    return state._replace(numbers=state.numbers + gain @ off, covariance=(after + after.T) / 2)


def _cross(a: Array) -> Array:
    """The matrix of the cross product with a vector (3,)."""
    return np.array([[0.0, -a[2], a[1]], [a[2], 0.0, -a[0]], [-a[1], a[0], 0.0]])
