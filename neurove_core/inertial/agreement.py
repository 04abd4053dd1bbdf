"""Events against gyroscope: do both turn alike, about the same axes, with the same sign, at the same time?

For each window of the last seconds the track has the angular velocity that the events gave, and the angle that the
gyroscope turned through. Their correlation over shifted times gives the time offset between both clocks. A network
that is nearly blind to an axis has no correlation there, so for it only a correlation of the wrong sign counts.
"""

from itertools import permutations
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

GRID_US: Final = 5_000
"""Resolution of the angles of the gyroscope."""

LAG_US: Final = 100_000
"""Largest time offset that is looked for."""

WINDOWS: Final = 160
"""Windows that are compared."""

FEWEST: Final = 40
"""Fewer windows are not judged."""

EVERY: Final = 10
"""Windows from one judgement to the next."""

EXCITED_RAD_S: Final = 0.1
"""Least standard deviation of a turn that is compared."""

WRONG: Final = -0.4
"""A correlation below this has the wrong sign."""

CLEAR: Final = 0.7
"""A correlation above this is a clear match."""

UNLIKE: Final = 0.3
"""Below this, events that were refined do not follow the gyroscope."""

OFFSET_SIGMA_US: Final = 5_000
"""An offset with a larger standard deviation is not reported."""

LATE_US: Final = 30_000
"""A larger time offset disagrees: the gyroscope would spoil the estimate."""

_WING = 4  # steps of the grid from the maximum to both other points of its parabola
_CORRELATED = 4  # windows in a row whose errors are alike

Array = NDArray[np.float64]


class Track(NamedTuple):
    """Windows and angles of the last seconds; arrays are never changed in place."""

    start_us: NDArray[np.int64] = np.empty(0, np.int64)  # (K,) of the windows
    end_us: NDArray[np.int64] = np.empty(0, np.int64)  # (K,)
    events_rad_s: Array = np.empty((0, 3))  # (K, 3) mean angular velocity that the events gave
    refined: NDArray[np.bool_] = np.empty(0, np.bool_)  # (K,) by contrast maximisation, not by the network alone
    grid_us: NDArray[np.int64] = np.empty(0, np.int64)  # (G,) times of the angles, GRID_US apart
    angle_rad: Array = np.empty((0, 3))  # (G, 3) that the gyroscope turned through, from the first one on
    since: int = 0  # windows since the newest judgement


class Agreement(NamedTuple):
    """What the comparison says."""

    offset_us: float | None = None  # by which the gyroscope's times are late; None if it is unclear
    correlation: float | None = None  # of both at this offset; None without a turn to compare
    why: str = ""  # in which way they disagree; empty if they do not


def add_window(track: Track, start_us: int, end_us: int, events_rad_s: Array, *, refined: bool) -> Track:
    """Add the angular velocity (3,) that the events of a window gave."""
    first = max(0, track.start_us.size + 1 - WINDOWS)
    return track._replace(
        start_us=np.append(track.start_us[first:], start_us),
        end_us=np.append(track.end_us[first:], end_us),
        events_rad_s=np.concatenate([track.events_rad_s[first:], events_rad_s[None]]),
        refined=np.append(track.refined[first:], refined),
        since=track.since + 1,
    )


def add_angles(track: Track, grid_us: NDArray[np.int64], angle_rad: Array) -> Track:
    """Add angles at the next times of the grid; they begin anew where times are missing.

    Args:
        track: so far.
        grid_us: (M,) multiples of GRID_US; the first one may be the last of the track.
        angle_rad: (M, 3) from the first of them on.
    """
    if not grid_us.size:
        return track
    if track.grid_us.size and grid_us[0] == track.grid_us[-1]:
        grid_us, angle_rad = grid_us[1:], angle_rad[1:] - angle_rad[0] + track.angle_rad[-1]
        grid_us = np.concatenate([track.grid_us, grid_us])
        angle_rad = np.concatenate([track.angle_rad, angle_rad])
    kept = 20_000_000 // GRID_US
    return track._replace(grid_us=grid_us[-kept:], angle_rad=angle_rad[-kept:])


def judge(track: Track) -> Agreement:
    """Compare the newest windows of a track."""
    lags = np.arange(-LAG_US, LAG_US + 1, GRID_US)
    if not track.grid_us.size:
        return Agreement()
    inside = (track.start_us - LAG_US >= track.grid_us[0]) & (track.end_us + LAG_US <= track.grid_us[-1])
    if np.count_nonzero(inside) < FEWEST:
        return Agreement()
    start_us, end_us = track.start_us[inside], track.end_us[inside]
    events = _centred(track.events_rad_s[inside])
    refined = bool(track.refined[inside].mean() > 0.5)
    gyro = _between(track, start_us + lags[:, None], end_us + lags[:, None])  # (L, K, 3)
    gyro -= gyro.mean(axis=1, keepdims=True)
    middle = lags.size // 2
    excited = gyro[middle].std(0) > EXCITED_RAD_S
    if not excited.any():
        return Agreement()
    visible = excited & (events.std(0) > 0.2 * gyro[middle].std(0))  # axes to which the events are not blind
    joint = np.array([_correlation(events[:, visible], one[:, visible]) for one in gyro])
    best = int(np.argmax(joint))
    offset_us = _peak_us(joint, lags, best, events[:, visible].size / _CORRELATED)
    if offset_us is not None and abs(offset_us) > LATE_US:
        late = f"{abs(offset_us) / 1e3:.0f} ms {'late' if offset_us > 0 else 'early'}"
        return Agreement(offset_us, float(joint[best]), f"the times of the gyroscope are {late}")
    at = gyro[best if offset_us is not None else middle]
    matrix = np.array([[_correlation(events[:, [i]], at[:, [j]]) for j in range(3)] for i in range(3)])
    return Agreement(offset_us, float(joint[best]), _wrong(matrix, visible, excited, joint[best], refined=refined))


def _wrong(
    matrix: Array, visible: NDArray[np.bool_], excited: NDArray[np.bool_], joint: float, *, refined: bool
) -> str:
    """Why the axes do not match.

    Args:
        matrix: (3, 3) correlation of each axis of the events with each axis of the gyroscope.
        visible: (3,) axes that turn, and to which the events are not blind.
        excited: (3,) axes of the gyroscope that turn.
        joint: correlation over all of them.
        refined: whether the events were refined.
    """
    diagonal = np.diagonal(matrix)
    for order in permutations(range(3)):
        swapped = [i for i in range(3) if order[i] != i and excited[order[i]]]
        if swapped and all(abs(matrix[i, order[i]]) > CLEAR and abs(diagonal[i]) < UNLIKE for i in swapped):
            pairs = ", ".join(f"{'xyz'[order[i]]} of the gyroscope is {'xyz'[i]} of the camera" for i in swapped)
            return f"axes are exchanged: {pairs}"
    reversed_axes = [axis for axis, r, tells in zip("xyz", diagonal, visible, strict=True) if tells and r < WRONG]
    if reversed_axes:
        return f"the gyroscope turns the other way about {' and '.join(reversed_axes)}"
    if refined and visible.any() and joint < UNLIKE:
        return f"the events do not turn as the gyroscope does (correlation {joint:.2f})"
    return ""


def _between(track: Track, start_us: NDArray[np.int64], end_us: NDArray[np.int64]) -> Array:
    """Mean angular velocity (..., 3) of the gyroscope over some spans (...) within the grid [rad/s]."""
    angles = [
        np.stack([np.interp(t_us, track.grid_us, axis) for axis in track.angle_rad.T], -1)
        for t_us in (start_us, end_us)
    ]
    return np.asarray((angles[1] - angles[0]) / ((end_us - start_us) * 1e-6)[..., None])


def _centred(values: Array) -> Array:
    return np.asarray(values - values.mean(0))


def _correlation(a: Array, b: Array) -> float:
    """Correlation of two centred signals over all of their axes; 0 if one of them does not vary."""
    power = float((a * a).sum() * (b * b).sum())
    return float((a * b).sum()) / np.sqrt(power) if power > 1e-24 else 0.0


def _peak_us(joint: Array, lags: NDArray[np.int64], best: int, values: float) -> float | None:
    """The offset at a clear maximum of the correlation; None without one.

    A parabola through three values gives the offset. Its standard deviation is that of a delay between two signals with
    independent errors, sqrt(2 (1 - r) / (n c)), with the curvature c of the correlation r at its maximum.

    Args:
        joint: correlation at each lag.
        lags: [us].
        best: index of the maximum.
        values: number n of independent values that were compared.
    """
    if not _WING <= best < lags.size - _WING or joint[best] < CLEAR:
        return None
    before, at, after = joint[[best - _WING, best, best + _WING]]
    curvature = (2 * at - before - after) / (_WING * GRID_US) ** 2
    if curvature <= 0 or 2 * max(0.0, 1 - at) / (values * curvature) > OFFSET_SIGMA_US**2:
        return None
    return float(lags[best] + 0.5 * (after - before) / (curvature * _WING * GRID_US))
