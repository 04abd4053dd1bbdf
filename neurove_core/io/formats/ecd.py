"""Reader of the Event Camera Dataset (Mueggler 2017): events as text lines `t[s] x y p`, and the lens as nine numbers.

The same folder, or the .zip in which the data set is distributed, may also hold groundtruth.txt, imu.txt, and
images.txt with images.
"""

from bisect import bisect_left
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Self

import numpy as np
from numpy.typing import NDArray

from neurove_core.geometry.motion import Poses, Twists, twists
from neurove_core.io.archive import Place, folder_in_zip, read_image
from neurove_core.io.errors import BrokenRecording
from neurove_core.io.format import Format
from neurove_core.io.recording import BLOCK_BYTES, EventsOnly, Frame, Imu, in_chunks, refuse_topic
from neurove_protocol.camera import CameraInfo
from neurove_protocol.errors import EventOutsideSensor, InvalidField, TimeBackwards
from neurove_protocol.events import Events, Sensor, check_events

DAVIS240C = Sensor(240, 180)
"""The sensor that recorded the data set."""

MAX_T_S = 1e12  # [s]; a larger time is invalid
UNIT_WITHIN = 1e-2  # accepted distance from 1 of a quaternion's length, for files with few digits
_NO_T, _NO_POSES = np.empty(0, np.int64), np.empty((0, 7))
_FILES = {"imu": "imu.txt", "frames": "images.txt", "poses": "groundtruth.txt"}
_BAD = (ValueError, EventOutsideSensor, TimeBackwards)
_LINE = np.dtype([("t", "f8"), ("x", "u2"), ("y", "u2"), ("p", "u1")])
_CALIB = "expected nine numbers: fx fy cx cy k1 k2 p1 p2 k3, focal lengths above 0"


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
    endless: bool = False

    @classmethod
    def open(cls, path: Path, name: str, sensor: Sensor | None = None) -> Self:
        """Open the recording in this file.

        Args:
            path: the file of events, or a .zip with an events.txt in it.
            name: the name of the recording.
            sensor: the pixel array; by default that of a DAVIS240C.

        Raises:
            OSError: the file cannot be opened. InvalidField: the calib.txt of the folder is invalid.
            UnknownSource: the .zip is not a zip file, or has no events.txt.
        """
        path.open("rb").close()  # fail now if the file cannot be opened
        place, events_file = Place(path.parent), path.name
        if path.suffix.lower() == ".zip":
            place, events_file = Place(path, folder_in_zip(path, "events.txt")), "events.txt"
        sensor = sensor or DAVIS240C
        lens = None
        if place.has("calib.txt"):
            with place.open("calib.txt") as file:
                where = place.path / "calib.txt" if place.inside is None else path
                lens = parse_calib(where, file.read(1024), sensor)
        others = [stream for stream, file in _FILES.items() if place.has(file)]
        if "frames" in others and not _has_images(place):  # images.txt without its images
            others.remove("frames")
        streams = ("events", *others)
        return cls(path, name, sensor, lens, place, events_file, streams)

    def camera(self, stream: str) -> CameraInfo | None:
        """The lens of calib.txt, or None without one."""
        return self.lens and CameraInfo(**(self.lens.model_dump() | {"stream": stream}))

    def chunks(self) -> Iterator[Events]:
        """All events from the beginning; see `Recording`. Times are rounded to the nearest us.

        Raises:
            BrokenRecording: a line is not an event, or its event is outside the sensor or before the previous one; the
                error names the line.
        """
        first, not_before_us = 1, None
        for lines in self._blocks(self.events_file):
            n, why = len(lines), ""
            try:
                events = _parse(lines, self.sensor, not_before_us)
            except _BAD:
                n, why = _first_bad(lines, self.sensor, not_before_us)
                events = _parse(lines[:n], self.sensor, not_before_us)
            yield from in_chunks(events)
            if why:
                text = lines[n][:60].decode("ascii", "backslashreplace")
                raise BrokenRecording(self.path, f"line {first + n}", f"{why}: {text!r}")
            first += len(lines)
            not_before_us = int(events.t[-1]) if events.n else not_before_us

    def imu(self) -> Iterator[Imu]:
        """The samples of imu.txt, `t ax ay az gx gy gz` [s, m/s2, rad/s]; see `Recording`.

        The axes are those of the IMU. On these cameras they match the optical frame to within a few degrees.

        Raises:
            BrokenRecording: a line is not a sample, or is before the previous one; the error names the line.
        """
        if "imu" in self.streams:
            for t, rows in self._table(_FILES["imu"], 7):
                yield Imu(t, rows[:, :3].copy(), rows[:, 3:].copy())

    def poses(self) -> Poses | None:
        """The poses of groundtruth.txt, `t px py pz qx qy qz qw` [s, m], or None without one.

        Raises:
            BrokenRecording: a line is not a pose, or is before the previous one; the error names the line.
        """
        if "poses" not in self.streams:
            return None
        blocks = list(self._table(_FILES["poses"], 8))
        t, rows = (np.concatenate(columns) for columns in zip(*blocks, strict=True)) if blocks else (_NO_T, _NO_POSES)
        norm = np.linalg.norm(rows[:, 3:], axis=1, keepdims=True)
        bad = np.flatnonzero(np.abs(norm[:, 0] - 1) > UNIT_WITHIN)
        if bad.size:
            why = f"a quaternion of length {norm[bad[0], 0]:.4g} is not a rotation"
            raise BrokenRecording(self.path, f"{_FILES['poses']} pose {bad[0] + 1}", why)
        return Poses(t, rows[:, :3].copy(), rows[:, 3:] / norm)

    def twists(self) -> Twists | None:
        """Twists of the camera from its poses, by `geometry.twists`; None without poses."""
        poses = self.poses()
        return twists(poses) if poses is not None and poses.t.size > 1 else None

    def frames(self) -> Iterator[Frame]:
        """The images that images.txt lists, `t path` [s]; see `Recording`.

        Raises:
            MissingExtra: Pillow is not installed.
            BrokenRecording: a line does not name an image, is before the previous one, or its file does not exist or
                cannot be read; the error names the line.
        """
        if "frames" not in self.streams:
            return
        number, not_before_us = 0, None
        for lines in self._blocks(_FILES["frames"]):
            for line in lines:
                number += 1
                if not line.strip() or line.lstrip().startswith(b"#"):
                    continue
                frame = self._frame(line, f"{_FILES['frames']} line {number}", not_before_us)
                not_before_us = frame.t_us
                yield frame

    def _frame(self, line: bytes, where: str, not_before_us: int | None) -> Frame:
        try:
            t, path = line.decode().split()
            t_us = round(float(t) * 1e6)
        except (ValueError, OverflowError):
            raise BrokenRecording(self.path, where, f"the line is not `t[s] path`: {line[:60]!r}") from None
        if not_before_us is not None and t_us < not_before_us:
            raise BrokenRecording(self.path, where, "time runs backwards")
        parts = path.split("/")
        outside = ".." in parts or path.startswith("/")  # images.txt must not open files outside the recording
        if outside or not self.place.has(path):
            raise BrokenRecording(self.path, where, f"there is no image {path!r}")
        with self.place.open(path) as file:
            return Frame(t_us, read_image(self.path, where, file))

    def _table(self, name: str, columns: int) -> Iterator[tuple[NDArray[np.int64], NDArray[np.float64]]]:
        """Times [us] (N,) and the other columns of a text file of numbers, in blocks of about BLOCK_BYTES."""
        number, not_before_us = 0, -(1 << 62)
        for lines in self._blocks(name):
            kept = [line for line in lines if line.strip() and not line.lstrip().startswith(b"#")]
            try:
                rows = np.loadtxt(kept, comments=None, ndmin=2) if kept else np.empty((0, columns))
                bad = rows.shape[1] != columns or not np.isfinite(rows).all() or (np.abs(rows[:, 0]) >= MAX_T_S).any()
            except ValueError:
                bad = True
            if bad:
                at = next(i for i, line in enumerate(lines) if not _is_row(line, columns))
                text = lines[at][:60].decode("ascii", "backslashreplace")
                why = f"the line is not {columns} numbers: {text!r}"
                raise BrokenRecording(self.path, f"{name} line {number + at + 1}", why)
            t = np.rint(rows[:, 0] * 1e6).astype(np.int64)
            if (np.diff(t, prepend=not_before_us) < 0).any():
                raise BrokenRecording(self.path, f"{name} after line {number}", "time runs backwards")
            number += len(lines)
            if t.size:
                not_before_us = int(t[-1])
                yield t, rows[:, 1:]

    def _blocks(self, name: str) -> Iterator[list[bytes]]:
        """The lines of a file, in blocks of about BLOCK_BYTES."""
        rest = b""
        with self.place.open(name) as file:
            while block := file.read(BLOCK_BYTES):
                lines, newline, rest = (rest + block).rpartition(b"\n")
                if newline:
                    yield lines.split(b"\n")
                elif len(rest) > BLOCK_BYTES:  # not text: parsing it as one line reports the error
                    break
        if rest:
            yield [rest]


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


def _parse(lines: list[bytes], sensor: Sensor, not_before_us: int | None) -> Events:
    """The events of these lines. Blank lines and lines that begin with # are skipped.

    Raises:
        ValueError: a line is not `t[s] x y p`. EventOutsideSensor, TimeBackwards: the event is invalid.
    """
    if lines and b"#" in b"".join(lines):
        lines = [line for line in lines if not line.lstrip().startswith(b"#")]
    if not any(map(bytes.strip, lines)):
        return Events.empty()
    rows = np.loadtxt(lines, _LINE, comments=None, ndmin=1)
    if not (np.abs(rows["t"]) < MAX_T_S).all() or rows["p"].max() > 1:  # in this form nan fails
        raise ValueError("t is not finite or p is neither 0 nor 1")
    events = Events.from_columns(np.rint(rows["t"] * 1e6), rows["x"], rows["y"], rows["p"])
    check_events(events, sensor, not_before_us)
    return events


def _first_bad(lines: list[bytes], sensor: Sensor, not_before_us: int | None) -> tuple[int, str]:
    """How many lines come before the first invalid one, and what is wrong with that one.

    Finds it by bisection: once a span of leading lines fails, every longer span fails too.
    """

    def fault(stop: int) -> str:
        try:
            _parse(lines[:stop], sensor, not_before_us)
        except EventOutsideSensor:
            return f"the event lies outside the sensor {sensor}"
        except TimeBackwards:
            return "time runs backwards"
        except ValueError:
            return "the line is not `t[s] x y p`"
        return ""

    stop = bisect_left(range(1, len(lines)), True, key=lambda stop: fault(stop) != "") + 1
    return stop - 1, fault(stop)


def _accepts(path: Path) -> bool:
    """Whether this is a folder with events.txt, a text file, or an archive."""
    return (path / "events.txt").is_file() if path.is_dir() else path.suffix.lower() in (".txt", ".zip")


def _open(path: Path, sensor: Sensor | None, topic: str | None) -> EcdRecording:
    refuse_topic(path, topic)
    if path.is_dir():
        return EcdRecording.open(path / "events.txt", path.resolve().name, sensor)
    return EcdRecording.open(path, path.name, sensor)


FORMAT = Format(
    "a folder with events.txt, a FILE.zip with one, or FILE.txt (Event Camera Dataset)", _open, accepts=_accepts
)
