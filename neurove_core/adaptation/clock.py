"""The offset between the clock of a robot's odometry and that of its event camera, from motion that both show."""

from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from neurove_core.geometry.motion import Twists

STEP_US: Final = 10_000
CLEAR: Final = 0.6
"""Least correlation between events and truth at which an offset is believed."""

LEAST_US: Final = 30_000
"""A smaller offset is not corrected: the estimates themselves are not more exact in time."""

LEAST_GAIN: Final = 0.02
"""Least gain of correlation for a correction."""

_LEAST_STD: Final = np.array([0.1, 0.1, 0.15, 0.03, 0.03, 0.03])  # [m/s, rad/s]: an axis that varies less shows nothing
_LEAST_SAMPLES: Final = 200
_EDGE: Final = 2  # steps: a maximum so close to the end of the search is none

Array = NDArray[np.float64]


class Offset(NamedTuple):
    """How far the truth is behind the events: add `us` to its times."""

    us: int
    agreement: float  # correlation with this offset
    before: float  # correlation without it


def find_offset(t_us: NDArray[np.int64], estimate: Array, truth: Twists, most_us: int = 2_000_000) -> Offset | None:
    """Find the offset with the greatest correlation, averaged over the axes that move.

    A constant gain or bias of the estimates does not change a correlation, so a model that is wrong in scale still
    shows the offset.

    Args:
        t_us: (N,) times of the estimates on the clock of the events.
        estimate: (N, 6) twists.
        truth: twists of the same camera; nan where unknown.
        most_us: greatest offset that is searched for.

    Returns:
        the offset, in steps refined by a parabola; None if no axis shows motion in both, or the maximum is not clear.
    """
    steps = np.arange(-most_us // STEP_US, most_us // STEP_US + 1)
    curves = np.stack([_correlations(t_us, estimate, truth, int(step) * STEP_US) for step in steps])
    clear = np.nan_to_num(curves, nan=-1.0).max(0) > CLEAR
    if not clear.any():
        return None
    mean = np.where(np.isnan(curves[:, clear]), -1.0, curves[:, clear]).mean(1)
    best = int(mean.argmax())
    if not _EDGE <= best < len(steps) - _EDGE or mean[best] < CLEAR:
        return None
    below, at, above = mean[best - 1 : best + 2]
    bend = below - 2 * at + above
    fraction = 0.5 * (below - above) / bend if bend < 0 else 0.0
    return Offset(round((steps[best] + fraction) * STEP_US), float(at), float(mean[len(steps) // 2]))


def _correlations(t_us: NDArray[np.int64], estimate: Array, truth: Twists, offset_us: int) -> Array:
    """Correlation (6) of each axis with the truth moved by an offset; nan where the axis shows no motion."""
    true = truth.at(t_us - offset_us)
    found = np.full(6, np.nan)
    for axis in range(6):
        known = np.isfinite(true[:, axis])
        if np.count_nonzero(known) < _LEAST_SAMPLES:
            continue
        a, b = estimate[known, axis], true[known, axis]
        if b.std() > _LEAST_STD[axis] and a.std() > 0:
            found[axis] = np.corrcoef(a, b)[0, 1]
    return found
