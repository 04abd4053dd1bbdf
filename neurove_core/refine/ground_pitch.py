"""Pitch of a camera against the ground, as a state that is learned slowly, by the events alone.

The most probable motion of a window has a pitch that the network's speed helped to find. The error of that speed lasts
for many windows, and a narrow lens shows speed and pitch alike. If each window taught the pitch with it, the pitch
would come to explain the error. So the network's speed has a small weight in what is learned.
"""

import math
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from neurove_core.refine.ground_search import UNKNOWNS, Prior

Array = NDArray[np.float64]

SPEED_SHARE: Final = 0.02
"""Share of the weight of the network's speed."""

MAX_CHANGE: Final = 0.5
"""Greatest change of the pitch by that share [prior sigma]: the curvature holds near the most probable motion alone."""

DRIFT: Final = math.radians(0.2)
"""Growth of the sigma from window to window [rad]."""

LEAST_SIGMA: Final = math.radians(0.5)


class Pitch(NamedTuple):
    """A pitch with its uncertainty [rad], positive downwards."""

    mean: float
    sigma: float


def by_events(z: Array, information: Array, prior: Prior) -> Pitch:
    """The pitch of one search, if the network's speed counts less.

    Args:
        z: (9,) the most probable unknowns, distance from the prior's mean [sigma].
        information: (9, 9) of the events about them, see `ground_search.bent`.
        prior: of the search.
    """
    weight = np.full(UNKNOWNS, prior.weight)
    weight[2] *= SPEED_SHARE
    inverse = np.linalg.inv(information + np.diag(weight))
    free = inverse @ (information @ z + prior.weight * z)  # where the gradient vanishes with these weights
    pitch = z[6] + np.clip(free[6] - z[6], -MAX_CHANGE, MAX_CHANGE)
    sigma = math.sqrt(prior.weight * float(inverse[6, 6])) * float(prior.sigma[6])
    return Pitch(prior.pitch + float(prior.mean[6] + prior.sigma[6] * pitch), sigma)


def learned(before: Pitch, found: Pitch, share: float, most: float) -> Pitch:
    """The pitch for the next window, by a Kalman filter.

    Args:
        before: what was known.
        found: what a search says with it.
        share: of the events of the search that are new.
        most: sigma when nothing is known [rad].
    """
    known = before.sigma**-2
    after = max(min(found.sigma, before.sigma), 1e-4) ** -2
    new = (after - known) * share
    moved = (found.mean - before.mean) / max(1 - known / after, 1e-3)  # what the events alone say
    sigma = max((known + new) ** -0.5, LEAST_SIGMA)
    return Pitch(before.mean + new / (known + new) * moved, min(math.hypot(sigma, DRIFT), most))
