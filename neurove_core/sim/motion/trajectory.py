"""Trajectories by name: generated from a seed, of constant velocity, or from a file of poses."""

import math
from pathlib import Path
from typing import Final
from urllib.parse import parse_qsl

import numpy as np
from numpy.typing import NDArray

from neurove_core.geometry import rotations
from neurove_core.geometry.motion import Poses, check_poses, filter_for, interpolate_poses, smoothed
from neurove_core.io.formats.pose_files import read_poses
from neurove_core.sim.motion.curves import Mounted, ScrewTrajectory, SplineTrajectory, Trajectory
from neurove_core.sim.motion.generated import driving, hand_held
from neurove_protocol.errors import InvalidField

__all__ = [
    "TRAJECTORIES",
    "Mounted",
    "ScrewTrajectory",
    "SplineTrajectory",
    "Trajectory",
    "driving",
    "from_poses",
    "hand_held",
    "parse_trajectory",
    "rotation",
    "slider",
    "still",
]

Array = NDArray[np.float64]

TRAJECTORIES: Final = (
    "driving?seed=0",
    "handheld?seed=0",
    "still",
    "rotation?wx=0&wy=0.5&wz=0",
    "slider?vx=0.3&vy=0&vz=0",
    "a file of poses, FILE?start=0&smooth=0.5&flat=1",
)
"""Trajectories that `parse_trajectory` accepts, each with its defaults or an example."""

MAX_SECONDS: Final = 86_400.0
MAX_RATE: Final = 100.0  # [m/s] or [rad/s]
DRIVE_M: Final = 50.0
"""A recorded path that spans more than this counts as a drive."""

_FLAT_S: Final = 4.0  # hills are slower than this; pitching on the suspension is faster


def still(seconds: float = math.inf) -> ScrewTrajectory:
    """A stationary camera."""
    return ScrewTrajectory("still", (0.0,) * 6, seconds)


def rotation(wx: float, wy: float, wz: float, seconds: float = math.inf) -> ScrewTrajectory:
    """A camera that turns in place at a constant rate [rad/s]."""
    return ScrewTrajectory("rotation", (0.0, 0.0, 0.0, wx, wy, wz), seconds)


def slider(vx: float, vy: float = 0.0, vz: float = 0.0, seconds: float = math.inf) -> ScrewTrajectory:
    """A camera that moves at a constant velocity [m/s] without turning."""
    return ScrewTrajectory("slider", (vx, vy, vz, 0.0, 0.0, 0.0), seconds)


def from_poses(
    poses: Poses, name: str = "poses", *, smooth_s: float | None = None, flat: bool | None = None
) -> SplineTrajectory:
    """Create a smooth trajectory along recorded poses, from the first to the last (less at most a fifth of the filter).

    The poses pass the filter of geometry.twists (window `smooth_s`), which gives the knots of a spline at every fifth
    of the window. The trajectory is not exactly the recorded path, but its twist is exact.

    The world is rotated and shifted, not scaled. The camera is level on average (the mean of its down axis is y), and:
    - A drive, or any path with `flat`, starts at the origin and looks along z at first. Hills are removed: slow changes
      (over some seconds) are subtracted from the height and from the tilt of the camera, so that a level ground stays
      below it. This also removes a constant pitch or roll of the recorded camera; see Mounted.
    - Any other path looks along z on average, and its mean position is the origin.

    Args:
        poses: of the optical frame of the camera in any world; without gaps above 0.5 s.
        name: of the trajectory.
        smooth_s: length of the filter [s]; by default geometry.filter_for(poses).
        flat: whether to remove hills; by default only if the path spans more than DRIVE_M.

    Raises:
        InvalidField: the poses are invalid, too few, or have a gap; or smooth_s is not above 0 s.
    """
    check_poses(poses)
    smooth_s = filter_for(poses) if smooth_s is None else smooth_s
    if not 0 < smooth_s <= 60:
        raise InvalidField("trajectory", "smooth", smooth_s, "must be above 0 s and at most 60 s")
    knots = _knots(poses, smooth_s)
    if flat is None:
        flat = bool(np.ptp(knots.position_m, axis=0).max() > DRIVE_M)
    position, q = _level(knots, flat)
    if flat:
        position, q = _without_hills(position, q, smooth_s / 5)
    return SplineTrajectory.through(name, smooth_s / 5, position, q)


def _knots(poses: Poses, smooth_s: float) -> Poses:
    """Filtered poses at equal times."""
    if poses.t.size < 3 or poses.t[-1] - poses.t[0] < smooth_s * 1e6:
        raise InvalidField(
            "trajectory", "poses", poses.t.size, f"must be at least 3, over more than the {smooth_s:g} s of the filter"
        )
    t = np.arange(poses.t[0], poses.t[-1] + 1, smooth_s * 2e5).astype(np.int64)
    knots = interpolate_poses(smoothed(poses, filter_s=smooth_s), t)
    if np.isnan(knots.position_m).any():
        gap = int(np.isnan(knots.position_m[:, 0]).argmax())
        at_s = float(t[gap] - t[0]) / 1e6
        raise InvalidField("trajectory", "t", at_s, "a gap of more than 0.5 s between poses cannot be filled")
    return knots


def _level(knots: Poses, drive: bool) -> tuple[Array, Array]:
    """Position and orientation in the world that `from_poses` describes."""
    q, position = knots.orientation, knots.position_m
    axes = rotations.matrix_of(q)
    forward = axes[0, :, 2] if drive else axes[:, :, 2].mean(axis=0)
    down = axes[:, :, 1].mean(axis=0)
    down, length = down / max(float(np.linalg.norm(down)), 1e-9), float(np.linalg.norm(down))
    right = np.cross(down, forward)
    if length < 0.3 or np.linalg.norm(right) < 0.1:  # it looks in all directions: use the axes of the first pose
        turned = rotations.inverse(q[0])
    else:
        right /= np.linalg.norm(right)
        turned = rotations.quaternion_of(np.stack([right, down, np.cross(right, down)]))
    origin = position[0] if drive else position.mean(axis=0)
    return rotations.turn(turned, position - origin), rotations.product(turned, q)


def _without_hills(position: Array, q: Array, step_s: float) -> tuple[Array, Array]:
    """Remove changes of height and tilt that are slower than some seconds; heading and ground track stay."""
    down = _slow(rotations.turn(q, np.array([0.0, 1.0, 0.0])), step_s)
    down /= np.linalg.norm(down, axis=1, keepdims=True)
    y = np.array([0.0, 1.0, 0.0])
    # the shortest rotation from the slow part of the down axis to y
    back = np.concatenate([np.cross(down, y), 1 + down @ y[:, None]], axis=1)
    back /= np.linalg.norm(back, axis=1, keepdims=True)
    flat = position.copy()
    flat[:, 1] -= _slow(position[:, 1:2], step_s)[:, 0]
    return flat, rotations.product(back, q)


def _slow(values: Array, step_s: float) -> Array:
    """Smooth each column over some seconds, with a bell-shaped kernel; mirrored at the ends."""
    half = min(max(1, round(_FLAT_S / step_s)), len(values) - 1)
    kernel = np.hanning(2 * half + 3)[1:-1]
    first, last = values[:1], values[-1:]
    padded = np.concatenate([2 * first - values[half:0:-1], values, 2 * last - values[-2 : -half - 2 : -1]])
    return np.stack([np.convolve(c, kernel / kernel.sum(), mode="valid") for c in padded.T], axis=1)


def parse_trajectory(text: str, seconds: float | None = None) -> Trajectory:
    """Create a trajectory from a name or from a file of poses; see TRAJECTORIES.

    >>> parse_trajectory("rotation?wy=0.5").twist(1.0).tolist()
    [0.0, 0.0, 0.0, 0.0, 0.5, 0.0]

    Args:
        text: a name or a path, with its parameters as in the query of a URL.
        seconds: duration of a generated trajectory without `seconds=`.

    Raises:
        InvalidField: the name or a parameter is unknown, a value is out of bounds, or the file contains no path.
    """
    name, _, query = text.rpartition("?") if "?" in text else (text, "", "")
    given = _Parameters(text, query)
    seconds = given.optional("seconds", 1e-3, MAX_SECONDS) or seconds
    match name:
        case "driving" | "handheld":
            seed = given.whole("seed", 0)
            given.done()
            if name == "driving":
                return driving(seed) if seconds is None else driving(seed, seconds)
            return hand_held(seed) if seconds is None else hand_held(seed, seconds)
        case "still" | "rotation" | "slider":
            letter = {"still": "", "rotation": "w", "slider": "v"}[name]
            x, y, z = (given.number(letter + axis, 0.0, -MAX_RATE, MAX_RATE) if letter else 0.0 for axis in "xyz")
            given.done()
            constant = (x, y, z, 0.0, 0.0, 0.0) if letter == "v" else (0.0, 0.0, 0.0, x, y, z)
            return ScrewTrajectory(name, constant, math.inf if seconds is None else seconds)
        case _:
            return _from_file(name, given, seconds)


def _from_file(name: str, given: "_Parameters", seconds: float | None) -> SplineTrajectory:
    """Create the trajectory along the poses of a file, from `start` seconds after the first pose on."""
    path = Path(name)
    if not path.is_file():
        known = "; ".join(TRAJECTORIES)
        raise InvalidField(
            "trajectory", "name", name, f"neither a known trajectory nor a file; known trajectories: {known}"
        )
    start = given.number("start", 0.0, 0.0, 1e6)
    smooth = given.optional("smooth", 1e-3, 60.0)
    flat = given.optional("flat", 0, 1)
    given.done()
    poses = read_poses(path)
    since = (poses.t - poses.t[:1]) / 1e6
    keep = (since >= start) & (
        since <= start + (seconds or math.inf) + 0.5
    )  # the filter needs some poses after the end
    if not keep.any():
        raise InvalidField("trajectory", "start", start, f"{path} lasts {since[-1] if since.size else 0:g} s")
    part = Poses(poses.t[keep], poses.position_m[keep], poses.orientation[keep])
    whole = from_poses(part, path.stem, smooth_s=smooth, flat=None if flat is None else flat > 0)
    lasting = min(whole.duration_s, seconds or math.inf)
    return SplineTrajectory(whole.name, lasting, whole.step_s, whole.control)


class _Parameters:
    """The given parameters; each is read once, and unread ones are refused."""

    def __init__(self, text: str, query: str) -> None:
        self._text = text
        self._values = dict(parse_qsl(query, keep_blank_values=True))

    def optional(self, field: str, low: float, high: float) -> float | None:
        """The parameter as a number within these bounds, or None if it is not given."""
        text = self._values.pop(field, None)
        if text is None:
            return None
        try:
            value = float(text)
        except ValueError:
            value = math.nan
        if not low <= value <= high:  # in this form nan fails
            raise InvalidField(f"trajectory {self._text}", field, text, f"must be a number from {low:g} to {high:g}")
        return value

    def number(self, field: str, default: float, low: float, high: float) -> float:
        """The parameter as a number within these bounds."""
        value = self.optional(field, low, high)
        return default if value is None else value

    def whole(self, field: str, default: int) -> int:
        """The parameter as an integer of at least 0."""
        text = self._values.pop(field, str(default))
        if not (text.isascii() and text.isdecimal() and len(text) < 10):
            bound = "must be an integer of at most 9 digits"
            raise InvalidField(f"trajectory {self._text}", field, text, bound)
        return int(text)

    def done(self) -> None:
        """Refuse parameters that were not read."""
        for field, value in self._values.items():
            raise InvalidField(f"trajectory {self._text}", field, value, "this trajectory has no such parameter")
