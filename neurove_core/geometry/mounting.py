"""Where a camera sits on a robot, and the camera's twist from that of the robot's base.

The base has the axes of REP 103: x forward, y left, z up. The camera has its optical frame: x right, y down, z forward.
"""

from typing import NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from neurove_core.geometry import rotations
from neurove_core.geometry.motion import Twists
from neurove_protocol.errors import InvalidField

Array = NDArray[np.float64]

_LEVEL = np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]])  # base from camera, for a level camera that looks forward
_SLACK = 1e-2
_FORWARD = 0.5  # cosine: a camera that looks more than 60 degrees to the side does not see forward speed as its vz


class Mounting(NamedTuple):
    """Pose of a camera in the base of its robot."""

    rotation: Array  # (3, 3) turns vectors from the camera's optical frame to the base
    position_m: Array  # (3) of the camera in the base [m]

    @classmethod
    def from_angles(
        cls,
        roll_deg: float = 0.0,
        pitch_deg: float = 0.0,
        yaw_deg: float = 0.0,
        position_m: tuple[float, float, float] = (0.0, 0.0, 0.0),
    ) -> Self:
        """A camera that looks forward, turned by angles.

        Args:
            roll_deg: about the direction of sight, clockwise as the camera sees it [deg].
            pitch_deg: down [deg].
            yaw_deg: left [deg].
            position_m: of the camera in the base [m].

        >>> Mounting.from_angles(pitch_deg=90).rotation.round(6)[:, 2] + 0.0  # looks down
        array([ 0.,  0., -1.])
        """
        roll, pitch, yaw = np.radians([roll_deg, pitch_deg, yaw_deg])
        turns = [
            rotations.matrix_of(rotations.exp(np.array([angle])))
            for angle in ([roll, 0, 0], [0, pitch, 0], [0, 0, yaw])
        ]
        x, y, z = (turn[0] for turn in turns)
        return cls(z @ y @ x @ _LEVEL, np.array(position_m, np.float64))

    @classmethod
    def from_numbers(cls, what: str, numbers: list[float]) -> Self:
        """A camera from the 16 numbers of a matrix (4, 4), or from x y z qx qy qz qw: camera to base.

        Args:
            what: source of the numbers, for errors.
            numbers: positions in metres.

        Raises:
            InvalidField: another count, a number that is not finite, or no rotation.
        """
        values = np.array(numbers, np.float64)
        if values.size not in (7, 16):
            bound = "expected the 16 numbers of a matrix (4, 4), or x y z qx qy qz qw"
            raise InvalidField(what, "numbers", values.size, bound)
        if not np.isfinite(values).all():
            raise InvalidField(what, "numbers", numbers, "must be finite")
        if values.size == 7:
            length = float(np.linalg.norm(values[3:]))
            if abs(length - 1) > _SLACK:
                raise InvalidField(what, "|quaternion|", length, f"must be 1 to within {_SLACK}")
            return cls(rotations.matrix_of(values[None, 3:] / length)[0], values[:3])
        matrix = values.reshape(4, 4)
        rotation = matrix[:3, :3]
        skew = float(np.abs(rotation @ rotation.T - np.eye(3)).max())
        if skew > _SLACK or np.linalg.det(rotation) < 0 or np.abs(matrix[3] - (0, 0, 0, 1)).max() > 1e-6:
            raise InvalidField(what, "matrix", matrix.tolist(), "a rotation, a translation and the row 0 0 0 1")
        return cls(rotation, matrix[:3, 3])

    def of_base(self, base: Twists) -> Twists:
        """The twists of the camera from those of the base, for a rigid mounting.

        v_c = R^T (v_b + w_b x p), w_c = R^T w_b, with R from camera to base and p the position of the camera.
        """
        v, w = base.twist[:, :3], base.twist[:, 3:]
        return Twists(
            base.t, np.concatenate([(v + np.cross(w, self.position_m)) @ self.rotation, w @ self.rotation], 1)
        )

    @property
    def adjoint(self) -> Array:
        """Matrix J (6, 6) from a twist of the camera to that of the base; J C J^T turns its covariance C.

        v_b = R v_c + p x (R w_c), w_b = R w_c: the inverse of `of_base`.
        """
        x, y, z = self.position_m
        cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
        return np.block([[self.rotation, cross @ self.rotation], [np.zeros((3, 3)), self.rotation]])

    def of_forward_speed(self, t: NDArray[np.int64], speed_m_s: Array) -> Twists:
        """The twists of a camera of which only the forward speed of the robot is known: vz, and nan elsewhere.

        The robot is taken to move along its own x axis. What turning adds by the position of the camera is left out.

        Args:
            t: (N,) [us].
            speed_m_s: (N,) forward speed of the base [m/s].

        Raises:
            InvalidField: the camera looks more than 60 degrees away from straight ahead.
        """
        along = float(self.rotation[0, 2])
        if along < _FORWARD:
            bound = "wheel speed alone needs a camera that looks at most 60 degrees away from straight ahead"
            raise InvalidField("mounting", "angle", round(float(np.degrees(np.arccos(along))), 1), bound)
        twist = np.full((len(t), 6), np.nan)
        twist[:, 2] = speed_m_s * along
        return Twists(t, twist)
