"""One camera of a ROS bag: a .bag file (ROS 1), or a .db3 file, an .mcap file or a folder of them (ROS 2)."""

import contextlib
import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from itertools import takewhile
from pathlib import Path
from typing import Final, Self, TypeVar

import numpy as np

from neurove_core.geometry import motion
from neurove_core.geometry.motion import Poses, Twists
from neurove_core.io.axes import OPTICAL
from neurove_core.io.checked import cleaned, ordered, unread
from neurove_core.io.errors import BrokenRecording, MissingGeometry, UnknownSource
from neurove_core.io.faults import Faults, Reason, Tally
from neurove_core.io.format import Format
from neurove_core.io.formats.containers.bags import (
    SQLITE_MAGIC,
    BagFile,
    BagFolder,
    BagMessage,
    SqliteBag,
    in_recorded_order,
)
from neurove_core.io.formats.containers.mcap import McapFile
from neurove_core.io.formats.containers.mcap_records import MAGIC as MCAP_MAGIC
from neurove_core.io.formats.containers.ros1 import MAGIC as ROS1_MAGIC
from neurove_core.io.formats.containers.ros1 import Ros1Bag
from neurove_core.io.formats.ros import messages
from neurove_core.io.formats.ros.events import PROPHESEE, UNIX_TIME, Anchor, Decoder
from neurove_core.io.formats.ros.messages import BadMessage, EventMessage
from neurove_core.io.order import Where
from neurove_core.io.recording import EventsOnly, Triggers, later
from neurove_core.io.spool import plain_file
from neurove_protocol.camera import CameraInfo
from neurove_protocol.errors import InvalidField
from neurove_protocol.events import Events, Sensor
from neurove_protocol.imu import Imu

DVS_TYPES: Final = ("dvs_msgs/EventArray", "prophesee_event_msgs/EventArray")
"""Types with one layout: github.com/uzh-rpg/rpg_dvs_ros and github.com/prophesee-ai/prophesee_ros_wrapper."""

EVENT_TYPES: Final = ("event_camera_msgs/EventPacket", "event_array_msgs/EventArray", *DVS_TYPES)
LIBCAER: Final = ("libcaer", "libcaer_cmp")
IMU_TYPE: Final = "sensor_msgs/Imu"
CAMERA_TYPE: Final = "sensor_msgs/CameraInfo"
POSE_TYPES: Final = ("geometry_msgs/PoseStamped", "nav_msgs/Odometry")

_BATCH = 4096  # IMU samples in one chunk
_MARGIN_NS = 2_000_000_000  # margin for reading before the requested time, because host and sensor clock drift apart

T = TypeVar("T")

_CONTAINERS: Final = ((ROS1_MAGIC, ".bag", Ros1Bag), (SQLITE_MAGIC, ".db3", SqliteBag), (MCAP_MAGIC, ".mcap", McapFile))


def open_bag(path: Path) -> BagFile:
    """Open a bag of any supported container. Its content decides; only without a signature does the suffix.

    Compressed files of a folder, such as `run_0.mcap.zstd`, are decompressed into temporary files.

    Raises:
        UnknownSource: the path is not a bag.
    """
    if path.is_dir():
        return BagFolder(path, tuple(open_bag(plain_file(file).path) for file in in_recorded_order(path)))
    with path.open("rb") as file:
        head = file.read(len(SQLITE_MAGIC))
    for magic, _, container in _CONTAINERS:
        if head.startswith(magic):
            return container.open(path)
    for _, suffix, container in _CONTAINERS:
        if path.suffix.lower() == suffix:
            return container.open(path)
    raise UnknownSource(path, f"{path.suffix!r} is not a suffix of a bag")


@dataclass(frozen=True, slots=True)
class RosbagRecording(EventsOnly):
    """One camera of a ROS bag; see `Recording`.

    Event times of Prophesee words and of `mono` messages are on the unwrapped sensor clock. Event times of `libcaer`,
    `libcaer_cmp`, dvs_msgs and prophesee_event_msgs are unix time. All other data have the stamp of their header minus
    `ros_offset_us`.
    """

    path: Path
    name: str
    sensor: Sensor
    topic: str
    bag: BagFile
    first: EventMessage
    endless: bool = False
    faults: Faults = field(default_factory=Faults, compare=False, repr=False)

    @classmethod
    def open(cls, path: Path, sensor: Sensor | None = None, topic: str | None = None) -> Self:
        """Open one camera of the bag.

        Args:
            path: the file or folder.
            sensor: the pixel array; overrides the size in the messages.
            topic: topic of the events. The default is the first event topic by name; if the bag has several, the
                recording's name gives the one that is read.

        Raises:
            UnknownSource: the path is not a bag, or the bag has no such topic with events.
            MissingGeometry: the messages do not give the sensor size.
            BrokenRecording: the first message is incomplete or invalid.
        """
        bag = open_bag(path)
        topics = sorted(name for name, kind in bag.topics.items() if kind in EVENT_TYPES)
        if not topics or topic not in (None, *topics):
            raise UnknownSource(path, _no_events(bag, topics, topic))
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
        """Names of the data that the bag holds for this camera; the first is `events`."""
        present = {
            "imu": self._nearest_topic(IMU_TYPE) is not None,
            "triggers": self.first.encoding in PROPHESEE,
            "poses": self._nearest_topic(*POSE_TYPES) is not None,
            "twists": self._nearest_topic(*POSE_TYPES) is not None,
        }
        return ("events", *(name for name, found in present.items() if found))

    def chunks(self) -> Iterator[Events]:
        """Yield all events from the beginning; see `Recording`. A message that cannot be decoded is skipped."""
        return self._cleaned(None, None)

    def since(self, t_us: int) -> Iterator[Events]:
        """Yield the events from this time [us] on, as `chunks` does. Uses the index of the bag if there is one."""
        start = self._first_anchor()
        if start is None:
            return later(self.chunks(), t_us)
        anchor, log_ns = start
        since_ns = log_ns + (t_us - anchor.t_us) * 1000 - _MARGIN_NS
        if since_ns <= log_ns:
            return later(self.chunks(), t_us)
        return self._since_indexed(t_us, anchor, since_ns)

    def _since_indexed(self, t_us: int, anchor: Anchor, since_ns: int) -> Iterator[Events]:
        chunks = self._cleaned(since_ns, anchor)
        chunk = next(chunks, None)
        if chunk is None or chunk.t[0] > t_us:  # the clocks drifted by more than the margin
            yield from later(self.chunks(), t_us)
            return
        yield from later(iter([chunk]), t_us)
        yield from later(chunks, t_us)

    def _cleaned(self, since_ns: int | None, anchor: Anchor | None) -> Iterator[Events]:
        tally = self.faults.begin("events")
        return cleaned(self._pieces(since_ns, anchor, tally), self.sensor, tally)

    def _pieces(self, since_ns: int | None, anchor: Anchor | None, tally: Tally) -> Iterator[tuple[str, Events]]:
        decoder = Decoder(anchor, tally)
        for message in self.bag.messages((self.topic,), since_ns, tally):
            try:
                parsed, events = _parsed(message, self.bag)
                for part in (events,) if events else decoder.events(parsed, message.where):
                    yield message.where, part
            except BadMessage as why:
                tally.add(Reason.DAMAGED, message.where, str(why))

    def _first_anchor(self) -> tuple[Anchor, int] | None:
        """Return the time of the first event on both clocks and the log time of its message [ns], or None."""
        decoder = Decoder()
        for message in self.bag.messages((self.topic,)):
            with contextlib.suppress(BadMessage):
                parsed, events = _parsed(message, self.bag)
                for part in (events,) if events else decoder.events(parsed):
                    if part.n:
                        return Anchor(parsed.stamp_ns, int(part.t[0])), message.log_ns
        return None

    @property
    def ros_offset_us(self) -> int:
        """Offset from event time to ROS time [us], from the first message; 0 if event times are unix time.

        ROS time = event time + offset. The stamp of a message is the time at which the driver's host received the first
        of its events. The offset therefore includes the latency of the link, and it does not follow the later drift
        between host clock and sensor clock.
        """
        start = None if self.first.encoding in UNIX_TIME else self._first_anchor()
        return start[0].stamp_ns // 1000 - start[0].t_us if start else 0

    def camera(self, stream: str) -> CameraInfo | None:
        """Return the lens of the sensor_msgs/CameraInfo topic nearest by name; None if missing or of another size."""
        topic = self._nearest_topic(CAMERA_TYPE)
        if topic is None:
            return None
        for _, info in self._samples(topic, messages.camera_info, Tally("camera")):
            if info is None or info.sensor != self.sensor:
                return None
            return CameraInfo(**(info.model_dump() | {"stream": stream}))
        return None

    def imu(self) -> Iterator[Imu]:
        """The samples of the sensor_msgs/Imu topic nearest by name.

        The driver rpg_dvs_ros (dvs_msgs) gives the optical frame. Samples of libcaer_driver are rotated into it, see
        `axes.OPTICAL`. Samples of any other driver are in the frame of the IMU, because bags rarely give its mounting.
        """
        topic = self._nearest_topic(IMU_TYPE)
        if topic is not None:
            tally = self.faults.begin("imu")
            signs = OPTICAL if self.first.encoding in LIBCAER else np.ones(3)
            for batch in ordered(_imu_batches(self._samples(topic, messages.imu, tally), self.ros_offset_us), tally):
                yield Imu(batch.t, batch.accel_m_s2 * signs, batch.gyro_rad_s * signs)

    def _samples(self, topic: str, read: Callable[..., T], tally: Tally) -> Iterator[tuple[str, T]]:
        """The place and the value of each message of a topic that can be decoded."""
        for message in self.bag.messages((topic,), tally=tally):
            try:
                yield message.where, read(message.data, cdr=self.bag.cdr)
            except BadMessage as why:
                tally.add(Reason.DAMAGED, message.where, str(why))

    def triggers(self) -> Iterator[Triggers]:
        """Yield the edges of the trigger input. Messages of Prophesee words hold them among the events."""
        if self.first.encoding in PROPHESEE:
            tally = self.faults.begin("triggers")
            yield from ordered(self._edges(tally), tally)

    def _edges(self, tally: Tally) -> Iterator[tuple[str, Triggers]]:
        decoder = Decoder()
        for message in self.bag.messages((self.topic,), tally=tally):
            try:
                for edges in decoder.triggers(_parsed(message, self.bag)[0]):
                    yield message.where, edges
            except BadMessage as why:
                tally.add(Reason.DAMAGED, message.where, str(why))

    def poses(self) -> Poses | None:
        """Return the poses of the geometry_msgs/PoseStamped or nav_msgs/Odometry topic nearest by name.

        They are poses of the body that this topic tracks. Of several poses within one microsecond only the first is
        kept, because trackers send some poses twice. A pose that is late, whose position is not finite or whose
        orientation is not a unit quaternion is skipped.
        """
        topic = self._nearest_topic(*POSE_TYPES)
        if topic is None:
            return None
        read = messages.odometry if self.bag.topics[topic] == "nav_msgs/Odometry" else messages.pose
        tally = self.faults.begin("poses")
        return _poses(self._samples(topic, read, tally), self.ros_offset_us, tally)

    def twists(self) -> Twists | None:
        """Return the twists of the tracked body, from its poses; None for fewer than two poses. See `motion.twists`."""
        poses = self.poses()
        return motion.twists(poses) if poses is not None and poses.t.size > 1 else None

    def _nearest_topic(self, *types: str) -> str | None:
        """Return the topic of one of these types that shares the most leading name parts with the event topic."""
        names = sorted(name for name, kind in self.bag.topics.items() if kind in types)
        return max(names, key=lambda name: _shared_parts(name, self.topic), default=None)


def _no_events(bag: BagFile, topics: list[str], topic: str | None) -> str:
    """Why the bag has no events of this topic: the topics with events, or all topics and the types that have events."""
    if topics:
        return f"topic {topic!r} has no events; topics with events are {', '.join(topics)}"
    found = ", ".join(f"{name} ({kind})" for name, kind in sorted(bag.topics.items())) or "none"
    return f"no topic has events; it has {found}; types with events are {', '.join(EVENT_TYPES)}"


def _parsed(message: BagMessage, bag: BagFile) -> tuple[EventMessage, Events | None]:
    """Return the message, and its events if the message type defines their layout (dvs_msgs)."""
    if bag.topics[message.topic] in DVS_TYPES:
        return messages.dvs_events(message.data, cdr=bag.cdr)
    return messages.event_packet(message.data, cdr=bag.cdr), None


def _first(path: Path, bag: BagFile, topic: str) -> EventMessage:
    """Return the first message that can be decoded, without its events."""
    bad: BrokenRecording | None = None
    for message in bag.messages((topic,)):
        try:
            parsed, _ = _parsed(message, bag)
        except BadMessage as why:
            bad = bad or BrokenRecording(path, message.where, str(why))
        else:
            return parsed._replace(data=memoryview(b""))
    raise bad or UnknownSource(path, f"topic {topic} has no message")


def _shared_parts(one: str, other: str) -> int:
    """Return the number of leading name parts that two topics share."""
    pairs = zip(one.split("/"), other.split("/"), strict=False)
    return sum(1 for _ in takewhile(lambda pair: pair[0] == pair[1], pairs))


def _poses(found: Iterator[tuple[str, messages.PoseSample]], offset_us: int, tally: Tally) -> Poses | None:
    """Join (position in the file, pose) pairs into one table; None if there are none."""
    samples: list[messages.PoseSample] = []
    try:
        for where, sample in found:
            with np.errstate(all="ignore"):  # a number that is too large is not a pose
                length = float(np.linalg.norm(sample.orientation))
            if not (abs(length - 1) < 1e-2 and np.isfinite(sample.position_m).all()):  # this form rejects NaN
                why = f"position {sample.position_m} and orientation {sample.orientation} are not a pose"
                tally.add(Reason.INVALID, where, why)
            elif samples and sample.stamp_ns < samples[-1].stamp_ns:
                why = f"t={sample.stamp_ns} ns comes after t={samples[-1].stamp_ns} ns: time runs backwards"
                tally.add(Reason.LATE, where, why)
            elif not samples or sample.stamp_ns // 1000 > samples[-1].stamp_ns // 1000:
                samples.append(sample)
    except BrokenRecording as error:
        unread(tally, error)
    if not samples:
        return None
    t = np.array([sample.stamp_ns for sample in samples]) // 1000 - offset_us
    orientation = np.array([sample.orientation for sample in samples])
    orientation /= np.linalg.norm(orientation, axis=1, keepdims=True)
    return Poses(t, np.array([sample.position_m for sample in samples]), orientation)


def _imu_batches(found: Iterator[tuple[str, messages.ImuSample]], offset_us: int) -> Iterator[tuple[Where, Imu]]:
    """The samples of some messages, each with its place in the file, up to the first error."""
    batch: list[tuple[str, messages.ImuSample]] = []
    broken: BrokenRecording | None = None
    try:
        for one in found:
            batch.append(one)
            if len(batch) >= _BATCH:
                yield _places(batch), _imu([sample for _, sample in batch], offset_us)
                batch = []
    except BrokenRecording as error:
        broken = error
    if batch:
        yield _places(batch), _imu([sample for _, sample in batch], offset_us)
    if broken is not None:
        raise broken


def _places(batch: list[tuple[str, messages.ImuSample]]) -> Where:
    return lambda i: batch[i][0]


def _imu(samples: list[messages.ImuSample], offset_us: int) -> Imu:
    t = np.array([sample.stamp_ns for sample in samples]) // 1000 - offset_us
    accel = np.array([sample.accel_m_s2 for sample in samples])
    return Imu(t, accel, np.array([sample.gyro_rad_s for sample in samples]))


def _accepts(path: Path) -> bool:
    """Return whether the path is a bag. A folder has no metadata.yaml if its recorder was killed."""
    if path.is_file():
        with path.open("rb") as file:
            head = file.read(len(SQLITE_MAGIC))
        return any(head.startswith(magic) or path.suffix.lower() == suffix for magic, suffix, _ in _CONTAINERS)
    if (path / "events.txt").is_file():
        return False
    return any(
        one.name == "metadata.yaml" or one.name.endswith((".db3", ".mcap", ".db3.zstd", ".mcap.zstd"))
        for one in path.iterdir()
    )


FORMAT = Format(
    "FILE.bag (ROS 1), FILE.db3, FILE.mcap or a folder of them (ROS 2)",
    RosbagRecording.open,
    accepts=_accepts,
    signature=b"|".join(re.escape(magic) for magic, _, _ in _CONTAINERS),
)
