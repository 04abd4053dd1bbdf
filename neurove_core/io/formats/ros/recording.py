"""ROS bags: a .bag of ROS 1; .db3, .mcap or a folder of them of ROS 2. All that they hold of one camera."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import takewhile
from pathlib import Path
from typing import Final, Self, TypeVar

import numpy as np

from neurove_core.geometry import motion
from neurove_core.geometry.motion import Poses, Twists
from neurove_core.io.checked import checked
from neurove_core.io.errors import BrokenRecording, MissingGeometry, UnknownSource
from neurove_core.io.format import Format
from neurove_core.io.formats.containers.bags import BagFile, BagFolder, BagMessage, SqliteBag, in_recorded_order
from neurove_core.io.formats.containers.mcap import McapFile
from neurove_core.io.formats.containers.ros1 import Ros1Bag
from neurove_core.io.formats.ros import messages
from neurove_core.io.formats.ros.events import UNIX_TIME, Anchor, Decoder
from neurove_core.io.formats.ros.messages import BadMessage, EventMessage
from neurove_core.io.recording import EventsOnly, Imu, Triggers, later
from neurove_protocol.camera import CameraInfo
from neurove_protocol.errors import InvalidField
from neurove_protocol.events import Events, Sensor

EVENT_TYPES: Final = ("event_camera_msgs/EventPacket", "event_array_msgs/EventArray", "dvs_msgs/EventArray")
IMU_TYPE: Final = "sensor_msgs/Imu"
CAMERA_TYPE: Final = "sensor_msgs/CameraInfo"
POSE_TYPES: Final = ("geometry_msgs/PoseStamped", "nav_msgs/Odometry")

_BATCH = 4096  # samples of an inertial unit handed out at once
_EARLY_NS = 2_000_000_000  # how far before the wanted time messages are read: host and sensor clock drift apart

T = TypeVar("T")


def open_bag(path: Path) -> BagFile:
    """The bag of this name, whatever its container.

    Raises:
        UnknownSource: it is none.
    """
    if path.is_dir():
        return BagFolder(path, tuple(open_bag(file) for file in in_recorded_order(path)))
    match path.suffix.lower():
        case ".bag":
            return Ros1Bag.open(path)
        case ".db3":
            return SqliteBag.open(path)
        case ".mcap":
            return McapFile.open(path)
        case suffix:
            raise UnknownSource(path, f"no bag has the suffix {suffix!r}")


@dataclass(frozen=True, slots=True)
class RosbagRecording(EventsOnly):
    """One camera of a ROS bag; see `Recording`.

    Times of `evt3` and `mono` messages are the sensor's clock, wraps counted on; those of `libcaer`, `libcaer_cmp` and
    dvs_msgs are unix time. What else the bag holds has its header's stamp, less `ros_offset_us`.
    """

    path: Path
    name: str
    sensor: Sensor
    topic: str
    bag: BagFile
    first: EventMessage
    endless: bool = False

    @classmethod
    def open(cls, path: Path, sensor: Sensor | None = None, topic: str | None = None) -> Self:
        """One camera of the bag.

        Args:
            path: the file or folder.
            sensor: the pixel array; overrides the messages'.
            topic: of the events; by default the first one by name, and the recording's name tells which.

        Raises:
            UnknownSource: it is no bag, or has no such topic of events.
            MissingGeometry: its messages do not tell the sensor's size. BrokenRecording: not even the first is whole.
        """
        bag = open_bag(path)
        topics = sorted(name for name, kind in bag.topics.items() if kind in EVENT_TYPES)
        if not topics or topic not in (None, *topics):
            known = ", ".join(topics or sorted(bag.topics)) or "none"
            what = f"topic {topic!r} has no events; topics with events are" if topics else "no topic has events; it has"
            raise UnknownSource(path, f"{what} {known}")
        name = path.resolve().name
        if topic is not None:
            name = f"{name} ({topic})"
        elif len(topics) > 1:
            name = f"{name} ({topics[0]}, the first of {len(topics)} topics with events)"
        topic = topic or topics[0]
        first = _first(path, bag, topic)
        try:
            sensor = sensor or Sensor(first.width, first.height)
        except InvalidField:
            raise MissingGeometry(path) from None
        return cls(path, name, sensor, topic, bag, first)

    @property
    def streams(self) -> tuple[str, ...]:
        """Events, and what else the bag has."""
        held = {
            "imu": self._beside(IMU_TYPE) is not None,
            "triggers": self.first.encoding == "evt3",
            "poses": self._beside(*POSE_TYPES) is not None,
            "twists": self._beside(*POSE_TYPES) is not None,
        }
        return ("events", *(name for name, here in held.items() if here))

    def chunks(self) -> Iterator[Events]:
        """All events from the beginning; see `Recording`.

        Raises:
            BrokenRecording: the file is cut or garbled, a message is not what it must be, or an event is outside the
                sensor or earlier than the one before it; it names the message or the byte.
        """
        return checked(self.path, self._pieces(None, None), self.sensor)

    def since(self, t_us: int) -> Iterator[Events]:
        """As `chunks`, from this time on; by the index of the bag where it has one."""
        start = self._start()
        if start is None:
            return later(self.chunks(), t_us)
        anchor, log_ns = start
        since_ns = log_ns + (t_us - anchor.t_us) * 1000 - _EARLY_NS
        if since_ns <= log_ns:
            return later(self.chunks(), t_us)
        return self._jumped(t_us, anchor, since_ns)

    def _jumped(self, t_us: int, anchor: Anchor, since_ns: int) -> Iterator[Events]:
        chunks = checked(self.path, self._pieces(since_ns, anchor), self.sensor)
        chunk = next(chunks, None)
        if chunk is None or chunk.t[0] > t_us:  # the clocks ran further apart than we read ahead
            yield from later(self.chunks(), t_us)
            return
        yield from later(iter([chunk]), t_us)
        yield from later(chunks, t_us)

    def _pieces(self, since_ns: int | None, anchor: Anchor | None) -> Iterator[tuple[str, Events]]:
        decoder = Decoder(self.sensor, anchor)
        for message in self.bag.messages((self.topic,), since_ns):
            try:
                parsed, events = _parsed(message, self.bag)
                for part in (events,) if events else decoder.events(parsed):
                    yield message.where, part
            except BadMessage as why:
                raise BrokenRecording(self.path, message.where, str(why)) from None

    def _start(self) -> tuple[Anchor, int] | None:
        """The first moment of the events on both clocks, and when that was recorded [ns]."""
        decoder = Decoder(self.sensor)
        for message in self.bag.messages((self.topic,)):
            try:
                parsed, events = _parsed(message, self.bag)
                for part in (events,) if events else decoder.events(parsed):
                    if part.n:
                        return Anchor(parsed.stamp_ns, int(part.t[0])), message.log_ns
            except BadMessage:
                return None
        return None

    @property
    def ros_offset_us(self) -> int:
        """What to add to an event's time to have ROS time [us]: by the first message; 0 where they are the same clock.

        A message's stamp is when the driver's host received the first of its events, so this is late by the latency of
        the link, and host and sensor clock drift apart after it.
        """
        start = None if self.first.encoding in UNIX_TIME else self._start()
        return start[0].stamp_ns // 1000 - start[0].t_us if start else 0

    def camera(self, stream: str) -> CameraInfo | None:
        """The lens of the sensor_msgs/CameraInfo topic nearest by name; None where it is missing or of another size."""
        topic = self._beside(CAMERA_TYPE)
        if topic is None:
            return None
        for message in self.bag.messages((topic,)):
            info = self._read(message, messages.camera_info)
            if info is None or info.sensor != self.sensor:
                return None
            return CameraInfo(**(info.model_dump() | {"stream": stream}))
        return None

    def imu(self) -> Iterator[Imu]:
        """Samples of the sensor_msgs/Imu topic nearest by name, in its own frame: bags rarely tell how it is mounted.

        Raises:
            BrokenRecording: as `chunks`.
        """
        topic = self._beside(IMU_TYPE)
        offset_us = self.ros_offset_us
        batch: list[messages.ImuSample] = []
        broken: BrokenRecording | None = None
        try:
            for message in self.bag.messages((topic,) if topic else ()):
                sample = self._read(message, messages.imu)
                if batch and sample.stamp_ns < batch[-1].stamp_ns:
                    raise BrokenRecording(self.path, message.where, "time runs backwards")
                batch.append(sample)
                if len(batch) > _BATCH:
                    yield _imu(batch[:-1], offset_us)
                    batch = batch[-1:]
        except BrokenRecording as error:
            broken = error
        if batch:
            yield _imu(batch, offset_us)
        if broken is not None:
            raise broken

    def triggers(self) -> Iterator[Triggers]:
        """Edges on the trigger input, which `evt3` messages hold among the events."""
        decoder = Decoder(self.sensor)
        if self.first.encoding != "evt3":
            return
        for message in self.bag.messages((self.topic,)):
            try:
                yield from decoder.triggers(_parsed(message, self.bag)[0])
            except BadMessage as why:
                raise BrokenRecording(self.path, message.where, str(why)) from None

    def poses(self) -> Poses | None:
        """The geometry_msgs/PoseStamped or nav_msgs/Odometry topic nearest by name, of whatever body that tracks.

        Of poses within one microsecond the first is kept: trackers send some twice.

        Raises:
            BrokenRecording: as `chunks`; or an orientation is no rotation.
        """
        topic = self._beside(*POSE_TYPES)
        if topic is None:
            return None
        read = messages.odometry if self.bag.topics[topic] == "nav_msgs/Odometry" else messages.pose
        found = ((message.where, self._read(message, read)) for message in self.bag.messages((topic,)))
        return _poses(self.path, found, self.ros_offset_us)

    def twists(self) -> Twists | None:
        """How the tracked body moved, by its poses; None where these are too few. See `geometry.twists`."""
        poses = self.poses()
        return motion.twists(poses) if poses is not None and poses.t.size > 1 else None

    def _beside(self, *types: str) -> str | None:
        """The topic of one of these types whose name has most in common with that of the events."""
        names = sorted(name for name, kind in self.bag.topics.items() if kind in types)
        return max(names, key=lambda name: _in_common(name, self.topic), default=None)

    def _read(self, message: BagMessage, read: Callable[..., T]) -> T:
        try:
            return read(message.data, cdr=self.bag.cdr)
        except BadMessage as why:
            raise BrokenRecording(self.path, message.where, str(why)) from None


def _parsed(message: BagMessage, bag: BagFile) -> tuple[EventMessage, Events | None]:
    """The message, and its events where its type lays them out itself."""
    if bag.topics[message.topic] == "dvs_msgs/EventArray":
        return messages.dvs_events(message.data, cdr=bag.cdr)
    return messages.event_packet(message.data, cdr=bag.cdr), None


def _first(path: Path, bag: BagFile, topic: str) -> EventMessage:
    for message in bag.messages((topic,)):
        try:
            parsed, _ = _parsed(message, bag)
        except BadMessage as why:
            raise BrokenRecording(path, message.where, str(why)) from None
        return parsed._replace(data=memoryview(b""))
    raise UnknownSource(path, f"its topic {topic} has no message")


def _in_common(one: str, other: str) -> int:
    """How many parts of their names two topics share, from the beginning."""
    pairs = zip(one.split("/"), other.split("/"), strict=False)
    return sum(1 for _ in takewhile(lambda pair: pair[0] == pair[1], pairs))


def _poses(path: Path, found: Iterator[tuple[str, messages.PoseSample]], offset_us: int) -> Poses | None:
    """The poses of some messages, each with its place in the file; None if there are none."""
    samples: list[messages.PoseSample] = []
    for where, sample in found:
        if samples and sample.stamp_ns // 1000 <= samples[-1].stamp_ns // 1000:
            if sample.stamp_ns < samples[-1].stamp_ns:
                raise BrokenRecording(path, where, "time runs backwards")
            continue
        length = float(np.linalg.norm(sample.orientation))
        if not (abs(length - 1) < 1e-2 and np.isfinite(sample.position_m).all()):  # written so that nan fails
            why = f"position {sample.position_m} and orientation {sample.orientation} are not a pose"
            raise BrokenRecording(path, where, why)
        samples.append(sample)
    if not samples:
        return None
    t = np.array([sample.stamp_ns for sample in samples]) // 1000 - offset_us
    orientation = np.array([sample.orientation for sample in samples])
    orientation /= np.linalg.norm(orientation, axis=1, keepdims=True)
    return Poses(t, np.array([sample.position_m for sample in samples]), orientation)


def _imu(samples: list[messages.ImuSample], offset_us: int) -> Imu:
    t = np.array([sample.stamp_ns for sample in samples]) // 1000 - offset_us
    accel = np.array([sample.accel_m_s2 for sample in samples])
    return Imu(t, accel, np.array([sample.gyro_rad_s for sample in samples]))


def _accepts(path: Path) -> bool:
    """Whether this is a bag; the metadata.yaml of a folder is missing if its recorder was killed."""
    if path.is_file():
        return path.suffix.lower() in (".bag", ".db3", ".mcap")
    if (path / "events.txt").is_file():
        return False
    return any(
        one.name == "metadata.yaml" or one.name.endswith((".db3", ".mcap", ".db3.zstd", ".mcap.zstd"))
        for one in path.iterdir()
    )


FORMAT = Format(
    "FILE.bag (ROS 1), FILE.db3, FILE.mcap or a folder of them (ROS 2)", RosbagRecording.open, accepts=_accepts
)
