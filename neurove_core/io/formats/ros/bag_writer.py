"""Writer of a ROS 2 bag (MCAP, profile ros2, CDR): a recording with its lens, inertial samples, truth and estimates.

| topic | type | content |
| --- | --- | --- |
| /<stream>/events | event_camera_msgs/EventPacket | encoding `mono`: every time exactly, also of long recordings |
| /<stream>/camera_info | sensor_msgs/CameraInfo | the lens, once a second |
| /<stream>/imu | sensor_msgs/Imu | as in the recording, without orientation |
| /<stream>/truth/pose, /<stream>/truth/velocity | geometry_msgs/PoseStamped, TwistWithCovarianceStamped | the truth |
| /neurove/<stream>/velocity | geometry_msgs/TwistWithCovarianceStamped | estimates, if they are given |

Stamps and log times are the sensor clock. Twists and inertial samples are in the frame `<stream>_optical_frame`; the
poses are those of that frame in the frame `world`. Unknown numbers of a twist are NaN.
"""

from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np

from neurove_core.io.checked import truth
from neurove_core.io.formats.containers.mcap_writer import ChannelKind, McapWriter
from neurove_core.io.formats.ros import types
from neurove_core.io.formats.ros.definitions import definition
from neurove_core.io.formats.ros.types import (
    CameraMessage,
    EventsMessage,
    Header,
    ImuMessage,
    PoseMessage,
    TwistMessage,
)
from neurove_core.io.imu_feed import ImuFeed
from neurove_core.io.packets import Slice, slices
from neurove_core.io.recording import Recording
from neurove_protocol import CameraInfo, Events, Sensor
from neurove_protocol.errors import InvalidField

PROFILE: Final = "ros2"
WORLD: Final = "world"
_CAMERA_US: Final = 1_000_000  # period of the lens
_NONE: Final = (-1.0, *(0.0,) * 8)  # covariance of an orientation that is not known
_UNKNOWN: Final = (0.0,) * 9  # covariance that is not known
_MODELS: Final = {"pinhole": ("plumb_bob", 5), "equidistant": ("equidistant", 4)}
_IDENTITY: Final = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0)


class Stamped(NamedTuple):
    """A message that is due when the events have reached a time."""

    t_us: int
    topic: str
    message: types.Message


def optical_frame(stream: str) -> str:
    """Name of the frame of a camera."""
    return f"{stream}_optical_frame"


def write_bag(
    recording: Recording,
    path: Path,
    stream: str = "cam0",
    velocities: Iterable[TwistMessage] = (),
    progress: Callable[[int], None] = lambda events: None,
) -> tuple[str, ...]:
    """Write a recording as a ROS 2 bag.

    Args:
        recording: the recording to write; it must have an end.
        path: the file, with suffix .mcap.
        stream: name of the camera in topics and frames.
        velocities: estimates of the stream, ordered by time, with the sensor clock as stamp.
        progress: called with the number of events written.

    Returns:
        the streams of the recording that the bag does not hold.

    Raises:
        InvalidField: the recording is endless or has times below 0, or the file cannot be written. MissingExtra.
    """
    if recording.endless:
        raise InvalidField("recording", "source", recording.name, "it has no end")
    written = 0
    with McapWriter(path, PROFILE) as writer:
        others = _Others(recording, stream, iter(velocities))
        for seq, piece in enumerate(slices(recording.chunks())):
            for one in others.before(piece.end_us):
                _add(writer, one)
            _add(writer, _events(stream, seq, piece, recording.sensor))
            written += piece.events.n
            progress(written)
        for one in others.before(1 << 62):
            _add(writer, one)
        writer.metadata("neurove", {"source": recording.name, "stream": stream, "events": written})
    return tuple(name for name in recording.streams if name in ("frames", "triggers"))


def _add(writer: McapWriter, one: Stamped) -> None:
    kind = types.type_of(one.message)
    payload = types.encode(one.message)
    writer.message(one.topic, ChannelKind(kind, "cdr", "ros2msg", definition(kind)), payload, one.t_us * 1000)


def _events(stream: str, seq: int, piece: Slice, sensor: Sensor) -> Stamped:
    """Events of one packet; the stamp is the time of the first one, so that both clocks are the same."""
    first_us = piece.events.first_us if piece.events.n else piece.t0_us
    head = Header.at(first_us * 1000, optical_frame(stream))
    data = _mono(piece.events, first_us)
    message = EventsMessage(head, sensor.height, sensor.width, seq, first_us * 1000, "mono", False, data)
    return Stamped(piece.end_us, f"/{stream}/events", message)


def _mono(events: Events, base_us: int) -> bytes:
    rows = np.empty(events.n, [("dt", "<u4"), ("x", "<u2"), ("y", "<u2")])
    rows["dt"], rows["x"] = (events.t - base_us) * 1000, events.x
    rows["y"] = events.y | events.p.astype(np.uint16) << np.uint16(15)
    return rows.tobytes()


class _Others:
    """Everything but the events, in step with them."""

    def __init__(self, recording: Recording, stream: str, velocities: Iterator[TwistMessage]) -> None:
        self._stream, self._frame, self._lens = stream, optical_frame(stream), recording.camera(stream)
        self._inertial = ImuFeed(recording)
        self._waiting = [self._poses_and_twists(recording), self._estimates(velocities)]
        self._next = [next(one, None) for one in self._waiting]
        self._camera_us: int | None = None

    def before(self, end_us: int) -> Iterator[Stamped]:
        """What is due before this time [us]."""
        if (
            self._lens is not None
            and end_us < 1 << 62
            and (self._camera_us is None or end_us - self._camera_us >= _CAMERA_US)
        ):
            self._camera_us = end_us
            head = Header.at(max(0, end_us) * 1000, self._frame)
            yield Stamped(end_us, f"/{self._stream}/camera_info", _camera(head, self._lens))
        samples = self._inertial.until(end_us)
        for t, accel, gyro in zip(samples.t.tolist(), samples.accel_m_s2, samples.gyro_rad_s, strict=True):
            head = Header.at(t * 1000, self._frame)
            no_turn = (0.0, 0.0, 0.0, 1.0)
            message = ImuMessage(head, no_turn, _NONE, tuple(gyro), _UNKNOWN, tuple(accel), _UNKNOWN)
            yield Stamped(t, f"/{self._stream}/imu", message)
        for i, source in enumerate(self._waiting):
            while (one := self._next[i]) is not None and one.t_us < end_us:
                yield one
                self._next[i] = next(source, None)

    def _estimates(self, velocities: Iterator[TwistMessage]) -> Iterator[Stamped]:
        for message in velocities:
            yield Stamped(message.header.stamp_ns // 1000, f"/neurove/{self._stream}/velocity", message)

    def _poses_and_twists(self, recording: Recording) -> Iterator[Stamped]:
        poses, twists = truth(recording)
        rows: list[Stamped] = []
        if poses is not None:
            for t, position, turn in zip(poses.t.tolist(), poses.position_m, poses.orientation, strict=True):
                pose = PoseMessage(Header.at(t * 1000, WORLD), tuple(position), tuple(turn))
                rows.append(Stamped(t, f"/{self._stream}/truth/pose", pose))
        if twists is not None:
            for t, twist in zip(twists.t.tolist(), twists.twist, strict=True):
                if not np.isnan(twist).all():
                    head = Header.at(t * 1000, self._frame)
                    message = TwistMessage(head, tuple(twist[:3]), tuple(twist[3:]), (0.0,) * 36)
                    rows.append(Stamped(t, f"/{self._stream}/truth/velocity", message))
        yield from sorted(rows, key=lambda one: one.t_us)


def _camera(head: Header, lens: CameraInfo) -> CameraMessage:
    model, count = _MODELS[lens.lens]
    d = lens.distortion + (0.0,) * max(0, count - len(lens.distortion))
    k = (lens.fx, 0.0, lens.cx, 0.0, lens.fy, lens.cy, 0.0, 0.0, 1.0)
    p = (lens.fx, 0.0, lens.cx, 0.0, 0.0, lens.fy, lens.cy, 0.0, 0.0, 0.0, 1.0, 0.0)
    return CameraMessage(head, lens.height, lens.width, model, d, k, _IDENTITY, p)
