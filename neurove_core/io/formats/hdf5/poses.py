"""Readers of poses in the HDF5 layouts of MVSEC, M3ED and `write_dsec`."""

from pathlib import Path
from typing import Any

from numpy.typing import NDArray

from neurove_core.geometry.motion import Poses
from neurove_core.io.formats.hdf5 import file as hdf5
from neurove_core.io.poses import MAX_POSES, checked_poses, poses_of_matrices
from neurove_protocol.errors import InvalidField


def table(path: Path, file: Any, names: tuple[str, ...], *tails: tuple[int, ...]) -> list[NDArray[Any]]:
    """All rows of the data sets of these names, of shapes (N, *tail) with the same N.

    Raises:
        BrokenRecording: a data set does not exist, has another shape, or cannot be read.
        InvalidField: there are more than MAX_POSES rows.
    """
    columns = [hdf5.dataset(path, file, name, *tail) for name, tail in zip(names, tails, strict=True)]
    n = min(int(column.shape[0]) for column in columns)
    if n > MAX_POSES:
        raise InvalidField(str(path), names[0], n, f"at most {MAX_POSES} rows are allowed")
    return hdf5.all_rows(path, names[0], columns)


def mvsec_odometry(path: Path, file: Any) -> Poses:
    """Poses of the left camera in an MVSEC FILE_gt.hdf5: LOAM's odometry, world from camera.

    It is not davis/left/pose: that comes from Cartographer, which closes loops and does not optimise the height.
    Source: https://daniilidis-group.github.io/mvsec/data_format.

    Raises:
        InvalidField, BrokenRecording: as `read_poses`.
    """
    names = ("davis/left/odometry_ts", "davis/left/odometry")
    t, matrices = table(path, file, names, (), (4, 4))
    return poses_of_matrices(t * 1e6, matrices, lambda i: f"{path}: row {i} of davis/left/odometry")


def m3ed_poses(path: Path, file: Any) -> Poses:
    """Poses of the left Prophesee camera in an M3ED FILE_pose_gt.h5, in the world of its first pose.

    Cn_T_C0 maps a point from the first camera frame to the current one: the inverse of MVSEC's convention.
    Source: daniilidis-group/m3ed, build_system/lidar_depth/fasterlio_gt.py.

    Raises:
        InvalidField, BrokenRecording: as `read_poses`.
    """
    t, matrices = table(path, file, ("ts", "Cn_T_C0"), (), (4, 4))
    return poses_of_matrices(t, matrices, lambda i: f"{path}: row {i} of Cn_T_C0", inverse=True)


def stored_poses(path: Path, file: Any) -> Poses:
    """Poses that `dsec_write.write_dsec` wrote.

    Raises:
        InvalidField, BrokenRecording: as `read_poses`.
    """
    names = ("poses/t", "poses/position", "poses/orientation")
    t, position, quaternion = table(path, file, names, (), (3,), (4,))
    return checked_poses(t, position, quaternion, lambda i: f"{path}: row {i} of poses")
