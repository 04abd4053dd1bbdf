"""Reader of pose files: TUM text, Event Camera Dataset groundtruth.txt, CSV in ns, and HDF5 of MVSEC and M3ED.

A line of text is `t x y z qx qy qz qw`, or the same with commas; `#` begins a comment. If all times are whole numbers,
they are nanoseconds if a line has commas (as EuRoC and ESIM write it) or the last time is above 1e14; otherwise
times are seconds. In HDF5 the times are seconds for MVSEC and microseconds for M3ED.
"""

from collections.abc import Iterator
from pathlib import Path
from typing import Any, Final, TextIO

import numpy as np
from numpy.typing import NDArray

from neurove_core.files import pointer_fault
from neurove_core.geometry.motion import Poses
from neurove_core.io.errors import UnknownSource
from neurove_core.io.formats.hdf5 import file as hdf5
from neurove_core.io.formats.hdf5.poses import m3ed_poses, mvsec_odometry, stored_poses, table
from neurove_core.io.poses import MAX_POSES, checked_poses
from neurove_protocol.errors import InvalidField

NANOSECONDS_FROM: Final = 1e14
"""A whole-numbered time above this is in ns: in seconds it would be three million years."""

US_PER_UNIT: Final = {"s": 1e6, "ms": 1e3, "us": 1.0, "ns": 1e-3}
"""Microseconds in each unit of time."""

_LINES = 20_000  # parsed at once
_COLUMNS = ("t", "x", "y", "z", "qx", "qy", "qz", "qw")
_LAYOUTS = (
    "ts, poss, rots (MVSEC odometry)",
    "davis/left/odometry (MVSEC FILE_gt.hdf5)",
    "Cn_T_C0, ts (M3ED)",
    "poses/t (written by neurove)",
)


def read_poses(path: Path, unit: str | None = None) -> Poses:
    """Read the poses of a text file or an HDF5 file, see the module; times in us.

    Args:
        path: of the file.
        unit: unit of the times of a text file, s, ms, us or ns; by default as the module says.

    Raises:
        InvalidField: a pose is invalid, or its time is not after the previous one; the error names the line or the row.
        UnknownSource: the file does not exist, or has none of these layouts.
        BrokenRecording: an HDF5 file is truncated or corrupt. MissingExtra: h5py is not installed to read HDF5.
    """
    try:
        if path.suffix.lower() in (".h5", ".hdf5"):
            with hdf5.opened(path) as file:
                return _hdf5_poses(path, file)
        with path.open("rb") as file:
            fault = pointer_fault(file.read(64))
        if fault:
            raise UnknownSource(path, fault)
        with path.open(encoding="utf-8-sig", errors="backslashreplace") as text:
            return _text_poses(path, text, unit)
    except OSError as error:
        raise UnknownSource(path, error.strerror or str(error)) from None


def read_truth(path: Path, unit: str | None = None) -> Poses:
    """Read the poses of a file that the user gives as the truth of a recording; see `read_poses`.

    Raises:
        InvalidField: the file does not exist or has no poses; the error says what a truth file holds. Also as
            `read_poses`, like BrokenRecording and MissingExtra.
    """
    try:
        return read_poses(path, unit)
    except UnknownSource as error:
        why = f"{error.details['why']}; a truth file has poses of the camera: lines `{' '.join(_COLUMNS)}`, or HDF5"
        raise InvalidField("truth", "FILE", str(path), why) from None


def _text_poses(path: Path, text: TextIO, unit: str | None) -> Poses:
    """The poses of a text file; see the module."""
    times: list[NDArray[Any]] = []
    rows: list[NDArray[np.float64]] = []
    numbers: list[NDArray[np.int64]] = []
    commas, n = False, 0
    for lines, at in _blocks(text):
        commas = commas or any("," in line for line in lines)
        n += len(lines)
        if n > MAX_POSES:
            raise InvalidField(str(path), "poses", n, f"at most {MAX_POSES} are allowed")
        t, rest = _parse(path, lines, at)
        times.append(t)
        rows.append(rest)
        numbers.append(np.array(at))
    if not n:
        raise InvalidField(str(path), "poses", 0, "expected at least one line `t x y z qx qy qz qw`")
    t, rest, line = np.concatenate(times), np.concatenate(rows), np.concatenate(numbers)
    whole_numbers = all(part.dtype.kind == "i" for part in times)
    scale = 1e-3 if whole_numbers and (commas or t[-1] > NANOSECONDS_FROM) else 1e6
    scale = US_PER_UNIT[unit] if unit is not None else scale
    with np.errstate(all="ignore"):
        t_us = t * scale if t.dtype.kind == "f" or scale >= 1 else np.rint(t / 1000)
    return checked_poses(t_us, rest[:, :3], rest[:, 3:], lambda i: f"{path}: line {line[i]}")


def _blocks(text: TextIO) -> Iterator[tuple[list[str], list[int]]]:
    """Lines that are neither empty nor comments, at most _LINES at a time, and their line numbers from 1 on."""
    lines: list[str] = []
    numbers: list[int] = []
    for number, raw in enumerate(iter(lambda: text.readline(1 << 16), ""), 1):  # bounded: a file may have no newline
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
    """Times (N,) in the unit of the file, int64 or float64, and the other seven columns (N, 7).

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
            bound = f"expected {len(_COLUMNS)} columns: {' '.join(_COLUMNS)}"
            raise InvalidField(f"{path}: line {number}", "columns", len(values), bound)
        for field, entry in zip(_COLUMNS, values, strict=True):
            try:
                float(entry)
            except ValueError:
                raise InvalidField(f"{path}: line {number}", field, entry, "expected a number") from None
    bound = f"expected numbers: {' '.join(_COLUMNS)}"  # for example 1_000: Python accepts it, loadtxt does not
    raise InvalidField(f"{path}: lines {numbers[0]} to {numbers[-1]}", "columns", lines[0], bound)


def _hdf5_poses(path: Path, file: Any) -> Poses:
    """The poses of an HDF5 file in any of the layouts."""
    if hdf5.has(file, "ts", "poss", "rots"):
        t, position, quaternion = table(path, file, ("ts", "poss", "rots"), (), (3,), (4,))
        return checked_poses(t * 1e6, position, quaternion, lambda i: f"{path}: row {i}")
    if hdf5.has(file, "davis/left/odometry", "davis/left/odometry_ts"):
        return mvsec_odometry(path, file)
    if hdf5.has(file, "Cn_T_C0", "ts"):
        return m3ed_poses(path, file)
    if hdf5.has(file, "poses/t"):
        return stored_poses(path, file)
    raise UnknownSource(path, f"the file has no poses; looked for {'; '.join(_LAYOUTS)}")
