"""Trajectories with exact derivatives: a constant twist, a spline, and a mounted camera."""

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike, NDArray

from neurove_core.geometry import rotations
from neurove_core.geometry.motion import Poses, Twists
from neurove_protocol.errors import InvalidField

Array = NDArray[np.float64]


class Trajectory(ABC):
    """Pose and twist of a camera at any time from 0 s to its duration; twice continuously differentiable.

    The axes of the world are x right, y down, z forward, as those of the camera at the start of a drive. The pose is
    that of the optical frame of a camera that is nominally level and at its nominal height, y = 0. All methods accept
    times of any shape (...).
    """

    __slots__ = ()

    name: str
    duration_s: float  # inf: the trajectory never ends

    @abstractmethod
    def position_orientation(self, t_s: ArrayLike) -> tuple[Array, Array]:
        """Position (..., 3) [m] and orientation as unit quaternion (..., 4) x y z w, camera to world.

        Raises:
            InvalidField: a time is before 0 s or after the duration.
        """

    @abstractmethod
    def twist(self, t_s: ArrayLike) -> Array:
        """Exact twist (..., 6), vx vy vz [m/s] wx wy wz [rad/s], in the camera's optical frame at that time.

        Raises:
            InvalidField: as `position_orientation`.
        """

    def pose(self, t_s: ArrayLike) -> tuple[Array, Array]:
        """Position (..., 3) [m] and rotation matrix (..., 3, 3), camera to world.

        Raises:
            InvalidField: as `position_orientation`.
        """
        position, q = self.position_orientation(t_s)
        return position, rotations.matrix_of(q)

    def poses(self, t_us: NDArray[np.int64]) -> Poses:
        """The poses at these times (N,) [us] since the start."""
        return Poses(t_us, *self.position_orientation(t_us / 1e6))

    def twists(self, t_us: NDArray[np.int64]) -> Twists:
        """The exact twists at these times (N,) [us] since the start."""
        return Twists(t_us, self.twist(t_us / 1e6))

    def _within(self, t_s: ArrayLike) -> Array:
        t = np.asarray(t_s, np.float64)
        outside = ~((t >= 0) & (t <= self.duration_s + 1e-9))  # in this form nan counts as outside
        if outside.any():
            value = float(t[outside][0])
            raise InvalidField(f"trajectory {self.name}", "t_s", value, f"must be 0 to {self.duration_s:g} s")
        return t


@dataclass(frozen=True, slots=True)
class ScrewTrajectory(Trajectory):
    """A constant twist without end: stationary, straight, turning in place, or a helix."""

    name: str
    constant: tuple[float, ...]  # vx vy vz [m/s] wx wy wz [rad/s]
    duration_s: float = math.inf

    def position_orientation(self, t_s: ArrayLike) -> tuple[Array, Array]:
        """See `Trajectory`."""
        q, position = rotations.pose_of(np.array(self.constant) * self._within(t_s)[..., None])
        return position, q

    def twist(self, t_s: ArrayLike) -> Array:
        """See `Trajectory`."""
        return np.broadcast_to(np.array(self.constant), (*self._within(t_s).shape, 6)).copy()


@dataclass(frozen=True, slots=True)
class SplineTrajectory(Trajectory):
    """A uniform cubic B-spline of positions and of quaternions, which are normalised.

    The spline passes through the first and the last knot, and near the others (at a sixth of the second difference). It
    needs no system of equations and does not overshoot. Where five knots are equal, the camera is stationary.
    """

    name: str
    duration_s: float
    step_s: float  # time between knots
    control: Array = field(
        repr=False
    )  # (knots + 2, 7) position and quaternion; one extra row before and after the knots

    @classmethod
    def through(
        cls, name: str, step_s: float, position: Array, orientation: Array, duration_s: float = math.inf
    ) -> "SplineTrajectory":
        """Create the spline of these knots.

        Args:
            name: of the trajectory.
            step_s: time between knots [s].
            position: (N, 3) [m], N >= 2.
            orientation: (N, 4) unit quaternions, of either sign.
            duration_s: end of the trajectory; at most, and by default, the last knot.
        """
        dots = (orientation[1:] * orientation[:-1]).sum(axis=1)
        signs = np.concatenate([[1.0], np.cumprod(np.where(dots < 0, -1.0, 1.0))])
        knots = np.concatenate([position, orientation * signs[:, None]], axis=1)
        before, after = 2 * knots[:1] - knots[1:2], 2 * knots[-1:] - knots[-2:-1]
        whole_s = step_s * (len(knots) - 1)
        return cls(name, min(duration_s, whole_s), step_s, np.concatenate([before, knots, after]))

    def position_orientation(self, t_s: ArrayLike) -> tuple[Array, Array]:
        """See `Trajectory`."""
        value, _ = self._evaluate(t_s)
        q = value[..., 3:]
        return value[..., :3], q / np.linalg.norm(q, axis=-1, keepdims=True)

    def twist(self, t_s: ArrayLike) -> Array:
        """See `Trajectory`."""
        value, rate = self._evaluate(t_s)
        squared = (value[..., 3:] ** 2).sum(-1, keepdims=True)
        back = rotations.inverse(value[..., 3:])
        v = rotations.turn(back / np.sqrt(squared), rate[..., :3])
        # with s = |s| q, the part of ds/dt along s changes only |s|; it is the scalar of conj(s) ds/dt, left out here
        w = 2 * rotations.product(back, rate[..., 3:])[..., :3] / squared
        return np.concatenate([v, w], axis=-1)

    def _evaluate(self, t_s: ArrayLike) -> tuple[Array, Array]:
        """Value (..., 7) of the spline, and its derivative [1/s]."""
        at = self._within(t_s) / self.step_s
        first = np.clip(at.astype(np.int64), 0, len(self.control) - 4)
        u = (at - first)[..., None]
        values = np.concatenate([(1 - u) ** 3, (3 * u - 6) * u**2 + 4, ((3 - 3 * u) * u + 3) * u + 1, u**3], -1) / 6
        rates = np.concatenate([-((1 - u) ** 2), (3 * u - 4) * u, (2 - 3 * u) * u + 1, u**2], -1) / (2 * self.step_s)
        near = self.control[first[..., None] + np.arange(4)]
        return (values[..., None] * near).sum(-2), (rates[..., None] * near).sum(-2)


@dataclass(frozen=True, slots=True)
class Mounted(Trajectory):
    """A trajectory for a camera at a height above the ground plane y = 0 and with a pitch on its mount.

    The optical centre is that of the trajectory, shifted upwards. Its linear velocity is therefore the same vector, in
    a rotated frame.
    """

    trajectory: Trajectory
    height_m: float
    pitch_deg: float = 0.0  # positive: downwards

    def __post_init__(self) -> None:
        if not 0 <= self.height_m <= 1000:  # in this form nan fails
            raise InvalidField("camera mount", "height_m", self.height_m, "must be 0 to 1000 m")
        if not -90 <= self.pitch_deg <= 90:
            raise InvalidField("camera mount", "pitch_deg", self.pitch_deg, "must be -90 to 90 degrees")

    @property
    def name(self) -> str:  # type: ignore[override]  # read here, never set
        """As the trajectory without mount."""
        return self.trajectory.name

    @property
    def duration_s(self) -> float:  # type: ignore[override]  # read here, never set
        """As the trajectory without mount."""
        return self.trajectory.duration_s

    @property
    def _mount(self) -> Array:
        """Quaternion (4,) from the axes of the mounted camera to those of the level camera."""
        return rotations.exp(np.array([-math.radians(self.pitch_deg), 0.0, 0.0]))

    def position_orientation(self, t_s: ArrayLike) -> tuple[Array, Array]:
        """See `Trajectory`; the ground is at y = 0, and the camera above it has a negative y."""
        position, q = self.trajectory.position_orientation(t_s)
        return position - np.array([0.0, self.height_m, 0.0]), rotations.product(q, self._mount)

    def twist(self, t_s: ArrayLike) -> Array:
        """See `Trajectory`."""
        twist = self.trajectory.twist(t_s)
        both = twist.reshape(*twist.shape[:-1], 2, 3)
        return rotations.turn(rotations.inverse(self._mount), both).reshape(twist.shape)
