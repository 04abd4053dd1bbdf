"""Whether a camera is on a vehicle that drives over level ground: a sequential test of the outcomes of `ground`.

The ground at its known height explains the events of a vehicle in nearly each window. Those of a camera in a hand or on
a drone it explains now and then only. So each outcome adds the logarithm of its likelihood ratio to the odds that the
camera is on a vehicle. The odds are bounded, so a camera that is taken from its vehicle is noticed after some windows.

The alignment of a single window does not decide: a slow camera high above the ground moves the image by less than a
cell in 50 ms, and there a scene whose depth is free fits better than the ground also where the ground is right.

Source: Wald 1945 (sequential probability ratio test). Differs: the odds are bounded, and the test never ends.
"""

from typing import Final

from neurove_core.refine.ground import Outcome

EVIDENCE: Final[dict[Outcome, float]] = {
    "accepted": 0.25,
    "turning": 0.0,
    "tilting": -1.0,
    "few events": 0.0,
    "noise": 0.0,
    "contradicted": -0.65,
    "standing": 0.0,
}
"""Logarithm of the likelihood ratio of each outcome, vehicle over free camera, by the length of the runs in which it
comes. A window without events that move says nothing. Measured on own seeds, see decision 132."""

START: Final = 3.0
"""Odds of a camera with a known height before anything is seen: who gives a height says that the ground is level."""

MOST: Final = 8.0
"""Bound of the odds on both sides."""


def judged(odds: float, outcome: Outcome) -> float:
    """The logarithm of the odds that the camera is on a vehicle, after an outcome of `ground.refine`."""
    return min(max(odds + EVIDENCE[outcome], -MOST), MOST)
