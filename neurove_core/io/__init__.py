"""Recordings -> events: one reader per format, and a built-in pattern for a machine without any recording."""

from pathlib import Path

from neurove_core.io.errors import BrokenRecording, MissingGeometry, UnknownSource
from neurove_core.io.formats.aedat.aedat2 import Aedat2Recording
from neurove_core.io.formats.aedat.aedat4 import Aedat4Recording
from neurove_core.io.formats.carla import CarlaRecording
from neurove_core.io.formats.containers.mcap import McapFile
from neurove_core.io.formats.ecd import EcdRecording
from neurove_core.io.formats.evbench import EvbenchRecording
from neurove_core.io.formats.eventstream import EventStreamRecording
from neurove_core.io.formats.hdf5.datasets import open_hdf5
from neurove_core.io.formats.hdf5.dsec_write import write_dsec
from neurove_core.io.formats.packet_log.layout import PROFILE
from neurove_core.io.formats.packet_log.reader import McapRecording, RecordedPacket
from neurove_core.io.formats.packet_log.writer import PacketWriter, write_mcap
from neurove_core.io.formats.pattern import Pattern
from neurove_core.io.formats.prophesee.dat import DatRecording
from neurove_core.io.formats.prophesee.raw import PropheseeRecording
from neurove_core.io.formats.ros.recording import RosbagRecording
from neurove_core.io.poses import read_poses
from neurove_core.io.recording import SUPPORTED, EventsOnly, Frame, Imu, Recording, Triggers, refuse_topic
from neurove_protocol.events import Sensor

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
    "read_poses",
    "write_dsec",
    "write_mcap",
]


def open_source(source: str, sensor: Sensor | None = None, topic: str | None = None) -> Recording:
    """The recording that `source` names; see SUPPORTED.

    Args:
        source: a file, a folder, `pattern://`, or `sim://SCENE?...`.
        sensor: the pixel array; overrides what the recording says of itself.
        topic: which event stream, where a recording has several: `davis/right` of MVSEC, say; by default the first.

    Raises:
        UnknownSource: there is nothing of this name, nothing that can be read, or no such topic.
        MissingGeometry: the size of the sensor is neither given nor in the recording.
        BrokenRecording: not even its header is whole.
        MissingExtra: a library that reads it is not installed.
        InvalidField: the calibration beside it, or the query of a pattern or a simulation, is not what it must be.
    """
    scheme, separator, _ = source.partition("://")
    if separator:
        if scheme not in ("sim", "pattern"):
            raise UnknownSource(source, SUPPORTED, f"unknown scheme {scheme}://")
        refuse_topic(source, topic)
        if scheme == "sim":
            from neurove_core.sim.source import simulation_of  # it needs this package itself

            return simulation_of(source, sensor)
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
    if _is_bag(path):
        ours = path.suffix.lower() == ".mcap" and path.is_file() and McapFile.open(path).profile == PROFILE
        return (McapRecording if ours else RosbagRecording).open(path, sensor, topic)
    refuse_topic(path, topic)
    if path.is_dir():
        if not (path / "events.txt").is_file():
            raise UnknownSource(path, SUPPORTED, "the folder has no events.txt")
        return EcdRecording.open(path / "events.txt", path.resolve().name, sensor)
    match path.suffix.lower():
        case ".aedat4":
            return Aedat4Recording.open(path, sensor)
        case ".aedat":
            return Aedat2Recording.open(path, sensor)
        case ".raw":
            return PropheseeRecording.open(path, sensor)
        case ".dat":
            return DatRecording.open(path, sensor)
        case ".es":
            return EventStreamRecording.open(path, sensor)
        case ".npz":
            return CarlaRecording.open(path, sensor)
        case ".mat":
            return EvbenchRecording.open(path, sensor)
        case ".txt" | ".zip":
            return EcdRecording.open(path, path.name, sensor)
        case suffix:
            raise UnknownSource(path, SUPPORTED, f"unknown suffix {suffix!r}" if suffix else "a file without suffix")


def _is_bag(path: Path) -> bool:
    """Whether this is a bag or an .mcap of ours; the metadata.yaml of a folder is missing where its recorder died."""
    if path.is_file():
        return path.suffix.lower() in (".bag", ".db3", ".mcap")
    if (path / "events.txt").is_file():
        return False
    return any(
        one.name == "metadata.yaml" or one.name.endswith((".db3", ".mcap", ".db3.zstd", ".mcap.zstd"))
        for one in path.iterdir()
    )
