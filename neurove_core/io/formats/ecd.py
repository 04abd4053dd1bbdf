"""Reader of events as text, and of the Event Camera Dataset (Mueggler 2017): lines `t[s] x y p`, the lens in calib.txt.

Other columns and separators are recognised, see `dialect`.

The same folder, or the .zip in which the data set is distributed, may also hold groundtruth.txt, imu.txt, and
images.txt with images.
"""

from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from neurove_core.geometry.motion import Poses, Twists, twists
from neurove_core.io.archive import Place, folder_in_zip, read_image
from neurove_core.io.checked import cleaned, ordered, until_broken
from neurove_core.io.errors import BrokenRecording, UnknownSource
from neurove_core.io.faults import Faults, Reason, Tally
from neurove_core.io.format import Format
from neurove_core.io.formats.columns import Unclear
from neurove_core.io.formats.dialect import ECD, HEAD_BYTES, Dialect, count_lines, detect, is_blank, line_of, pieces
from neurove_core.io.order import Where
from neurove_core.io.recording import BLOCK_BYTES, EventsOnly, Frame, refuse_topic
from neurove_core.io.units import SAMPLE, UNITS, TimeSample
from neurove_protocol.camera import CameraInfo
from neurove_protocol.errors import InvalidField
from neurove_protocol.events import Events, Sensor
from neurove_protocol.imu import Imu

DAVIS240C = Sensor(240, 180)
"""The sensor that recorded the data set."""

MAX_T_S = 1e12  # [s]; a larger time is invalid
UNIT_WITHIN = 1e-2  # accepted distance from 1 of a quaternion's length, for files with few digits
_FILES = {"imu": "imu.txt", "frames": "images.txt", "poses": "groundtruth.txt"}
_ASSUMED = ", which is assumed, because the file does not give its sensor: give --sensor WIDTHxHEIGHT"
_CALIB = "expected nine numbers: fx fy cx cy k1 k2 p1 p2 k3, focal lengths above 0"


class _Rows(NamedTuple):
    """Rows of a text file of numbers."""

    t: NDArray[np.int64]  # (N,) [us]
    values: NDArray[np.float64]  # (N, columns - 1)


@dataclass(frozen=True, slots=True)
class EcdRecording(EventsOnly):
    """A text file of events with the other files of its folder, or the same in a .zip; see `Recording`.

    Images, IMU samples and poses come from the same folder, where it has them.
    """

    path: Path
    name: str
    sensor: Sensor
    lens: CameraInfo | None
    place: Place
    events_file: str
    streams: tuple[str, ...]
    dialect: Dialect = ECD
    assumed: bool = False  # neither the file nor the caller gives the sensor
    endless: bool = False
    faults: Faults = field(default_factory=Faults, compare=False, repr=False)

    @classmethod
    def open(cls, path: Path, name: str, sensor: Sensor | None = None) -> Self:
        """Open the recording in this file.

        Args:
            path: the file of events, or a .zip with an events.txt in it.
            name: the name of the recording.
            sensor: the pixel array; by default that of the file, or of a DAVIS240C if the file does not give it.

        Raises:
            OSError: the file cannot be opened. InvalidField: the calib.txt of the folder is invalid.
            UnknownSource: the .zip is not a zip file, or has no events.txt; or the columns of the events are not clear.
        """
        path.open("rb").close()  # fail now if the file cannot be opened
        place, events_file = Place(path.parent), path.name
        if path.suffix.lower() == ".zip":
            place, events_file = Place(path, folder_in_zip(path, "events.txt")), "events.txt"
        dialect = _dialect(path, place, events_file)
        known = sensor or dialect.sensor
        sensor = known or DAVIS240C
        lens = None
        if place.has("calib.txt"):
            with place.open("calib.txt") as file:
                where = place.path / "calib.txt" if place.inside is None else path
                lens = parse_calib(where, file.read(1024), sensor)
        others = [stream for stream, file in _FILES.items() if place.has(file)]
        if "frames" in others and not _has_images(place):  # images.txt without its images
            others.remove("frames")
        streams = ("events", *others)
        return cls(path, name, sensor, lens, place, events_file, streams, dialect, known is None)

    def time_sample(self) -> TimeSample | None:
        """Times of the first events, see `Timed`."""
        columns = self.dialect.columns
        unit = next((name for name, us in UNITS.items() if us == columns.unit_us), "s")
        try:
            with self.place.open(self.events_file) as file:
                lines = file.read(HEAD_BYTES).split(b"\n")[self.dialect.skip : -1]
        except BrokenRecording:  # reading the events reports it
            return None
        rows = [self.dialect.plain(line).split() for line in lines if not is_blank(line)]
        try:
            times = np.array([row[columns.t] for row in rows if len(row) == self.dialect.numbers][:SAMPLE], np.float64)
        except ValueError:
            return None
        return TimeSample(self.path, times, unit, 0)

    def in_unit(self, unit: str) -> Self:
        """The same recording with the times of its events in another unit, see `Timed`."""
        columns = self.dialect.columns._replace(unit_us=UNITS[unit])
        return replace(self, dialect=self.dialect._replace(columns=columns))

    def camera(self, stream: str) -> CameraInfo | None:
        """The lens of calib.txt, or None without one."""
        return self.lens and CameraInfo(**(self.lens.model_dump() | {"stream": stream}))

    def chunks(self) -> Iterator[Events]:
        """All events from the beginning; see `Recording`. Times are rounded to the nearest us."""
        tally = self.faults.begin("events")
        found = pieces(self._blocks(self.events_file), self.dialect, tally)
        return cleaned(found, self.sensor, tally, _ASSUMED if self.assumed else "")

    def imu(self) -> Iterator[Imu]:
        """The samples of imu.txt, `t ax ay az gx gy gz` [s, m/s2, rad/s]; see `Recording`.

        The driver rpg_dvs_ros has rotated them into the optical frame; the unit is mounted to within a few degrees.
        """
        if "imu" in self.streams:
            tally = self.faults.begin("imu")
            for t, rows in ordered(self._table(_FILES["imu"], 7, tally), tally):
                yield Imu(t, rows[:, :3].copy(), rows[:, 3:].copy())

    def poses(self) -> Poses | None:
        """The poses of groundtruth.txt, `t px py pz qx qy qz qw` [s, m], or None without one."""
        if "poses" not in self.streams:
            return None
        tally = self.faults.begin("poses")
        blocks = list(ordered(self._table(_FILES["poses"], 8, tally), tally))
        t = np.concatenate([np.empty(0, np.int64), *(block.t for block in blocks)])
        rows = np.concatenate([np.empty((0, 7)), *(block.values for block in blocks)])
        norm = np.linalg.norm(rows[:, 3:], axis=1, keepdims=True)
        unit = np.abs(norm[:, 0] - 1) <= UNIT_WITHIN
        if not unit.all():
            first = int(unit.argmin())
            why = f"a quaternion of length {norm[first, 0]:.4g} is not a rotation"
            tally.add(Reason.INVALID, f"{_FILES['poses']} pose {first + 1}", why, int(np.count_nonzero(~unit)))
        return Poses(t[unit], rows[unit, :3], rows[unit, 3:] / norm[unit])

    def twists(self) -> Twists | None:
        """Twists of the camera from its poses, by `geometry.twists`; None without poses."""
        poses = self.poses()
        return twists(poses) if poses is not None and poses.t.size > 1 else None

    def frames(self) -> Iterator[Frame]:
        """The images that images.txt lists, `t path` [s]; see `Recording`.

        Raises:
            MissingExtra: Pillow is not installed.
        """
        if "frames" not in self.streams:
            return
        tally = self.faults.begin("frames")
        yield from until_broken(self._frames(tally), tally)

    def _frames(self, tally: Tally) -> Iterator[Frame]:
        not_before_us: int | None = None
        for first, lines in self._blocks(_FILES["frames"]):
            for i, line in enumerate(lines):
                where = f"{_FILES['frames']} line {first + i}"
                if is_blank(line):
                    continue
                try:
                    frame = self._frame(line, where)
                except BrokenRecording as error:
                    tally.add(Reason.DAMAGED, where, error.why)
                    continue
                if not_before_us is not None and frame.t_us < not_before_us:
                    tally.add(Reason.LATE, where, f"t={frame.t_us} us comes after t={not_before_us} us")
                    continue
                not_before_us = frame.t_us
                yield frame

    def _frame(self, line: bytes, where: str) -> Frame:
        try:
            t, path = line.decode().split()
            t_us = round(float(t) * 1e6)
        except (ValueError, OverflowError):
            raise BrokenRecording(self.path, where, f"the line is not `t[s] path`: {line[:60]!r}") from None
        parts = path.split("/")
        outside = ".." in parts or path.startswith("/")  # images.txt must not open files outside the recording
        if outside or not self.place.has(path):
            raise BrokenRecording(self.path, where, f"there is no image {path!r}")
        with self.place.open(path) as file:
            return Frame(t_us, read_image(self.path, where, file))

    def _table(self, name: str, columns: int, tally: Tally) -> Iterator[tuple[Where, _Rows]]:
        """Times [us] (N,) and the other columns of a text file of numbers, in blocks of about BLOCK_BYTES."""
        for first, lines in self._blocks(name):
            valid = [_is_row(line, columns) for line in lines]
            count_lines(tally, first, lines, valid, f"the line is not {columns} numbers", name + " ")
            kept = [line if good else b"" for line, good in zip(lines, valid, strict=True)]
            numbers = [line.split() for line in kept if not is_blank(line)]
            rows = np.array(numbers, np.float64) if numbers else np.empty((0, columns))
            t = np.rint(rows[:, 0] * 1e6).astype(np.int64)
            yield line_of(first, kept, name + " "), _Rows(t, rows[:, 1:])

    def _blocks(self, name: str) -> Iterator[tuple[int, list[bytes]]]:
        """The number of the first line, and the lines of a file, in blocks of about BLOCK_BYTES."""
        rest, first = b"", 1
        with self.place.open(name) as file:
            while block := file.read(BLOCK_BYTES):
                text, newline, rest = (rest + block).rpartition(b"\n")
                if newline:
                    lines = text.split(b"\n")
                elif len(rest) > BLOCK_BYTES:  # not text: one line, which is not valid
                    lines, rest = [rest], b""
                else:
                    continue
                yield first, lines
                first += len(lines)
        if rest:
            yield first, [rest]


def _is_row(line: bytes, columns: int) -> bool:
    """Whether a line has this many numbers, is blank, or is a comment."""
    fields = line.split()
    if not fields or fields[0].startswith(b"#"):
        return True
    try:
        return (
            len(fields) == columns
            and all(np.isfinite(float(field)) for field in fields)
            and abs(float(fields[0])) < MAX_T_S
        )
    except ValueError:
        return False


def _has_images(place: Place) -> bool:
    """Whether the first image that images.txt lists exists."""
    with place.open(_FILES["frames"]) as file:
        lines = [line.split() for line in file.read(4096).splitlines()]
    paths = [
        words[1].decode("utf-8", "replace") for words in lines if len(words) == 2 and not words[0].startswith(b"#")
    ]
    return not paths or ".." in paths[0].split("/") or place.has(paths[0])


def _dialect(path: Path, place: Place, events_file: str) -> Dialect:
    try:
        with place.open(events_file) as file:
            head = file.read(HEAD_BYTES)
    except BrokenRecording:
        return ECD  # the first chunk of events reports it
    try:
        return detect(head)
    except Unclear as error:
        raise UnknownSource(path, str(error)) from None


def parse_calib(path: Path, data: bytes, sensor: Sensor) -> CameraInfo:
    """The lens in a calib.txt: `fx fy cx cy k1 k2 p1 p2 k3` [px, dimensionless].

    Raises:
        InvalidField: the text is not nine valid numbers; the error names the file.
    """
    text = data.decode("ascii", "backslashreplace").strip()
    try:
        fx, fy, cx, cy, *distortion = (float(number) for number in text.split())
        if len(distortion) != 5:
            raise ValueError(f"{4 + len(distortion)} numbers")
        return CameraInfo(
            stream="recording",
            width=sensor.width,
            height=sensor.height,
            lens="pinhole",
            fx=fx,
            fy=fy,
            cx=cx,
            cy=cy,
            distortion=tuple(distortion),
        )
    except ValueError:  # pydantic's error is a ValueError
        raise InvalidField(str(path), "calib", text, _CALIB) from None


def _accepts(path: Path) -> bool:
    """Whether this is a folder with events.txt, a text file, or an archive."""
    return (path / "events.txt").is_file() if path.is_dir() else path.suffix.lower() in (".txt", ".csv", ".tsv", ".zip")


def _open(path: Path, sensor: Sensor | None, topic: str | None) -> EcdRecording:
    refuse_topic(path, topic)
    if path.is_dir():
        return EcdRecording.open(path / "events.txt", path.resolve().name, sensor)
    return EcdRecording.open(path, path.name, sensor)


FORMAT = Format(
    "a folder with events.txt, a FILE.zip with one, or FILE.txt, FILE.csv, FILE.tsv (Event Camera Dataset, text)",
    _open,
    accepts=_accepts,
)
