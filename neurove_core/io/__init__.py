"""Recordings -> events: one reader per format, and a built-in pattern for a machine without any recording."""

from pathlib import Path

from neurove_core.io.aedat4 import Aedat4Recording
from neurove_core.io.ecd import EcdRecording
from neurove_core.io.errors import BrokenRecording, MissingGeometry, UnknownSource
from neurove_core.io.mcap_file import McapFile
from neurove_core.io.mcap_layout import PROFILE
from neurove_core.io.mcap_recording import McapRecording, RecordedPacket
from neurove_core.io.mcap_write import PacketWriter, write_mcap
from neurove_core.io.pattern import Pattern
from neurove_core.io.prophesee import PropheseeRecording
from neurove_core.io.recording import SUPPORTED, EventsOnly, Frame, Imu, Recording, Triggers
from neurove_core.io.rosbag import RosbagRecording
from protocol.events import Sensor

__all__ = [
    "SUPPORTED",
    "BrokenRecording",
    "EventsOnly",
    "Frame",
    "Imu",
    "McapRecording",
    "MissingGeometry",
    "PacketWriter",
    "RecordedPacket",
    "Recording",
    "Triggers",
    "UnknownSource",
    "open_source",
    "write_mcap",
]


def open_source(source: str, sensor: Sensor | None = None, topic: str | None = None) -> Recording:
    """The recording that `source` names; see SUPPORTED.

    Args:
        source: a file, a folder, `pattern://`, or `sim://SCENE?...`.
        sensor: the pixel array; overrides what the recording says of itself.
        topic: which of several event streams, where the recording has names for them; by default the first.

    Raises:
        UnknownSource: there is nothing of this name, or nothing that can be read, or no such topic.
        MissingGeometry: the size of the sensor is neither given nor in the recording.
        BrokenRecording: not even its header is whole.
        InvalidField: the calibration beside it, or the query of a pattern or a simulation, is not what it must be.
    """
    scheme, separator, _ = source.partition("://")
    if separator:
        if scheme == "sim":
            from neurove_core.sim.source import simulation_of  # it needs this package itself

            return simulation_of(source, sensor)
        if scheme != "pattern":
            raise UnknownSource(source, SUPPORTED, f"unknown scheme {scheme}://")
        return Pattern.from_url(source, sensor)
    path = Path(source)
    try:
        return _open_path(path, sensor, topic)
    except OSError as error:
        raise UnknownSource(source, SUPPORTED, error.strerror or str(error)) from None


def _open_path(path: Path, sensor: Sensor | None, topic: str | None) -> Recording:
    if not path.exists():
        raise UnknownSource(path, SUPPORTED, "no such file or folder")
    if path.is_dir():
        if _is_bag(path):
            return RosbagRecording.open(path, sensor, topic)
        if not (path / "events.txt").is_file():
            raise UnknownSource(path, SUPPORTED, "the folder has no events.txt")
        return EcdRecording.open(path / "events.txt", path.resolve().name, sensor)
    match path.suffix.lower():
        case ".aedat4":
            return Aedat4Recording.open(path, sensor)
        case ".raw":
            return PropheseeRecording.open(path, sensor)
        case ".mcap" if McapFile.open(path).profile == PROFILE:
            return McapRecording.open(path, sensor, topic)
        case ".bag" | ".db3" | ".mcap":
            return RosbagRecording.open(path, sensor, topic)
        case ".txt":
            return EcdRecording.open(path, path.name, sensor)
        case suffix:
            raise UnknownSource(path, SUPPORTED, f"unknown suffix {suffix!r}" if suffix else "a file without suffix")


def _is_bag(folder: Path) -> bool:
    """Whether this is a folder of rosbag2; its metadata.yaml is missing where the recorder was killed."""
    return any(path.name == "metadata.yaml" or path.suffix in (".db3", ".mcap") for path in folder.iterdir())
