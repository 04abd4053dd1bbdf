"""ROS messages -> values: the types in event camera recordings, in the ROS 1 layout and the CDR (ROS 2) layout.

Both layouts are sequences of plain fields. CDR begins with four bytes that give the byte order, aligns each number to
its own size, and ends each string with a zero. Sources: wiki.ros.org/msg, OMG DDS-XTypes (plain CDR), and the .msg
files of event_camera_msgs, event_array_msgs, dvs_msgs, sensor_msgs, geometry_msgs and nav_msgs.
"""

import struct
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from neurove_protocol.camera import CameraInfo
from neurove_protocol.errors import InvalidField
from neurove_protocol.events import Events

_LENSES = {"plumb_bob": "pinhole", "radtan": "pinhole", "equidistant": "equidistant", "fisheye": "equidistant"}
_SENSOR = "recording"  # placeholder: CameraInfo requires a stream name, and the caller replaces it


class BadMessage(Exception):
    """The bytes are not a valid message of the expected type."""


class EventMessage(NamedTuple):
    """Events of one message, in the layout of the driver."""

    stamp_ns: int  # header.stamp: host clock [ns]
    width: int  # [px]
    height: int  # [px]
    seq: int  # message counter; -1 if the type has no such field
    time_base_ns: int  # meaning depends on the encoding [ns]
    encoding: str
    data: memoryview


class ImuSample(NamedTuple):
    """One IMU sample."""

    stamp_ns: int
    gyro_rad_s: tuple[float, float, float]
    accel_m_s2: tuple[float, float, float]


class PoseSample(NamedTuple):
    """One pose: position [m] and orientation quaternion (x, y, z, w)."""

    stamp_ns: int
    position_m: tuple[float, float, float]
    orientation: tuple[float, float, float, float]


class TwistSample(NamedTuple):
    """One twist: vx vy vz [m/s] wx wy wz [rad/s] in the frame that the header names."""

    stamp_ns: int
    twist: tuple[float, float, float, float, float, float]


class Fields:
    """Reads the fields of a message one after the other.

    Args:
        data: the bytes of the message.
        cdr: True for CDR (ROS 2), False for ROS 1.

    Raises:
        BadMessage: the byte order is unknown, or, from every method, the bytes end before the field ends.
    """

    def __init__(self, data: bytes, *, cdr: bool) -> None:
        self._data, self._at, self._cdr = memoryview(data), 0, cdr
        self._order = "<"
        if cdr:
            if len(data) < 4 or data[0] != 0 or data[1] > 1:
                raise BadMessage("the message does not begin with a plain CDR header")
            self._order = "<" if data[1] else ">"
            self._data = self._data[4:]

    def numbers(self, kind: str, count: int = 1) -> tuple[Any, ...]:
        """Read `count` numbers of one struct type, for example `d`."""
        size = struct.calcsize("<" + kind)
        if self._cdr and count:
            self._at += -self._at % size
        return struct.unpack(f"{self._order}{count}{kind}", self.raw(size * count))

    def number(self, kind: str) -> Any:
        """Read the next number."""
        return self.numbers(kind)[0]

    def raw(self, size: int) -> memoryview:
        """Read `size` bytes without decoding."""
        if self._at + size > len(self._data):
            raise BadMessage("the message ends within its fields")
        self._at += size
        return self._data[self._at - size : self._at]

    def text(self) -> str:
        """Read the next string."""
        data = bytes(self.raw(self.number("I")))
        return data.removesuffix(b"\0").decode("utf-8", "replace") if self._cdr else data.decode("utf-8", "replace")

    def stamp_ns(self) -> int:
        """Read the next time [ns]."""
        seconds, nanoseconds = self.numbers("I", 2)
        return int(seconds) * 1_000_000_000 + int(nanoseconds)

    def header_ns(self) -> int:
        """Read a std_msgs/Header and return its stamp [ns]."""
        if not self._cdr:
            self.number("I")  # seq, which ROS 2 does not have
        stamp_ns = self.stamp_ns()
        self.text()
        return stamp_ns

    @property
    def rest(self) -> memoryview:
        """The bytes that are not read yet."""
        return self._data[self._at :]

    @property
    def order(self) -> str:
        """Byte order, `<` or `>`, in the notation of numpy and struct."""
        return self._order


def event_packet(data: bytes, *, cdr: bool) -> EventMessage:
    """Parse an event_camera_msgs/EventPacket or an event_array_msgs/EventArray. Both have the same fields."""
    fields = Fields(data, cdr=cdr)
    stamp_ns = fields.header_ns()
    height, width = fields.numbers("I", 2)
    seq, time_base_ns = fields.numbers("Q", 2)
    encoding = fields.text()
    if fields.number("B"):
        raise BadMessage("big-endian events are not supported")
    return EventMessage(
        stamp_ns, width, height, int(seq), int(time_base_ns), encoding, fields.raw(int(fields.number("I")))
    )


DVS: Final = "dvs_msgs"
"""Encoding name in an EventMessage of dvs_msgs, whose message type defines the event layout."""


def dvs_events(data: bytes, *, cdr: bool) -> tuple[EventMessage, Events]:
    """Parse a dvs_msgs/EventArray: x, y, time and polarity of each event; times on the host clock [us]."""
    fields = Fields(data, cdr=cdr)
    stamp_ns = fields.header_ns()
    height, width = fields.numbers("I", 2)
    n = int(fields.number("I"))
    message = EventMessage(stamp_ns, width, height, -1, 0, DVS, fields.rest)
    return message, (_cdr_dvs if cdr else _packed_dvs)(fields.rest, n, fields.order)


_PACKED = np.dtype([("x", "<u2"), ("y", "<u2"), ("s", "<u4"), ("ns", "<u4"), ("p", "u1")])  # 13 bytes, no padding


def _packed_dvs(data: memoryview, n: int, _: str) -> Events:
    if len(data) < n * _PACKED.itemsize:
        raise BadMessage(f"{len(data)} bytes are too few for {n} events")
    rows = np.frombuffer(data, _PACKED, n)
    return _with_time(rows["x"], rows["y"], rows["s"], rows["ns"], rows["p"])


def _cdr_dvs(data: memoryview, n: int, order: str) -> Events:
    """Decode events in CDR, which aligns each number to its own size.

    The first event has x, y, s, ns, p at bytes 0, 2, 4, 8, 12. Event k > 0 has them at 16 k - 2, 16 k, 16 k + 4,
    16 k + 8 and 16 k + 12, because its x follows the polarity byte of the event before it.
    """
    if n == 0:
        return Events.empty()
    if len(data) < 16 * n - 3:
        raise BadMessage(f"{len(data)} bytes are too few for {n} events")
    kinds = (("s", "u4"), ("ns", "u4"), ("p", "u1"), ("", "u1"), ("x", "u2"), ("y", "u2"), ("", "u2"))
    row = np.dtype([(name, order + kind) for name, kind in kinds])  # x and y belong to the next event
    rows = np.frombuffer(bytes(data[4 : 16 * n - 3]) + bytes(7), row, n)
    first = np.frombuffer(data, order + "u2", 2)
    x, y = np.empty((2, n), np.uint16)
    x[0], y[0] = first
    x[1:], y[1:] = rows["x"][:-1], rows["y"][:-1]
    return _with_time(x, y, rows["s"], rows["ns"], rows["p"])


def _with_time(x: Any, y: Any, s: NDArray[Any], ns: NDArray[Any], p: NDArray[Any]) -> Events:
    t = s.astype(np.int64) * 1_000_000 + ns.astype(np.int64) // 1000
    return Events.from_columns(t, np.ascontiguousarray(x), np.ascontiguousarray(y), p != 0)


def imu(data: bytes, *, cdr: bool) -> ImuSample:
    """Parse a sensor_msgs/Imu. Its units are SI."""
    fields = Fields(data, cdr=cdr)
    stamp_ns = fields.header_ns()
    numbers = fields.numbers("d", 4 + 9 + 3 + 9 + 3)  # orientation, covariance, rate, covariance, acceleration
    return ImuSample(stamp_ns, numbers[13:16], numbers[25:28])


def pose(data: bytes, *, cdr: bool) -> PoseSample:
    """Parse a geometry_msgs/PoseStamped."""
    fields = Fields(data, cdr=cdr)
    return _pose(fields.header_ns(), fields)


def odometry(data: bytes, *, cdr: bool) -> PoseSample:
    """Parse the pose of a nav_msgs/Odometry."""
    fields = Fields(data, cdr=cdr)
    stamp_ns = fields.header_ns()
    fields.text()  # child_frame_id
    return _pose(stamp_ns, fields)


def _pose(stamp_ns: int, fields: Fields) -> PoseSample:
    numbers = fields.numbers("d", 7)
    return PoseSample(stamp_ns, numbers[:3], numbers[3:])


def twist(data: bytes, *, cdr: bool) -> TwistSample:
    """Parse a geometry_msgs/TwistStamped or the beginning of a TwistWithCovarianceStamped."""
    fields = Fields(data, cdr=cdr)
    stamp_ns = fields.header_ns()
    return TwistSample(stamp_ns, fields.numbers("d", 6))


def camera_info(data: bytes, *, cdr: bool) -> CameraInfo | None:
    """Parse the lens of a sensor_msgs/CameraInfo; None if it is not calibrated or its model is not supported."""
    fields = Fields(data, cdr=cdr)
    fields.header_ns()
    height, width = fields.numbers("I", 2)
    model = fields.text()
    count = int(fields.number("I"))
    if count > 64:
        raise BadMessage(f"{count} distortion coefficients; the limit is 64")
    distortion = fields.numbers("d", count)
    return lens(width, height, model, distortion, fields.numbers("d", 9))


def lens(
    width: int, height: int, model: str, distortion: tuple[float, ...], matrix: tuple[float, ...]
) -> CameraInfo | None:
    """The lens of a sensor_msgs/CameraInfo; None if it is not calibrated or its model is not supported.

    Args:
        width: of the image [px].
        height: of the image [px].
        model: `distortion_model`.
        distortion: `d`.
        matrix: `k`, 9 numbers.
    """
    fx, _, cx, _, fy, cy, *_ = matrix
    model = model.lower()
    if model not in _LENSES or fx <= 0 or fy <= 0:  # all zeros: not calibrated
        return None
    try:
        return CameraInfo(
            stream=_SENSOR,
            width=width,
            height=height,
            lens=_LENSES[model],  # type: ignore[arg-type]  # the table has only valid lenses
            fx=fx,
            fy=fy,
            cx=cx,
            cy=cy,
            distortion=distortion if any(distortion) else (),
        )
    except (ValueError, InvalidField):
        return None
