"""Readers of poses in the HDF5 layouts of MVSEC, M3ED and `write_dsec`."""

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from neurove_core.geometry.motion import Poses
from neurove_core.io.checked import until_broken
from neurove_core.io.errors import BrokenRecording
from neurove_core.io.faults import Tally
from neurove_core.io.formats.hdf5 import file as hdf5
from neurove_core.io.formats.hdf5.tables import row_blocks
from neurove_core.io.poses import MAX_POSES, checked_poses, rigid_motions
from neurove_protocol.errors import InvalidField

_ROWS = 1 << 14  # read at once


def table(path: Path, file: Any, names: tuple[str, ...], *tails: tuple[int, ...]) -> list[NDArray[Any]]:
    """All rows of the data sets of these names, of shapes (N, *tail) with the same N.

    Raises:
        BrokenRecording: a data set does not exist, has another shape, or cannot be read.
        InvalidField: there are more than MAX_POSES rows.
    """
    return hdf5.all_rows(path, names[0], _columns(path, file, names, *tails))


def _columns(path: Path, file: Any, names: tuple[str, ...], *tails: tuple[int, ...]) -> list[Any]:
    columns = [hdf5.dataset(path, file, name, *tail) for name, tail in zip(names, tails, strict=True)]
    n = min(int(column.shape[0]) for column in columns)
    if n > MAX_POSES:
        raise InvalidField(str(path), names[0], n, f"at most {MAX_POSES} rows are allowed")
    return columns


def _from_matrices(
    path: Path,
    file: Any,
    names: tuple[str, str],
    to_us: Callable[[NDArray[Any]], NDArray[Any]],
    tally: Tally | None,
    *,
    inverse: bool = False,
) -> Poses:
    """Poses from two data sets: times, and homogeneous matrices. They are read in blocks, because memory is bounded."""
    columns, found = _columns(path, file, names, (), (4, 4)), tally or Tally("poses")
    rows, parts = [np.empty(0, np.intp)], [(np.empty(0), np.empty((0, 3)), np.empty((0, 4)))]
    for first, (t, matrices) in until_broken(row_blocks(path, names[1], columns, found, _ROWS), found):
        name = partial(_row, path, names[1], np.arange(first, first + len(t)))
        rigid, position, quaternion = rigid_motions(matrices.astype(np.float64), name, tally, inverse=inverse)
        rows.append(first + np.flatnonzero(rigid))
        with np.errstate(all="ignore"):  # such times are checked below
            parts.append((to_us(t[rigid]), position, quaternion))
    if tally is None and found.faults:
        raise BrokenRecording(path, found.faults[0].where, found.faults[0].why)
    t_us, position, quaternion = (np.concatenate(part) for part in zip(*parts[len(parts) > 1 :], strict=True))
    return checked_poses(t_us, position, quaternion, partial(_row, path, names[1], np.concatenate(rows)), tally)


def _row(path: Path, name: str, rows: NDArray[np.intp], i: int) -> str:
    return f"{path}: row {rows[i] if i < rows.size else 0} of {name}"


def mvsec_odometry(path: Path, file: Any, tally: Tally | None = None) -> Poses:
    """Poses of the left camera in an MVSEC FILE_gt.hdf5: LOAM's odometry, world from camera.

    It is not davis/left/pose: that comes from Cartographer, which closes loops and does not optimise the height.
    Source: https://daniilidis-group.github.io/mvsec/data_format.

    Raises:
        InvalidField, BrokenRecording: as `read_poses`. With a tally, invalid rows are counted and left out.
    """
    names = ("davis/left/odometry_ts", "davis/left/odometry")
    return _from_matrices(path, file, names, lambda t: t * 1e6, tally)


def m3ed_poses(path: Path, file: Any, tally: Tally | None = None) -> Poses:
    """Poses of the left Prophesee camera in an M3ED FILE_pose_gt.h5, in the world of its first pose.

    Cn_T_C0 maps a point from the first camera frame to the current one: the inverse of MVSEC's convention.
    Source: daniilidis-group/m3ed, build_system/lidar_depth/fasterlio_gt.py.

    Raises:
        InvalidField, BrokenRecording: as `mvsec_odometry`.
    """
    return _from_matrices(path, file, ("ts", "Cn_T_C0"), lambda t: t, tally, inverse=True)


def stored_poses(path: Path, file: Any, tally: Tally | None = None) -> Poses:
    """Poses that `dsec_write.write_dsec` wrote.

    Raises:
        InvalidField, BrokenRecording: as `mvsec_odometry`.
    """
    names = ("poses/t", "poses/position", "poses/orientation")
    t, position, quaternion = table(path, file, names, (), (3,), (4,))
    return checked_poses(t, position, quaternion, lambda i: f"{path}: row {i} of poses", tally)
