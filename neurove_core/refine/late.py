"""An answer over the ground belongs to the middle of its span; this module brings it to the newest window.

A vehicle that brakes or starts is therefore answered late, by its acceleration times half the span. The acceleration is
the slope of a line through the newest answers, drawn towards zero by how uncertain it is: spans overlap, so the
errors of answers are alike, and a slope is less certain than their scatter says.
"""

import math
from typing import Final, NamedTuple

import numpy as np

ANSWERS: Final = 12
"""Newest answers in a row that make a slope, and LEAST of them at least."""

LEAST: Final = 8

INFLATION: Final = 16.0
"""Variance of a slope over that of independent answers."""

ACCELERATION_M_S2: Final = 1.0
"""Sigma of the acceleration of a vehicle before anything is known."""

MOST_M_S2: Final = 4.0
"""A greater slope is no acceleration, but a search that comes nearer to the motion."""

Answers = tuple[tuple[float, float], ...]
"""Time [s] of the middle of the span, and speed ahead [m/s], of the newest answers in a row, oldest first."""


class Change(NamedTuple):
    """How much the speed ahead changes from the middle of the span to the middle of the window."""

    speed_m_s: float = 0.0
    sigma_m_s: float = 0.0


def change(answers: Answers, delay_s: float) -> Change:
    """The change after some answers, over a time; zero where they do not tell.

    Args:
        answers: the newest last.
        delay_s: from the middle of the newest span to the middle of the window.
    """
    if len(answers) < LEAST:
        return Change()
    times, speeds = np.array(answers).T
    times, speeds = times - times.mean(), speeds - speeds.mean()
    square = float(times @ times)
    slope = float(times @ speeds) / square
    rest = speeds - slope * times
    variance = INFLATION * float(rest @ rest) / (len(answers) - 2) / square
    if abs(slope) > MOST_M_S2:
        return Change()
    share = ACCELERATION_M_S2**2 / (ACCELERATION_M_S2**2 + variance)
    return Change(share * slope * delay_s, math.sqrt(share * variance) * delay_s)
