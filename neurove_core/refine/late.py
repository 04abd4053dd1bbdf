"""An answer over the ground belongs to the middle of its span; this module brings it to the newest window.

A vehicle that brakes, starts, or enters a bend is therefore answered late, by its acceleration times half the span. The
acceleration is the slope of a line through the newest answers, drawn towards zero by how uncertain it is: spans
overlap, so the errors of answers are alike, and a slope is less certain than their scatter says. The same holds for
the yaw rate.
"""

import math
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

ANSWERS: Final = 12
"""Newest answers in a row that make a slope, and LEAST of them at least."""

LEAST: Final = 8

INFLATION: Final = 16.0
"""Variance of a slope over that of independent answers."""

ACCELERATION_M_S2: Final = 1.0
"""Sigma of the acceleration of a vehicle before anything is known."""

MOST_M_S2: Final = 4.0
"""A greater slope is no acceleration, but a search that comes nearer to the motion."""

TURN_RAD_S2: Final = 0.4
"""The same sigma for the yaw rate."""

MOST_RAD_S2: Final = 2.0
"""The same bound for the yaw rate; a small vehicle begins a bend with 1.2 rad/s^2."""

Answers = tuple[tuple[float, float, float], ...]
"""Time [s] of the middle of the span, speed ahead [m/s] and yaw rate [rad/s], of the newest answers in a row, oldest
first."""


class Change(NamedTuple):
    """How much speed ahead and yaw rate change from the middle of the span to the middle of the window."""

    speed_m_s: float = 0.0
    sigma_m_s: float = 0.0
    yaw_rad_s: float = 0.0
    sigma_rad_s: float = 0.0


def change(answers: Answers, delay_s: float) -> Change:
    """The change after some answers, over a time; zero where they do not tell.

    Args:
        answers: the newest last.
        delay_s: from the middle of the newest span to the middle of the window.
    """
    if len(answers) < LEAST:
        return Change()
    times, speeds, rates = np.array(answers).T
    speed, sigma = _slope(times, speeds, ACCELERATION_M_S2, MOST_M_S2)
    yaw, yaw_sigma = _slope(times, rates, TURN_RAD_S2, MOST_RAD_S2)
    return Change(speed * delay_s, sigma * delay_s, yaw * delay_s, yaw_sigma * delay_s)


def _slope(times: NDArray[np.float64], values: NDArray[np.float64], known: float, most: float) -> tuple[float, float]:
    """The slope of some values (N,) over their times (N,), with the sigma `known` before, and its sigma."""
    times, values = times - times.mean(), values - values.mean()
    square = float(times @ times)
    slope = float(times @ values) / square
    if abs(slope) > most:
        return 0.0, 0.0
    rest = values - slope * times
    variance = INFLATION * float(rest @ rest) / (len(values) - 2) / square
    share = known**2 / (known**2 + variance)
    return share * slope, math.sqrt(share * variance)
