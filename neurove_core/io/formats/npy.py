"""Reader of events in NumPy arrays: FILE.npy, FILE.npz, and the folders of EVIMO2.

- An array of records with fields such as t, x, y, p, as tonic (https://tonic.readthedocs.io) and N-ImageNet
  (https://github.com/82magnolia/n_imagenet, `event_data`) have them, or an array (N, 4) or (4, N) of numbers. `columns`
  says how the columns and the unit of time are found.
- A .npz holds such an array under the name `events`, `event_data` or `arr_0`, or one array each for t, x, y and p.
- EVIMO and EVIMO2v1: a .npz with `events` (N, 4) t [s], x, y, p, and `depth` (M, H, W), which gives the sensor.
- EVIMO2v2: a folder with dataset_events_t.npy [s], dataset_events_xy.npy (N, 2) and dataset_events_p.npy. An image in
  dataset_depth.npz, dataset_mask.npz or dataset_classical.npz gives the sensor. The data set stores poses and
  calibration with pickle, which is never read.
  Source: https://better-flow.github.io/evimo/docs/ground-truth-format.html. The polarity of its Samsung camera is the
  opposite of the others'; it is given as recorded.
"""

import re
import zipfile
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Final, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from neurove_core.io.archive import BROKEN_ZIP, Place
from neurove_core.io.checked import Piece, cleaned, numbered
from neurove_core.io.errors import BrokenRecording, MissingGeometry, UnknownSource
from neurove_core.io.faults import Faults, Tally
from neurove_core.io.format import Format
from neurove_core.io.formats.columns import Unclear, by_name, by_values, piece, unit_of
from neurove_core.io.formats.npy_rows import MAGIC, Header, Series, blocks, read_header
from neurove_core.io.recording import EventsOnly, refuse_topic
from neurove_core.io.units import SAMPLE, UNITS, TimeSample
from neurove_protocol.errors import InvalidField
from neurove_protocol.events import Events, Sensor

EVIMO2: Final = ("dataset_events_t.npy", "dataset_events_xy.npy", "dataset_events_p.npy")
IMAGES: Final = ("dataset_depth.npz", "dataset_mask.npz", "dataset_classical.npz")
MEMBERS: Final = ("events", "event_data", "arr_0")
"""Names of an array of events in a .npz; the first one is read."""

_CARLA = {"fov_deg.npy", "width.npy"}  # members of the container of `carla.py`

Pick = tuple[int, str | int | None]
"""Where a column is: the number of its series, and the field or the number in a row."""


class Layout(NamedTuple):
    """Where t, x, y and p are."""

    series: tuple[Series, ...]
    picks: tuple[Pick, Pick, Pick, Pick]

    def columns(self, parts: list[NDArray[Any]]) -> list[NDArray[Any]]:
        """The columns t, x, y, p of a block of rows."""
        found = []
        for number, key in self.picks:
            part: Any = parts[number]
            found.append(part if key is None else part[key] if isinstance(key, str) else part[:, key])
        return found


@dataclass(frozen=True, slots=True)
class ArrayRecording(EventsOnly):
    """Events in NumPy arrays; see `Recording` and the module."""

    path: Path
    name: str
    sensor: Sensor
    place: Place
    layout: Layout
    unit_us: float
    endless: bool = False
    faults: Faults = field(default_factory=Faults, compare=False, repr=False)

    @classmethod
    def open(cls, path: Path, sensor: Sensor | None = None) -> Self:
        """Open the recording in this file or folder.

        Args:
            path: the .npy or .npz, or a folder of EVIMO2v2.
            sensor: the pixel array; overrides that of the images.

        Raises:
            UnknownSource: an array does not hold events, or its columns are not clear.
            MissingGeometry: neither the recording nor `sensor` gives the sensor size.
            BrokenRecording: the .npz is damaged.
        """
        folder = _evimo2_folder(path)
        if folder is not None:
            place, layout, unit_us, found = Place(folder), _evimo2(folder), 1e6, _image_size(folder)
        else:
            archive = _is_zip(path)
            place = Place(path, "") if archive else Place(path.parent)
            try:
                layout = _in_archive(path, place) if archive else _of_array(path, path.name, place)
                layout, unit_us = _guessed(place, layout)
            except Unclear as error:
                raise UnknownSource(path, f"{error}; save it as records with the fields t, x, y, p") from None
            found = _size_of(path, place, "depth.npy") if archive and place.has("depth.npy") else None
        if sensor is None and found is None:
            raise MissingGeometry(path)
        return cls(path, path.resolve().name, sensor or found, place, layout, unit_us)  # type: ignore[arg-type]

    def chunks(self) -> Iterator[Events]:
        """All events from the beginning; see `Recording`."""
        tally = self.faults.begin("events")
        return cleaned(self._pieces(tally), self.sensor, tally)

    def time_sample(self) -> TimeSample | None:
        """Times of the first events, see `Timed`."""
        columns = _first_columns(self.place, self.layout)
        unit = next(name for name, us in UNITS.items() if us == self.unit_us)
        return TimeSample(self.path, columns[0], unit, self._known_rows()) if columns else None

    def in_unit(self, unit: str) -> Self:
        """The same recording with the times of its events in another unit, see `Timed`."""
        return replace(self, unit_us=UNITS[unit])

    def _known_rows(self) -> int:
        """The rows that a plain file has, whatever its header says; 0 for a packed one."""
        one = self.layout.series[0]
        return (
            min(one.rows, (self.place.path / one.name).stat().st_size // one.row_bytes)
            if self.place.inside is None
            else 0
        )

    def _pieces(self, tally: Tally) -> Iterator[Piece]:
        at = 0
        for parts in blocks(self.place, self.layout.series):
            yield piece(numbered(at), self.unit_us, self.layout.columns(parts), tally)
            at += len(parts[0])


def _header(path: Path, place: Place, name: str) -> Header:
    with place.open(name) as file:
        return read_header(path, name, file)


def _of_array(path: Path, name: str, place: Place) -> Layout:
    """The layout of one array. The columns of an array without names are in the order t, x, y, p.

    Raises:
        Unclear, UnknownSource: it does not hold events.
    """
    dtype, shape, fortran = _header(path, place, name)
    if dtype.names is not None:
        columns = by_name(dtype.names)
        fields = [dtype.names[i] for i in columns.order]
        if len(shape) not in (1, 2) or shape[1:] not in ((), (1,)) or not all(_is_number(dtype[one]) for one in fields):
            raise UnknownSource(path, f"{name}: expected records of numbers of shape (N), not {dtype} of {shape}")
        t, x, y, p = ((0, one) for one in fields)
        return Layout((Series(name, 0, dtype, shape[0]),), (t, x, y, p))
    if len(shape) != 2 or 4 not in shape or not _is_number(dtype):
        raise UnknownSource(path, f"{name}: expected numbers of shape (N, 4), not {dtype} of {shape}")
    rows = shape[0] if shape[1] == 4 else shape[1]
    if (shape[1] == 4) is not fortran:  # the four numbers of an event follow each other
        return Layout((Series(name, 0, dtype, rows, 4),), ((0, 0), (0, 1), (0, 2), (0, 3)))
    series = tuple(Series(name, i * rows, dtype, rows) for i in range(4))
    return Layout(series, ((0, None), (1, None), (2, None), (3, None)))


def _in_archive(path: Path, place: Place) -> Layout:
    """The layout of the events in a .npz."""
    names = _members(path)
    for name in MEMBERS:
        if name in names:
            return _of_array(path, f"{name}.npy", place)
    wanted = [f"{names[i]}.npy" for i in by_name(names).order]
    return Layout(tuple(_vector(path, place, name) for name in wanted), ((0, None), (1, None), (2, None), (3, None)))


def _vector(path: Path, place: Place, name: str, width: int = 1) -> Series:
    """An array (N,) or (N, width) of numbers."""
    dtype, shape, fortran = _header(path, place, name)
    fits = shape[1:] in ((), (1,)) if width == 1 else shape[1:] == (width,) and not fortran
    if not shape or not fits or not _is_number(dtype):
        want = "(N)" if width == 1 else f"(N, {width})"
        raise UnknownSource(path, f"{name}: expected numbers of shape {want}, not {dtype} of {shape}")
    return Series(name, 0, dtype, shape[0], width)


def _guessed(place: Place, layout: Layout) -> tuple[Layout, float]:
    """The layout with the columns in the right order, and the unit of time [us], from the first rows.

    Raises:
        Unclear: the columns cannot be told apart.
    """
    names = [key if isinstance(key, str) else layout.series[number].name[:-4] for number, key in layout.picks]
    columns = _first_columns(place, layout)
    try:
        order = by_name(names)
    except Unclear:  # the columns have no names
        table = np.stack([column.astype(np.float64) for column in columns], axis=1) if columns else np.empty((0, 4))
        order = by_values(table)
    t, x, y, p = (layout.picks[i] for i in order.order)
    unit_us = order.unit_us
    if unit_us is None and columns:
        times = columns[order.t]
        unit_us = unit_of(times.astype(np.float64), floats=times.dtype.kind == "f")
    return layout._replace(picks=(t, x, y, p)), unit_us or 1.0


def _first_columns(place: Place, layout: Layout) -> list[NDArray[Any]]:
    """The columns t, x, y, p of the first rows; empty if there are none, or they cannot be read."""
    try:
        parts = next(blocks(place, layout.series, SAMPLE * sum(one.row_bytes for one in layout.series)), None)
    except BrokenRecording:  # reading the events reports it
        parts = None
    return [] if parts is None else layout.columns(parts)


def _is_number(dtype: np.dtype[Any]) -> bool:
    return dtype.kind in "biu" or (dtype.kind == "f" and dtype.itemsize in (4, 8))


def _members(path: Path) -> list[str]:
    """The names of the arrays in a .npz."""
    try:
        with zipfile.ZipFile(path) as archive:
            return [name.removesuffix(".npy") for name in archive.namelist() if name.endswith(".npy")]
    except BROKEN_ZIP as error:
        raise UnknownSource(path, f"it is not a zip file: {error}") from None


def _evimo2_folder(path: Path) -> Path | None:
    """The folder of EVIMO2v2 that the path names, itself or by one of its files."""
    folder = path if path.is_dir() else path.parent
    named = path.is_dir() or path.name.startswith("dataset_")
    return folder if named and (folder / EVIMO2[0]).is_file() else None


def _evimo2(folder: Path) -> Layout:
    place = Place(folder)
    t, xy, p = (_vector(folder, place, name, 1 + (name == EVIMO2[1])) for name in EVIMO2)
    return Layout((t, xy, p), ((0, None), (1, 0), (1, 1), (2, None)))


def _image_size(folder: Path) -> Sensor | None:
    """The sensor of the first image of an EVIMO2v2 folder, or None without one."""
    for name in IMAGES:
        if (folder / name).is_file() and (members := _members(folder / name)):
            return _size_of(folder, Place(folder / name, ""), f"{members[0]}.npy")
    return None


def _size_of(path: Path, place: Place, name: str) -> Sensor | None:
    """The sensor of an image (H, W), a colour image (H, W, 3) or images (M, H, W)."""
    shape = _header(path, place, name).shape
    sides = shape[:2] if shape[2:] == (3,) else shape[-2:]
    try:
        return Sensor(*reversed(sides)) if len(sides) == 2 else None
    except InvalidField:
        return None


def _accepts(path: Path) -> bool:
    """Whether this is a .npy, a .npz with events that is not CARLA's, or a folder of EVIMO2v2."""
    if _evimo2_folder(path) is not None or path.is_dir():
        return _evimo2_folder(path) is not None
    if not _is_zip(path):
        return path.suffix.lower() == ".npy" or _head(path) == MAGIC
    try:
        names = _members(path)
        return not _CARLA & {f"{name}.npy" for name in names} and bool(set(MEMBERS) & set(names) or by_name(names))
    except (UnknownSource, Unclear):
        return False


def _is_zip(path: Path) -> bool:
    return _head(path).startswith(b"PK")


def _head(path: Path) -> bytes:
    with path.open("rb") as file:
        return file.read(len(MAGIC))


def _open(path: Path, sensor: Sensor | None, topic: str | None) -> ArrayRecording:
    refuse_topic(path, topic)
    return ArrayRecording.open(path, sensor)


FORMAT = Format(
    "FILE.npy, FILE.npz, or a folder of EVIMO2 (NumPy arrays of events)",
    _open,
    accepts=_accepts,
    signature=re.escape(MAGIC) + rb"|PK\x03\x04",
)
