"""Waypoints of a camera at equal distances; a street is built along them. Only those near the camera are kept."""

from typing import Final, Protocol

import numpy as np
from numpy.typing import NDArray

STEP_M: Final = 2.0
"""Distance between two waypoints."""

_PERIOD_S: Final = 0.1  # sampling interval of the trajectory
_SPAN: Final = 200  # positions sampled at once
_STANDING_S: Final = 300.0  # after standing this long the camera counts as arrived


class CameraPath(Protocol):
    """The part of a trajectory that scenes and simulations need; see `trajectory.Trajectory`."""

    @property
    def name(self) -> str:
        """Short name for people."""

    @property
    def duration_s(self) -> float:
        """Duration; infinite for a trajectory without end."""

    def pose(self, t_s: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Position (N, 3) [m] in the world (x right, y down, z forward), rotation (N, 3, 3) camera to world."""

    def twist(self, t_s: NDArray[np.float64]) -> NDArray[np.float64]:
        """(N, 6) vx vy vz [m/s] wx wy wz [rad/s] in the optical frame."""


class Waypoints:
    """Waypoints of a trajectory on the ground, STEP_M apart, with straight extensions at its start and end.

    Args:
        trajectory: of the camera.
        reach_m: length of the path that is kept before and after the camera.
    """

    def __init__(self, trajectory: CameraPath, reach_m: float) -> None:
        self._trajectory, self._reach = trajectory, int(np.ceil(reach_m / STEP_M)) * STEP_M
        position, rotation = trajectory.pose(np.zeros(1))
        here = position[0, [0, 2]]
        ahead = rotation[0, [0, 2], 2]
        ahead = ahead / max(float(np.linalg.norm(ahead)), 1e-9)
        count = int(self._reach / STEP_M)
        self.first = -count  # number of the first kept waypoint; number n lies n * STEP_M along the path
        self.points = [here + ahead * STEP_M * k for k in range(-count, 1)]
        self._last, self._sampled_s, self._passed_s = (
            here,
            0.0,
            [0.0],
        )  # _passed_s: times at which waypoints 0, 1, ... are passed
        self._here, self._standing_s, self._over = 0, 0.0, False
        self._forgotten = 0

    def advance(self, t_s: float) -> int:
        """Extend the path to `reach_m` ahead of the camera at a time; times must not go backwards.

        Returns:
            the number of the last waypoint that was passed.
        """
        while True:
            passed = self._passed_s
            while self._here + 1 - self._forgotten < len(passed) and passed[self._here + 1 - self._forgotten] <= t_s:
                self._here += 1
            if (self.first + len(self.points) - 1 - self._here) * STEP_M >= self._reach:
                break
            self._extend()
        drop = self._here - int(self._reach / STEP_M) - self.first
        if drop > 0:
            del self.points[:drop]
            self.first += drop
        if self._here > self._forgotten:
            del self._passed_s[: self._here - self._forgotten]
            self._forgotten = self._here
        return self._here

    def array(self) -> NDArray[np.float64]:
        """The kept waypoints (N, 2), x and z."""
        return np.array(self.points)

    def _extend(self) -> None:
        """Add waypoints: of the trajectory, or straight on after its end."""
        if self._over:
            ahead = self.points[-1] - self.points[-2]
            self.points.append(self.points[-1] + ahead)
            self._passed_s.append(np.inf)
            return
        t_s = self._sampled_s + _PERIOD_S * np.arange(1, _SPAN + 1, dtype=np.float64)
        t_s = t_s[t_s <= self._trajectory.duration_s]
        self._over = t_s.size < _SPAN
        if not t_s.size:
            return
        self._sampled_s = float(t_s[-1])
        before = len(self.points)
        for when, point in zip(t_s.tolist(), self._trajectory.pose(t_s)[0][:, [0, 2]], strict=True):
            self._move_to(point, when)
        standing = 0.0 if len(self.points) > before else self._standing_s + _SPAN * _PERIOD_S
        self._standing_s = standing
        self._over |= standing >= _STANDING_S

    def _move_to(self, point: NDArray[np.float64], when_s: float) -> None:
        while (distance := float(np.linalg.norm(point - self._last))) >= STEP_M:
            self._last = self._last + (point - self._last) * (STEP_M / distance)
            self.points.append(self._last)
            self._passed_s.append(when_s)
