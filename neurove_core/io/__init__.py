"""Recordings -> events: one reader per format, and a built-in pattern for a machine without any recording."""

from pathlib import Path

from neurove_core.io.aedat4 import Aedat4Recording
from neurove_core.io.datasets import open_hdf5
from neurove_core.io.dsec_write import write_dsec
from neurove_core.io.ecd import EcdRecording
from neurove_core.io.errors import BrokenRecording, MissingGeometry, UnknownSource
from neurove_core.io.pattern import Pattern
from neurove_core.io.poses import read_poses
from neurove_core.io.prophesee import PropheseeRecording
from neurove_core.io.recording import SUPPORTED, EventsOnly, Frame, Imu, Recording, Triggers, refuse_topic
from protocol.events import Sensor

__all__ = [
    "SUPPORTED",
    "BrokenRecording",
    "EventsOnly",
    "Frame",
    "Imu",
    "MissingGeometry",
    "Recording",
    "Triggers",
    "UnknownSource",
    "open_source",
    "read_poses",
    "write_dsec",
]


def open_source(source: str, sensor: Sensor | None = None, topic: str | None = None) -> Recording:
    """The recording that `source` names; see SUPPORTED.

    Args:
        source: a file, a folder, or `pattern://`.
        sensor: the pixel array; overrides what the recording says of itself.
        topic: which event stream, where a recording has several: `davis/right` of MVSEC, say; by default the first.

    Raises:
        UnknownSource: there is nothing of this name, nothing that can be read, or no such topic.
        MissingGeometry: the size of the sensor is neither given nor in the recording.
        BrokenRecording: not even its header is whole.
        MissingExtra: a library that reads it is not installed.
        InvalidField: the calibration beside it, or the pattern's query, is not what it must be.
    """
    scheme, separator, _ = source.partition("://")
    if separator:
        if scheme != "pattern":
            raise UnknownSource(source, SUPPORTED, f"unknown scheme {scheme}://")
        refuse_topic(source, topic)
        return Pattern.from_url(source, sensor)
    path = Path(source)
    try:
        return _open_path(path, sensor, topic)
    except OSError as error:
        raise UnknownSource(source, SUPPORTED, error.strerror or str(error)) from None


def _open_path(path: Path, sensor: Sensor | None, topic: str | None) -> Recording:
    if not path.exists():
        raise UnknownSource(path, SUPPORTED, "no such file or folder")
    if path.is_file() and path.suffix.lower() in (".h5", ".hdf5"):
        return open_hdf5(path, sensor, topic)
    refuse_topic(path, topic)
    if path.is_dir():
        if not (path / "events.txt").is_file():
            raise UnknownSource(path, SUPPORTED, "the folder has no events.txt")
        return EcdRecording.open(path / "events.txt", path.resolve().name, sensor)
    match path.suffix.lower():
        case ".aedat4":
            return Aedat4Recording.open(path, sensor)
        case ".raw":
            return PropheseeRecording.open(path, sensor)
        case ".txt":
            return EcdRecording.open(path, path.name, sensor)
        case suffix:
            raise UnknownSource(path, SUPPORTED, f"unknown suffix {suffix!r}" if suffix else "a file without suffix")
