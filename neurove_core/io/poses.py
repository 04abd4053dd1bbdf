"""Checks of recorded poses, and poses from homogeneous matrices."""

from collections.abc import Callable
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from neurove_core.geometry import rotations
from neurove_core.geometry.motion import Poses
from neurove_core.io.faults import Reason, Tally
from neurove_protocol.errors import InvalidField

MAX_POSES: Final = 1 << 20
"""Maximum number of poses in a file: 67 MB, or 1.4 hours at 200 Hz."""

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
    tally: Tally | None = None,
) -> Poses:
    """Poses with times rounded to the nearest us and normalised quaternions.

    Args:
        t_us: (N,) times [us].
        position_m: (N, 3) position of the camera in the world frame [m].
        quaternion: (N, 4) x y z w, rotation from the camera frame to the world frame.
        name: gives the name of pose number i for an error.
        tally: if given, invalid and late poses are counted and left out. Otherwise they raise an error.

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
    checks: list[tuple[str, Any, Any, str]] = [
        ("t", in_range, t_us, "a finite time is expected"),
        ("position_m", np.isfinite(position_m).all(axis=1), position_m, "finite numbers are expected"),
        ("quaternion", np.isfinite(quaternion).all(axis=1), quaternion, "finite numbers are expected"),
        ("|quaternion|", np.abs(norm - 1) < QUATERNION_SLACK, norm, f"must be 1 to within {QUATERNION_SLACK}"),
    ]
    valid = np.logical_and.reduce([check[1] for check in checks])
    newest = np.maximum.accumulate(np.where(valid, t, np.iinfo(np.int64).min))
    later = np.ones(len(t), np.bool_)
    later[1:] = t[1:] > newest[:-1]
    checks.append(("t", later, t, "must be later [us] than the one before"))
    kept = valid & later
    if kept.all():
        return Poses(t, np.asarray(position_m, np.float64), quaternion / norm[:, None])
    if tally is None:
        raise _first_error(checks, t, name)
    _count(checks, name, tally)
    return Poses(t[kept], np.asarray(position_m[kept], np.float64), quaternion[kept] / norm[kept, None])


def _first_error(
    checks: list[tuple[str, Any, Any, str]], t: NDArray[np.int64], name: Callable[[int], str]
) -> InvalidField:
    """The error for the first pose that fails a check."""
    first = min(int((~passes).argmax()) if not passes.all() else len(t) for _, passes, _, _ in checks)
    field, _, values, bound = next(check for check in checks if not check[1][first])
    if bound.startswith("must be later"):
        bound = f"{bound}, {int(t[first - 1])}"
    return InvalidField(name(first), field, values[first].tolist(), bound)


def _count(checks: list[tuple[str, Any, Any, str]], name: Callable[[int], str], tally: Tally) -> None:
    """Count the poses that fail a check, each for the first one."""
    passed = np.ones(len(checks[0][1]), np.bool_)
    for field, passes, values, bound in checks:
        fails = np.flatnonzero(passed & ~passes)
        if fails.size:
            reason = Reason.LATE if bound.startswith("must be later") else Reason.INVALID
            tally.add(reason, name(int(fails[0])), f"{field}={values[fails[0]].tolist()}: {bound}", fails.size)
        passed &= passes


def rigid_motions(
    matrices: NDArray[np.float64], name: Callable[[int], str], tally: Tally | None, *, inverse: bool = False
) -> tuple[NDArray[np.bool_], NDArray[np.float64], NDArray[np.float64]]:
    """Positions and rotations from homogeneous matrices.

    Args:
        matrices: (N, 4, 4) from camera to world.
        name: as in `checked_poses`.
        tally: as in `checked_poses`.
        inverse: the matrices are from world to camera.

    Returns:
        Which matrices are rigid motions (N,), and the positions (M, 3) [m] and quaternions (M, 4) of these.

    Raises:
        InvalidField: a matrix is not a rigid motion, and there is no tally.
    """
    rotation, position = matrices[:, :3, :3], matrices[:, :3, 3]
    with np.errstate(all="ignore"):
        skew = np.abs(rotation @ rotation.transpose(0, 2, 1) - np.eye(3)).max(axis=(1, 2), initial=0)
        rigid = (skew < QUATERNION_SLACK) & (np.linalg.det(rotation) > 0)
        rigid &= (np.abs(matrices[:, 3] - (0, 0, 0, 1)) < 1e-6).all(axis=1)
    if not rigid.all():
        first = int(rigid.argmin())
        bound = f"a rotation and a translation are expected, to within {QUATERNION_SLACK}"
        if tally is None:
            raise InvalidField(name(first), "matrix", matrices[first].tolist(), bound)
        tally.add(Reason.INVALID, name(first), f"its matrix: {bound}", int(np.count_nonzero(~rigid)))
        rotation, position = rotation[rigid], position[rigid]
    if inverse:
        rotation = rotation.transpose(0, 2, 1)
        position = -(rotation @ position[..., None])[..., 0]
    return rigid, position, rotations.quaternion_of(rotation)
