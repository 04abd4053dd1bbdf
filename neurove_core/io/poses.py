"""Files of poses: TUM text, the Event Camera Dataset's groundtruth.txt, CSV in nanoseconds, and HDF5 of MVSEC and M3ED.

In text a line is `t x y z qx qy qz qw`, or the same with commas; `#` begins a comment. Where all times are written as
whole numbers they are nanoseconds, if the line has commas (as EuRoC and ESIM write it) or the last is above 1e14;
otherwise they are seconds. In HDF5 they are seconds in MVSEC's and microseconds in M3ED's.
"""

from collections.abc import Callable
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from neurove_core.geometry import rotations
from neurove_core.geometry.motion import Poses
from neurove_protocol.errors import InvalidField

MAX_POSES: Final = 1 << 22
"""Most poses that a file may have: 250 MB of them, as 5.8 hours at 200 Hz."""


QUATERNION_SLACK: Final = 1e-2
"""How far a quaternion's length may be from 1, and a rotation matrix from an orthonormal one; it is then made exact."""

_MAX_T_US = 1e18


def checked_poses(
    t_us: NDArray[np.float64] | NDArray[np.int64],
    position_m: NDArray[np.float64],
    quaternion: NDArray[np.float64],
    name: Callable[[int], str],
) -> Poses:
    """The poses, their times to the nearest us and their quaternions made exact.

    Args:
        t_us: (N,) times [us].
        position_m: (N, 3) of the camera in the world.
        quaternion: (N, 4) x y z w, camera axes into the world's.
        name: what to call pose number i in an error.

    Raises:
        InvalidField: there are none, a number is not finite, a quaternion is not of length 1 or a time does not come
            after the one before.
    """
    if not len(t_us):
        raise InvalidField(name(0), "poses", 0, "at least one pose is expected")
    with np.errstate(all="ignore"):
        norm = np.linalg.norm(quaternion, axis=1)
        timely = (t_us > -_MAX_T_US) & (t_us < _MAX_T_US)
        t = np.where(timely, np.rint(t_us), 0).astype(np.int64) if t_us.dtype.kind == "f" else t_us.astype(np.int64)
    faults: tuple[tuple[str, Any, Any, str], ...] = (
        ("t", timely, t_us, "a finite time is expected"),
        ("position_m", np.isfinite(position_m).all(axis=1), position_m, "finite numbers are expected"),
        ("quaternion", np.isfinite(quaternion).all(axis=1), quaternion, "finite numbers are expected"),
        ("|quaternion|", np.abs(norm - 1) < QUATERNION_SLACK, norm, f"must be 1 to within {QUATERNION_SLACK}"),
        ("t", np.diff(t, prepend=t[:1] - 1) > 0, t, "must be later [us] than the one before"),
    )
    first = min(int((~good).argmax()) if not good.all() else len(t) for _, good, _, _ in faults)
    for field, good, values, bound in faults:
        if first < len(t) and not good[first]:
            if bound.startswith("must be later"):
                bound = f"{bound}, {int(t[first - 1])}"
            raise InvalidField(name(first), field, values[first].tolist(), bound)
    return Poses(t, np.asarray(position_m, np.float64), quaternion / norm[:, None])


def poses_of_matrices(
    t_us: NDArray[Any], matrices: NDArray[np.float64], name: Callable[[int], str], *, inverse: bool = False
) -> Poses:
    """The poses that homogeneous matrices tell.

    Args:
        t_us: (N,) times [us].
        matrices: (N, 4, 4) from camera to world.
        name: as in `checked_poses`.
        inverse: the matrices are from world to camera.

    Raises:
        InvalidField: as `checked_poses`, or a matrix is no rigid motion.
    """
    turned, position = matrices[:, :3, :3], matrices[:, :3, 3]
    with np.errstate(all="ignore"):
        skew = np.abs(turned @ turned.transpose(0, 2, 1) - np.eye(3)).max(axis=(1, 2), initial=0)
        rigid = (skew < QUATERNION_SLACK) & (np.linalg.det(turned) > 0)
        rigid &= (np.abs(matrices[:, 3] - (0, 0, 0, 1)) < 1e-6).all(axis=1)
    if not rigid.all():
        first = int(rigid.argmin())
        bound = f"a rotation and a translation are expected, to within {QUATERNION_SLACK}"
        raise InvalidField(name(first), "matrix", matrices[first].tolist(), bound)
    if inverse:
        turned = turned.transpose(0, 2, 1)
        position = -(turned @ position[..., None])[..., 0]
    return checked_poses(t_us, position, rotations.quaternion_of(turned), name)
