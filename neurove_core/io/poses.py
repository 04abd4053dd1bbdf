"""Checks of recorded poses, and poses from homogeneous matrices."""

from collections.abc import Callable
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from neurove_core.geometry import rotations
from neurove_core.geometry.motion import Poses
from neurove_protocol.errors import InvalidField

MAX_POSES: Final = 1 << 22
"""Maximum number of poses in a file: 250 MB, or 5.8 hours at 200 Hz."""

QUATERNION_SLACK: Final = 1e-2
"""Tolerance of a quaternion's length, which must be 1, and of a rotation matrix, which must be orthonormal.

Within the tolerance they are normalised.
"""

_MAX_T_US = 1e18


def checked_poses(
    t_us: NDArray[np.float64] | NDArray[np.int64],
    position_m: NDArray[np.float64],
    quaternion: NDArray[np.float64],
    name: Callable[[int], str],
) -> Poses:
    """Poses with times rounded to the nearest us and normalised quaternions.

    Args:
        t_us: (N,) times [us].
        position_m: (N, 3) position of the camera in the world frame [m].
        quaternion: (N, 4) x y z w, rotation from the camera frame to the world frame.
        name: gives the name of pose number i for an error.

    Raises:
        InvalidField: there are no poses, a number is not finite, the length of a quaternion is not 1, or a time is not
            later than the time before it.
    """
    if not len(t_us):
        raise InvalidField(name(0), "poses", 0, "at least one pose is expected")
    with np.errstate(all="ignore"):
        norm = np.linalg.norm(quaternion, axis=1)
        in_range = (t_us > -_MAX_T_US) & (t_us < _MAX_T_US)
        t = np.where(in_range, np.rint(t_us), 0).astype(np.int64) if t_us.dtype.kind == "f" else t_us.astype(np.int64)
    checks: tuple[tuple[str, Any, Any, str], ...] = (
        ("t", in_range, t_us, "a finite time is expected"),
        ("position_m", np.isfinite(position_m).all(axis=1), position_m, "finite numbers are expected"),
        ("quaternion", np.isfinite(quaternion).all(axis=1), quaternion, "finite numbers are expected"),
        ("|quaternion|", np.abs(norm - 1) < QUATERNION_SLACK, norm, f"must be 1 to within {QUATERNION_SLACK}"),
        ("t", np.diff(t, prepend=t[:1] - 1) > 0, t, "must be later [us] than the one before"),
    )
    first = min(int((~valid).argmax()) if not valid.all() else len(t) for _, valid, _, _ in checks)
    for field, valid, values, bound in checks:
        if first < len(t) and not valid[first]:
            if bound.startswith("must be later"):
                bound = f"{bound}, {int(t[first - 1])}"
            raise InvalidField(name(first), field, values[first].tolist(), bound)
    return Poses(t, np.asarray(position_m, np.float64), quaternion / norm[:, None])


def poses_of_matrices(
    t_us: NDArray[Any], matrices: NDArray[np.float64], name: Callable[[int], str], *, inverse: bool = False
) -> Poses:
    """Poses from homogeneous matrices.

    Args:
        t_us: (N,) times [us].
        matrices: (N, 4, 4) from camera to world.
        name: as in `checked_poses`.
        inverse: the matrices are from world to camera.

    Raises:
        InvalidField: as `checked_poses`, or a matrix is not a rigid motion.
    """
    rotation, position = matrices[:, :3, :3], matrices[:, :3, 3]
    with np.errstate(all="ignore"):
        skew = np.abs(rotation @ rotation.transpose(0, 2, 1) - np.eye(3)).max(axis=(1, 2), initial=0)
        rigid = (skew < QUATERNION_SLACK) & (np.linalg.det(rotation) > 0)
        rigid &= (np.abs(matrices[:, 3] - (0, 0, 0, 1)) < 1e-6).all(axis=1)
    if not rigid.all():
        first = int(rigid.argmin())
        bound = f"a rotation and a translation are expected, to within {QUATERNION_SLACK}"
        raise InvalidField(name(first), "matrix", matrices[first].tolist(), bound)
    if inverse:
        rotation = rotation.transpose(0, 2, 1)
        position = -(rotation @ position[..., None])[..., 0]
    return checked_poses(t_us, position, rotations.quaternion_of(rotation), name)
