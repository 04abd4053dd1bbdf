"""Motion: from poses to twists, smoothing, and interpolation between samples."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from neurove_core.geometry import rotations
from neurove_protocol.errors import InvalidField

MAX_GAP_US = 500_000
"""Longest gap between two samples that is interpolated [us]; the slowest ground truth we know has 200 ms."""

_BLOCK = 1 << 15  # poses that are fitted at once: about 20 MB


class Poses(NamedTuple):
    """Poses of a camera, ordered by time: its optical frame (x right, y down, z forward) in a world frame."""

    t: NDArray[np.int64]  # (N,) sensor clock [us]
    position_m: NDArray[np.float64]  # (N, 3) position of the camera in the world
    orientation: NDArray[np.float64]  # (N, 4) unit quaternion x y z w: rotates from the camera frame to the world frame


class Twists(NamedTuple):
    """Twists of a camera, ordered by time, in its own optical frame (x right, y down, z forward)."""

    t: NDArray[np.int64]  # (N,) sensor clock [us]
    twist: NDArray[np.float64]  # (N, 6) vx vy vz [m/s] wx wy wz [rad/s]; nan where unknown

    def at(self, t_us: NDArray[np.int64], max_gap_us: int = MAX_GAP_US) -> NDArray[np.float64]:
        """The twists (M, 6) at any times (M,) [us], interpolated linearly between the two neighbouring samples.

        They are nan before the first sample, after the last, and in gaps longer than `max_gap_us`.
        """
        first, fraction = _between(self.t, np.asarray(t_us, np.int64), max_gap_us)
        if not self.t.size:
            return np.full((first.size, 6), np.nan)
        a, b = self.twist[first], self.twist[np.minimum(first + 1, self.t.size - 1)]
        with np.errstate(invalid="ignore"):
            between = a + fraction[:, None] * (b - a)
        # at the time of a sample only that sample counts, even if its neighbour is nan
        return np.where(fraction[:, None] == 0, a, np.where(fraction[:, None] == 1, b, between))


def filter_for(poses: Poses) -> float:
    """Default filter length of `twists` [s]: ten sampling intervals (median), at least 0.1 s.

    Pose noise is independent per sample, so the number of samples sets the remaining noise. The length is 0.5 s for
    odometry at 20 Hz and 0.1 s for motion capture at 100 Hz or more.
    """
    return max(0.1, 10 * float(np.median(np.diff(poses.t))) / 1e6) if poses.t.size > 1 else 0.1


def twists(poses: Poses, *, filter_s: float | None = None) -> Twists:
    """The camera's twist at each pose, in the camera frame at that time.

    The filter window of a pose holds the poses within half a filter length. Their motions relative to the pose are
    expressed as screws (logarithms in SE(3)). An unweighted least-squares fit of a parabola in time to the screws gives
    the twist: its slope at the pose. A motion of constant twist is therefore recovered exactly with any sampling, and
    the result does not depend on the world frame. Within half a filter length of an end or a gap the window is
    one-sided, and the noise there is up to four times as large. The filter passes a sine of frequency 0.3 / filter_s
    with gain 0.91, and one of 0.8 / filter_s with gain 0.49.

    Args:
        poses: ordered by time, without duplicate times.
        filter_s: length of the centred window [s]; the default is filter_for(poses).

    Returns:
        one twist per pose; nan where the window holds fewer than three poses, or they span less than a quarter of it.

    Raises:
        InvalidField: times do not increase, a quaternion does not have unit length, a number is not finite, or
            filter_s <= 0.
    """
    screw, rate = _fits(poses, filter_s)
    return Twists(poses.t, rotations.body_twist(screw, rate))


def smoothed(poses: Poses, *, filter_s: float | None = None) -> Poses:
    """The poses smoothed by the filter of `twists`: the value of the fitted parabola instead of its slope.

    Args:
        poses: as for `twists`.
        filter_s: as for `twists`.

    Raises:
        InvalidField: as `twists`.
    """
    screw, _ = _fits(poses, filter_s)
    screw = np.nan_to_num(screw)  # a pose stays as it is if its window holds too few others
    q, offset = rotations.pose_of(screw)
    position = poses.position_m + rotations.turn(poses.orientation, offset)
    return Poses(poses.t, position, rotations.product(poses.orientation, q))


def interpolate_poses(poses: Poses, t_us: NDArray[np.int64], max_gap_us: int = MAX_GAP_US) -> Poses:
    """The poses at any times (M,) [us]: positions interpolated linearly, orientations by slerp.

    They are nan before the first pose, after the last, and in gaps longer than `max_gap_us`.
    """
    t_us = np.asarray(t_us, np.int64)
    first, fraction = _between(poses.t, t_us, max_gap_us)
    if not poses.t.size:
        return Poses(t_us, np.full((t_us.size, 3), np.nan), np.full((t_us.size, 4), np.nan))
    second = np.minimum(first + 1, poses.t.size - 1)
    a, b = poses.position_m[first], poses.position_m[second]
    orientation = rotations.slerp(poses.orientation[first], poses.orientation[second], fraction)
    return Poses(t_us, a + fraction[:, None] * (b - a), orientation)


def check_poses(poses: Poses) -> None:
    """Check that poses form a valid trajectory.

    Raises:
        InvalidField: times do not increase, the length of a quaternion differs from 1 by 1 % or more, or a number is
            not finite; the error names the first wrong pose.
    """
    norm = np.linalg.norm(poses.orientation, axis=1)
    for field, bad, values, bound in (
        ("position_m", ~np.isfinite(poses.position_m).all(axis=1), poses.position_m, "must be finite"),
        ("orientation", ~(np.abs(norm - 1) < 0.01), norm, "must be a quaternion of length 1"),
        ("t", np.diff(poses.t, prepend=poses.t[:1] - 1) <= 0, poses.t, "times must increase"),
    ):
        if bad.any():
            index = int(bad.argmax())
            raise InvalidField(f"pose {index}", field, values[index].tolist(), bound)


def _between(
    t: NDArray[np.int64], t_us: NDArray[np.int64], max_gap_us: int
) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """For each time the index of the sample before it, and the fraction (0 to 1) of the way to the next sample.

    The fraction is nan where one of the two samples is missing or the gap is too long.
    """
    if not t.size:
        return np.zeros(t_us.size, np.int64), np.full(t_us.size, np.nan)
    first = np.clip(np.searchsorted(t, t_us, side="right") - 1, 0, max(t.size - 2, 0))
    gap = t[np.minimum(first + 1, t.size - 1)] - t[first]
    on = t_us - t[first]
    fraction = np.divide(on, gap, out=np.where(on == 0, 0.0, np.nan), where=gap > 0)
    known = (on >= 0) & (on <= gap) & ((gap <= max_gap_us) | (on == 0) | (on == gap))
    return first, np.where(known, fraction, np.nan)


def _fits(poses: Poses, filter_s: float | None) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """The fitted screw (N, 6) at each pose, relative to the pose itself, and the rate of the screw (N, 6) [1/s]."""
    check_poses(poses)
    filter_s = filter_for(poses) if filter_s is None else filter_s
    if not 0 < filter_s < 1e6:
        raise InvalidField("twists", "filter_s", filter_s, "must be above 0 s")
    screw, rate = np.empty((2, poses.t.size, 6))
    for start in range(0, poses.t.size, _BLOCK):
        block = np.arange(start, min(start + _BLOCK, poses.t.size))
        screw[block], rate[block] = _fit(poses, block, filter_s * 5e5)
    return screw, rate


def _fit(poses: Poses, i: NDArray[np.int64], half_us: float) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """As _fits, for the poses of indices i (N,)."""
    first = np.searchsorted(poses.t, poses.t[i] - half_us, side="left")
    last = np.searchsorted(poses.t, poses.t[i] + half_us, side="right") - 1
    moments, sums = np.zeros((i.size, 5)), np.zeros((i.size, 3, 6))
    for offset in range(int((first - i).min()), int((last - i).max()) + 1):
        row = np.flatnonzero((i + offset >= first) & (i + offset <= last))
        j = i[row] + offset
        tau = (poses.t[j] - poses.t[i[row]])[:, None] / half_us
        moments[row] += tau ** np.arange(5)
        sums[row] += (tau ** np.arange(3))[:, :, None] * _relative(poses, i[row], j)[:, None, :]
    known = (last - first >= 2) & (poses.t[last] - poses.t[first] >= 0.5 * half_us)
    fit = np.full((i.size, 3, 6), np.nan)
    hankel = moments[:, np.add.outer(np.arange(3), np.arange(3))]
    fit[known] = np.linalg.solve(hankel[known], sums[known])
    return fit[:, 0], fit[:, 1] / (half_us / 1e6)


def _relative(poses: Poses, i: NDArray[np.int64], j: NDArray[np.int64]) -> NDArray[np.float64]:
    """Screws (M, 6) from poses i to poses j, in the frames of i."""
    back = rotations.inverse(poses.orientation[i])
    q = rotations.product(back, poses.orientation[j])
    return rotations.screw_of(q, rotations.turn(back, poses.position_m[j] - poses.position_m[i]))
