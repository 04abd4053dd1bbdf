"""The known motion of a robot for its recording: from a topic of a bag, a file, or the recording itself."""

import csv
from dataclasses import dataclass
from pathlib import Path
from typing import Final, Literal

import numpy as np
from numpy.typing import NDArray

from neurove_core.geometry import motion
from neurove_core.geometry.motion import Twists
from neurove_core.geometry.mounting import Mounting
from neurove_core.io import Recording, UnknownSource
from neurove_core.io.faults import Fault, Tally
from neurove_core.io.formats.containers.bags import BagFile
from neurove_core.io.formats.pose_files import NANOSECONDS_FROM, US_PER_UNIT, read_truth
from neurove_core.io.formats.ros.odometry import motion_topics, read_motion
from neurove_core.io.formats.ros.recording import RosbagRecording, open_bag
from neurove_protocol.errors import InvalidField

Frame = Literal["base", "camera"]

BAG_SUFFIXES: Final = (".bag", ".db3", ".mcap")
MAX_SAMPLES: Final = 1 << 22

_FORWARD: Final = "forward speed"
_UNITS: Final = ("s", "ms", "us", "ns")


@dataclass(frozen=True)
class Asked:
    """What the user says about the truth of a recording."""

    file: Path | None = None  # poses as text or HDF5, wheel speed as CSV `t,v`, or a bag
    topic: str | None = None  # of the bag
    unit: str | None = None  # of the times in a text file: s, ms, us or ns
    frame: Frame | None = None  # whose motion it is; None: as the source usually has it
    mounting: Mounting | None = None  # of the camera on the base; None: level, looks forward, at the base


@dataclass(frozen=True)
class Truth:
    """The twists of the camera, on the clock of the recording until an offset is known."""

    twists: Twists  # of the camera; nan: unknown
    about: str  # source, frame and what was assumed
    faults: tuple[Fault, ...] = ()

    @property
    def axes(self) -> NDArray[np.bool_]:
        """The axes (6) that are known anywhere."""
        return np.asarray(np.isfinite(self.twists.twist).any(0), np.bool_)


def read(recording: Recording, asked: Asked) -> Truth:
    """Read the truth of a recording and convert it to the camera's optical frame.

    Odometry, twists and wheel speed are of the robot's base by default. Pose files and the recording's own truth are of
    the camera by default.

    Args:
        recording: as `open_source` gives it; its clock is the clock of the result, as far as the source says.
        asked: where the truth is and what it means.

    Raises:
        InvalidField: the file or the topic cannot be used, the recording has no truth, or the truth never moves.
        UnknownSource: a file does not exist, or a bag has no such topic.
    """
    tally = Tally("truth")
    base, source, usual = _source(recording, asked, tally)
    mounting = asked.mounting or Mounting.from_angles()
    frame = asked.frame or usual
    rate = (len(base.t) - 1) / max(1e-6, (int(base.t[-1]) - int(base.t[0])) / 1e6)
    about = (
        f"{source}, {len(base.t)} samples at {rate:.0f} Hz, motion of the {'robot base' if frame == 'base' else frame}"
    )
    if np.isnan(base.twist[:, 1:]).all():  # column 0 is the forward speed of the base
        found = mounting.of_forward_speed(base.t, base.twist[:, 0])
        about += "; only vz is known and learned"
    else:
        found = base if frame == "camera" else mounting.of_base(base)
    if frame == "base" and asked.mounting is None:
        about += (
            "; assumed: the camera looks forward, level, at the base (else --extrinsics, or --mount and --position)"
        )
    _check_motion(source, found)
    return Truth(found, about, tally.faults)


def read_wheel_speed(path: Path, unit: str | None = None) -> Twists:
    """Read the forward speed of a robot from lines `t,v` [m/s]; a first line without numbers is a header.

    Args:
        path: of the file; `#` begins a comment.
        unit: of the times; by default seconds, or nanoseconds for whole numbers above 1e14.

    Returns:
        twists of the base of which only vx is known.

    Raises:
        InvalidField: a line is not two numbers, a time is not after the one before it, or there are fewer than two.
    """
    rows: list[tuple[float, float]] = []
    whole = True
    with path.open(encoding="utf-8-sig", errors="backslashreplace", newline="") as file:
        for number, row in enumerate(csv.reader(line.partition("#")[0] for line in file), 1):
            cells = [cell.strip() for cell in row if cell.strip()]
            if not cells:
                continue
            try:
                t, v = (float(cell) for cell in cells)
            except ValueError:
                if not rows and number == 1 and len(cells) == 2:
                    continue  # names of the columns
                raise InvalidField(f"{path}: line {number}", "row", ",".join(row), "expected `t,v`") from None
            whole = whole and "." not in cells[0] and "e" not in cells[0].lower()
            rows.append((t, v))
            if len(rows) > MAX_SAMPLES:
                raise InvalidField(str(path), "rows", len(rows), f"at most {MAX_SAMPLES} are allowed")
    if len(rows) < 2:
        raise InvalidField(str(path), "rows", len(rows), "expected at least two lines `t,v`")
    t, v = np.array(rows).T
    scale = US_PER_UNIT[unit] if unit else 1e-3 if whole and t[-1] > NANOSECONDS_FROM else 1e6
    if not (np.isfinite(t).all() and np.isfinite(v).all()):
        raise InvalidField(str(path), "rows", int((~np.isfinite(t + v)).argmax()) + 1, "must be finite numbers")
    if (np.diff(t) <= 0).any():
        first = int((np.diff(t) <= 0).argmax()) + 1
        raise InvalidField(
            str(path), "t", float(t[first]), f"must be later than {float(t[first - 1])!r} of the row before"
        )
    twist = np.full((len(t), 6), np.nan)
    twist[:, 0] = v
    return Twists(np.rint(t * scale).astype(np.int64), twist)


def check_overlap(name: str, truth: Twists, start_us: int, end_us: int, unit: str | None) -> None:
    """Refuse a truth whose times do not overlap with those of the events; the error suggests a unit where one fits.

    Args:
        name: of the recording.
        truth: on the clock of the recording.
        start_us: of the events.
        end_us: of the events.
        unit: that the user gave for the times of the truth.

    Raises:
        InvalidField: they overlap by less than half of the shorter one, or one is 100 times as long as the other.
    """
    first, last = int(truth.t[0]), int(truth.t[-1])
    events_s, truth_s = (end_us - start_us) / 1e6, (last - first) / 1e6
    common_s = (min(end_us, last) - max(start_us, first)) / 1e6
    if common_s >= 0.5 * min(events_s, truth_s) and 0.01 < truth_s / max(events_s, 1e-6) < 100:
        return
    spans = f"events {start_us / 1e6:.3f} to {end_us / 1e6:.3f} s, truth {first / 1e6:.3f} to {last / 1e6:.3f} s"
    ratio = truth_s / max(events_s, 1e-6)
    was = unit or "s"
    right = [
        one
        for one in _UNITS
        if one != was and 0.3 < ratio * US_PER_UNIT[one] / US_PER_UNIT[was] < 3 and not 0.3 < ratio < 3
    ]
    hint = (
        f"; their lengths would agree with --truth-unit {right[0]}" if right else "; --offset SECONDS moves the truth"
    )
    raise InvalidField(name, "truth", spans, f"the times of the truth must overlap with those of the events{hint}")


def _source(recording: Recording, asked: Asked, tally: Tally) -> tuple[Twists, str, Frame]:
    """Motion, its source in words, and the frame that such a source usually has."""
    bag_of_recording = recording if isinstance(recording, RosbagRecording) else None
    path = asked.file
    if path is not None and (path.is_dir() or path.suffix.lower() in BAG_SUFFIXES):
        offset = bag_of_recording.ros_offset_us if bag_of_recording else 0
        return _topic(open_bag(path), asked, offset, tally)
    if path is not None:
        return _text(path, asked)
    if bag_of_recording is not None:
        return _topic(bag_of_recording.bag, asked, bag_of_recording.ros_offset_us, tally)
    if asked.topic is not None:
        raise InvalidField("adapt", "--topic", asked.topic, f"{recording.name} is not a ROS bag: give --truth FILE")
    own = recording.twists()
    if own is None or not len(own.t):
        why = "it has no truth: give --truth FILE (a pose file, a CSV `t,v` or a bag)"
        raise InvalidField("adapt", "RECORDING", recording.name, why)
    return own, "truth in the recording", "camera"


def _topic(bag: BagFile, asked: Asked, offset_us: int, tally: Tally) -> tuple[Twists, str, Frame]:
    topic, known = asked.topic, motion_topics(bag)
    if topic is None:
        if len(known) != 1:
            found = ", ".join(f"{name} ({kind})" for name, kind in known.items()) or "none"
            raise InvalidField(
                "adapt", "--topic", None, f"choose the topic of the robot's motion; {bag.path.name} has {found}"
            )
        topic = next(iter(known))
    found_twists = read_motion(bag, topic, offset_us, tally)
    return found_twists, f"{topic} ({bag.topics[topic]})", "base"


def _text(path: Path, asked: Asked) -> tuple[Twists, str, Frame]:
    if not path.is_file():
        raise UnknownSource(path, "No such file")
    if asked.topic is not None:
        raise InvalidField("adapt", "--topic", asked.topic, f"{path.name} is not a ROS bag")
    if path.suffix.lower() not in (".h5", ".hdf5") and _columns(path) == 2:
        return read_wheel_speed(path, asked.unit), f"{_FORWARD} in {path.name}", "base"
    poses = read_truth(path, asked.unit)
    if len(poses.t) < 2:
        raise InvalidField("adapt", "--truth", str(path), "has fewer than two poses")
    return motion.twists(poses), f"poses in {path.name}", "camera"


def _columns(path: Path) -> int:
    """Number of columns of the first line with content."""
    with path.open(encoding="utf-8-sig", errors="backslashreplace") as file:
        for raw in file:
            line = raw.partition("#")[0].strip()
            if line:
                return len(line.replace(",", " ").split())
    return 0


def _check_motion(source: str, found: Twists) -> None:
    known = np.isfinite(found.twist)
    if not known.any():
        raise InvalidField("adapt", "truth", source, "no twist follows from it: its samples are too sparse")
    lengths = np.abs(np.where(known, found.twist, 0)).max(0)
    if lengths[:3].max() < 0.05 and lengths[3:].max() < 0.02:
        raise InvalidField("adapt", "truth", source, "it never moves: nothing can be learned from a stationary robot")
