"""The offset between the clock of a robot's odometry and that of its event camera, from motion that both show.

A gyro on the camera shows turning without delay. Without one, the estimates of the model show it, but a recurrent
network follows a change of speed late: by up to 0.36 s on own seeds 20041 to 20045. An offset below
`Seen.least_us` is therefore reported as none.
"""

from collections.abc import Iterable
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from neurove_core.geometry.motion import Twists
from neurove_core.io import Imu

STEP_US: Final = 10_000
MOST_US: Final = 3_000_000
"""Greatest offset that is searched for."""

CLEAR: Final = 0.6
"""Least correlation at which an offset is believed."""

_MODEL_STD: Final = np.array([0.1, 0.1, 0.15, 0.03, 0.03, 0.03])  # [m/s, rad/s]: an axis that varies less shows nothing
_MODEL_LEAST_US: Final = 500_000
_GYRO_STD: Final = np.array([0.03])  # [rad/s]
_GYRO_LEAST_US: Final = 20_000
_LEAST_SAMPLES: Final = 200
_EDGE: Final = 2  # steps: a maximum so close to the end of the search is none

Array = NDArray[np.float64]


class Seen(NamedTuple):
    """Motion on the clock of the events."""

    t_us: NDArray[np.int64]  # (N,)
    values: Array  # (N, 6) twists, or (N, 1) rate of turning [rad/s]
    least_std: Array  # of each column
    least_us: int  # a smaller offset is none
    source: str


class Offset(NamedTuple):
    """How far the truth is behind the events: add `us` to its times."""

    us: int
    agreement: float  # correlation with this offset
    before: float  # correlation without it


def seen_by_model(t_us: NDArray[np.int64], twists: Array) -> Seen:
    """Motion as a model estimates it: times (N,) and twists (N, 6)."""
    return Seen(t_us, twists, _MODEL_STD, _MODEL_LEAST_US, "the model's estimates")


def seen_by_gyro(batches: Iterable[Imu]) -> Seen | None:
    """The rate of turning that a gyro shows, in means of STEP_US; None without samples.

    Its length needs no mounting of the gyro.
    """
    found = list(batches)
    if not found:
        return None
    t = np.concatenate([one.t for one in found])
    rate = np.linalg.norm(np.concatenate([one.gyro_rad_s for one in found]), axis=1)
    cell = (t - t[0]) // STEP_US
    counts = np.bincount(cell)
    held = counts > 0
    mean = np.bincount(cell, rate)[held] / counts[held]
    centres = t[0] + (np.flatnonzero(held) * STEP_US) + STEP_US // 2
    return Seen(centres, mean[:, None], _GYRO_STD, _GYRO_LEAST_US, "the gyro")


def find_offset(seen: Seen, truth: Twists) -> Offset | None:
    """Find the offset with the greatest correlation, averaged over the columns that move.

    A constant gain or bias does not change a correlation, so a model that is wrong in scale still shows the offset.

    Args:
        seen: motion on the clock of the events.
        truth: twists of the same camera; nan where unknown.

    Returns:
        the offset, refined by a parabola; None if no column shows motion in both, or the maximum is not clear.
    """
    steps = np.arange(-MOST_US // STEP_US, MOST_US // STEP_US + 1)
    curves = np.stack([_correlations(seen, truth, int(step) * STEP_US) for step in steps])
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


def _correlations(seen: Seen, truth: Twists, offset_us: int) -> Array:
    """Correlation of each column with the truth moved by an offset; nan where it shows no motion."""
    true = truth.at(seen.t_us - offset_us)
    if seen.values.shape[1] == 1:
        true = np.linalg.norm(true[:, 3:], axis=1)[:, None]
    found = np.full(true.shape[1], np.nan)
    for column, least in enumerate(seen.least_std):
        known = np.isfinite(true[:, column])
        if np.count_nonzero(known) < _LEAST_SAMPLES:
            continue
        a, b = seen.values[known, column], true[known, column]
        if b.std() > least and a.std() > 0:
            found[column] = np.corrcoef(a, b)[0, 1]
    return found
