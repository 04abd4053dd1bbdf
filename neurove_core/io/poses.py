"""Files of poses: TUM text, the Event Camera Dataset's groundtruth.txt, CSV in nanoseconds, and HDF5 of MVSEC and M3ED.

In text a line is `t x y z qx qy qz qw`, or the same with commas; `#` begins a comment. Where all times are written as
whole numbers they are nanoseconds, if the line has commas (as EuRoC and ESIM write it) or the last is above 1e14;
otherwise they are seconds. In HDF5 they are seconds in MVSEC's and microseconds in M3ED's.
"""

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, Final, TextIO

import numpy as np
from numpy.typing import NDArray

from neurove_core.geometry import rotations
from neurove_core.geometry.motion import Poses
from neurove_core.io.errors import UnknownSource
from neurove_core.io.formats.hdf5 import file as hdf5
from neurove_core.io.recording import SUPPORTED
from neurove_protocol.errors import InvalidField

MAX_POSES: Final = 1 << 22
"""Most poses that a file may have: 250 MB of them, as 5.8 hours at 200 Hz."""

NANOSECONDS_FROM: Final = 1e14
"""A whole-numbered time above this is in ns: as seconds it would be three million years."""

QUATERNION_SLACK: Final = 1e-2
"""How far a quaternion's length may be from 1, and a rotation matrix from an orthonormal one; it is then made exact."""

_LINES = 20_000  # parsed at once
_COLUMNS = ("t", "x", "y", "z", "qx", "qy", "qz", "qw")
_MAX_T_US = 1e18
_LAYOUTS = (
    "ts, poss, rots (MVSEC odometry)",
    "davis/left/odometry (MVSEC FILE_gt.hdf5)",
    "Cn_T_C0, ts (M3ED)",
    "poses/t (written by neurove)",
)


def read_poses(path: Path) -> Poses:
    """The poses in a file of text, of HDF5 with `poss` and `rots`, or of M3ED's `Cn_T_C0`; times in us.

    Raises:
        InvalidField: a pose is none, or its time does not come after the one before; it names the line or the row.
        UnknownSource: there is no such file, or it holds none of these layouts.
        BrokenRecording: it is HDF5, and cut or garbled. MissingExtra: it is HDF5, and h5py is not installed.
    """
    try:
        if path.suffix.lower() in (".h5", ".hdf5"):
            with hdf5.opened(path) as file:
                return _hdf5_poses(path, file)
        with path.open(encoding="utf-8-sig", errors="backslashreplace") as text:
            return _text_poses(path, text)
    except OSError as error:
        raise UnknownSource(path, SUPPORTED, error.strerror or str(error)) from None


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


def _text_poses(path: Path, text: TextIO) -> Poses:
    """The poses of a text file; see the module."""
    times: list[NDArray[Any]] = []
    rows: list[NDArray[np.float64]] = []
    numbers: list[NDArray[np.int64]] = []
    commas, n = False, 0
    for lines, at in _blocks(text):
        commas = commas or any("," in line for line in lines)
        n += len(lines)
        if n > MAX_POSES:
            raise InvalidField(str(path), "poses", n, f"at most {MAX_POSES} are read")
        t, rest = _parse(path, lines, at)
        times.append(t)
        rows.append(rest)
        numbers.append(np.array(at))
    if not n:
        raise InvalidField(str(path), "poses", 0, "at least one line `t x y z qx qy qz qw` is expected")
    t, rest, line = np.concatenate(times), np.concatenate(rows), np.concatenate(numbers)
    whole = all(part.dtype.kind == "i" for part in times)
    scale = 1e-3 if whole and (commas or t[-1] > NANOSECONDS_FROM) else 1e6
    with np.errstate(all="ignore"):
        t_us = t * scale if t.dtype.kind == "f" or scale > 1 else np.rint(t / 1000)
    return checked_poses(t_us, rest[:, :3], rest[:, 3:], lambda i: f"{path}: line {line[i]}")


def _blocks(text: TextIO) -> Iterator[tuple[list[str], list[int]]]:
    """Lines that are neither empty nor comments, some thousand at a time, and their numbers from 1 on."""
    lines: list[str] = []
    numbers: list[int] = []
    for number, raw in enumerate(iter(lambda: text.readline(1 << 16), ""), 1):  # a file without line ends is no text
        line = raw.partition("#")[0].strip()
        if line:
            lines.append(line)
            numbers.append(number)
        if len(lines) >= _LINES:
            yield lines, numbers
            lines, numbers = [], []
    if lines:
        yield lines, numbers


def _parse(path: Path, lines: list[str], numbers: list[int]) -> tuple[NDArray[Any], NDArray[np.float64]]:
    """Times (N,) as they are written, int64 or float64, and the other seven columns (N, 7).

    Raises:
        InvalidField: a line is not eight numbers.
    """
    delimiter = "," if "," in lines[0] else None
    for kind in ("i8", "f8"):
        columns = np.dtype([("t", kind), ("rest", "f8", (7,))])
        try:
            table = np.loadtxt(lines, columns, delimiter=delimiter, comments=None, ndmin=1)
        except (ValueError, OverflowError):
            continue
        return table["t"], table["rest"]
    for line, number in zip(lines, numbers, strict=True):
        values = line.split(delimiter)
        if len(values) != len(_COLUMNS):
            bound = f"{len(_COLUMNS)} columns are expected: {' '.join(_COLUMNS)}"
            raise InvalidField(f"{path}: line {number}", "columns", len(values), bound)
        for field, entry in zip(_COLUMNS, values, strict=True):
            try:
                float(entry)
            except ValueError:
                raise InvalidField(f"{path}: line {number}", field, entry, "a number is expected") from None
    bound = f"numbers are expected: {' '.join(_COLUMNS)}"  # such as 1_000, which Python takes and the fast parser not
    raise InvalidField(f"{path}: lines {numbers[0]} to {numbers[-1]}", "columns", lines[0], bound)


def _hdf5_poses(path: Path, file: Any) -> Poses:
    """The poses of an HDF5 file, whichever of the layouts it has."""
    if hdf5.has(file, "ts", "poss", "rots"):
        t, position, quaternion = table(path, file, ("ts", "poss", "rots"), (), (3,), (4,))
        return checked_poses(t * 1e6, position, quaternion, lambda i: f"{path}: row {i}")
    if hdf5.has(file, "davis/left/odometry", "davis/left/odometry_ts"):
        return mvsec_odometry(path, file)
    if hdf5.has(file, "Cn_T_C0", "ts"):
        return m3ed_poses(path, file)
    if hdf5.has(file, "poses/t"):
        return stored_poses(path, file)
    raise UnknownSource(path, SUPPORTED, f"the file has no poses; looked for {'; '.join(_LAYOUTS)}")


def table(path: Path, file: Any, names: tuple[str, ...], *tails: tuple[int, ...]) -> list[NDArray[Any]]:
    """The data sets of these names as a whole, of shapes (N, *tail) with one N.

    Raises:
        BrokenRecording: one is not there, of another shape, or can not be read.
        InvalidField: there are more than MAX_POSES rows.
    """
    columns = [hdf5.dataset(path, file, name, *tail) for name, tail in zip(names, tails, strict=True)]
    n = min(int(column.shape[0]) for column in columns)
    if n > MAX_POSES:
        raise InvalidField(str(path), names[0], n, f"at most {MAX_POSES} rows are read")
    return hdf5.all_rows(path, names[0], columns)


def mvsec_odometry(path: Path, file: Any) -> Poses:
    """Poses of the left camera in an MVSEC FILE_gt.hdf5: LOAM's odometry, world from camera.

    Not davis/left/pose: that is Cartographer's, which has loops closed and does not optimise the height.
    Source: https://daniilidis-group.github.io/mvsec/data_format.

    Raises:
        InvalidField, BrokenRecording: as `read_poses`.
    """
    names = ("davis/left/odometry_ts", "davis/left/odometry")
    t, matrices = table(path, file, names, (), (4, 4))
    return poses_of_matrices(t * 1e6, matrices, lambda i: f"{path}: row {i} of davis/left/odometry")


def m3ed_poses(path: Path, file: Any) -> Poses:
    """Poses of the left Prophesee camera in an M3ED FILE_pose_gt.h5, in the world of its first pose.

    Cn_T_C0 takes a point from the first camera's frame into the present one's: the inverse of MVSEC's convention.
    Source: daniilidis-group/m3ed, build_system/lidar_depth/fasterlio_gt.py.

    Raises:
        InvalidField, BrokenRecording: as `read_poses`.
    """
    t, matrices = table(path, file, ("ts", "Cn_T_C0"), (), (4, 4))
    return poses_of_matrices(t, matrices, lambda i: f"{path}: row {i} of Cn_T_C0", inverse=True)


def stored_poses(path: Path, file: Any) -> Poses:
    """Poses as `dsec.write_dsec` writes them.

    Raises:
        InvalidField, BrokenRecording: as `read_poses`.
    """
    names = ("poses/t", "poses/position", "poses/orientation")
    t, position, quaternion = table(path, file, names, (), (3,), (4,))
    return checked_poses(t, position, quaternion, lambda i: f"{path}: row {i} of poses")
