"""ROS messages -> values: the few types that a recording of an event camera holds, in ROS 1 and in CDR (ROS 2) layout.

Both layouts are sequences of plain fields; CDR begins with four bytes that name the byte order, aligns every number to
its own size, and ends every string with a zero. Sources: wiki.ros.org/msg, OMG DDS-XTypes (plain CDR), and the .msg
files of event_camera_msgs, event_array_msgs, dvs_msgs, sensor_msgs, geometry_msgs and nav_msgs.
"""

import struct
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from neurove_protocol.camera import CameraInfo
from neurove_protocol.errors import InvalidField
from neurove_protocol.events import Events

MAX_MESSAGE_BYTES: Final = 64 << 20
"""A message larger than this is none; an event camera's are some 10 kB to some MB."""

_LENSES = {"plumb_bob": "pinhole", "radtan": "pinhole", "equidistant": "equidistant", "fisheye": "equidistant"}
_SENSOR = "recording"  # a stream's name that every CameraInfo must have, replaced when it is asked for


class BadMessage(Exception):
    """The bytes are not a message of the type that they should be."""


class EventMessage(NamedTuple):
    """Events of one message, still in the layout that the driver gave them."""

    stamp_ns: int  # header.stamp: host clock [ns]
    width: int  # [px]
    height: int  # [px]
    seq: int  # counts messages; -1 where the type has no such field
    time_base_ns: int  # meaning depends on the encoding [ns]
    encoding: str
    data: memoryview


class ImuSample(NamedTuple):
    """One sample of an inertial unit."""

    stamp_ns: int
    gyro_rad_s: tuple[float, float, float]
    accel_m_s2: tuple[float, float, float]


class PoseSample(NamedTuple):
    """One pose: position [m] and orientation x y z w."""

    stamp_ns: int
    position_m: tuple[float, float, float]
    orientation: tuple[float, float, float, float]


class Fields:
    """A message's fields, read one after the other.

    Args:
        data: the message's bytes.
        cdr: whether they are CDR, as in ROS 2, or ROS 1.

    Raises:
        BadMessage: here or in any reading: the bytes end before the field does, or are in no known byte order.
    """

    def __init__(self, data: bytes, *, cdr: bool) -> None:
        self._data, self._at, self._cdr = memoryview(data), 0, cdr
        self._order = "<"
        if cdr:
            if len(data) < 4 or data[0] != 0 or data[1] > 1:
                raise BadMessage("it does not begin as plain CDR does")
            self._order = "<" if data[1] else ">"
            self._data = self._data[4:]

    def numbers(self, kind: str, count: int = 1) -> tuple[Any, ...]:
        """So many numbers of one struct type, such as `d`."""
        size = struct.calcsize("<" + kind)
        if self._cdr and count:
            self._at += -self._at % size
        return struct.unpack(f"{self._order}{count}{kind}", self.raw(size * count))

    def number(self, kind: str) -> Any:
        """The next number."""
        return self.numbers(kind)[0]

    def raw(self, size: int) -> memoryview:
        """So many bytes as they are."""
        if self._at + size > len(self._data):
            raise BadMessage("it ends within its fields")
        self._at += size
        return self._data[self._at - size : self._at]

    def text(self) -> str:
        """The next string."""
        data = bytes(self.raw(self.number("I")))
        return data.removesuffix(b"\0").decode("utf-8", "replace") if self._cdr else data.decode("utf-8", "replace")

    def stamp_ns(self) -> int:
        """The next time."""
        seconds, nanoseconds = self.numbers("I", 2)
        return int(seconds) * 1_000_000_000 + int(nanoseconds)

    def header_ns(self) -> int:
        """The stamp of a std_msgs/Header, which is read whole."""
        if not self._cdr:
            self.number("I")  # seq, which ROS 2 did away with
        stamp_ns = self.stamp_ns()
        self.text()
        return stamp_ns

    @property
    def rest(self) -> memoryview:
        """What has not been read."""
        return self._data[self._at :]

    @property
    def order(self) -> str:
        """`<` or `>`, as numpy and struct write it."""
        return self._order


def event_packet(data: bytes, *, cdr: bool) -> EventMessage:
    """An event_camera_msgs/EventPacket or event_array_msgs/EventArray, which have the same fields."""
    fields = Fields(data, cdr=cdr)
    stamp_ns = fields.header_ns()
    height, width = fields.numbers("I", 2)
    seq, time_base_ns = fields.numbers("Q", 2)
    encoding = fields.text()
    if fields.number("B"):
        raise BadMessage("its events are big-endian")
    return EventMessage(
        stamp_ns, width, height, int(seq), int(time_base_ns), encoding, fields.raw(int(fields.number("I")))
    )


DVS: Final = "dvs_msgs"
"""What stands as encoding in an EventMessage of dvs_msgs: events as the message type itself lays them out."""


def dvs_events(data: bytes, *, cdr: bool) -> tuple[EventMessage, Events]:
    """A dvs_msgs/EventArray: x, y, time, polarity per event; times [us] of the host's clock."""
    fields = Fields(data, cdr=cdr)
    stamp_ns = fields.header_ns()
    height, width = fields.numbers("I", 2)
    n = int(fields.number("I"))
    message = EventMessage(stamp_ns, width, height, -1, 0, DVS, fields.rest)
    return message, (_cdr_dvs if cdr else _packed_dvs)(fields.rest, n, fields.order)


_PACKED = np.dtype([("x", "<u2"), ("y", "<u2"), ("s", "<u4"), ("ns", "<u4"), ("p", "u1")])  # 13 bytes, no padding


def _packed_dvs(data: memoryview, n: int, _: str) -> Events:
    if len(data) < n * _PACKED.itemsize:
        raise BadMessage(f"it has {len(data)} bytes for {n} events")
    rows = np.frombuffer(data, _PACKED, n)
    return _with_time(rows["x"], rows["y"], rows["s"], rows["ns"], rows["p"])


def _cdr_dvs(data: memoryview, n: int, order: str) -> Events:
    """CDR aligns every number to its own size, so events repeat every 16 bytes, but not from the first one on.

    x y s ns p of the first event lie at 0, 2, 4, 8, 12; those of event k at 16 k - 2, 16 k, 16 k + 4, 16 k + 8 and
    16 k + 12, for x follows the byte of the polarity before it.
    """
    if n == 0:
        return Events.empty()
    if len(data) < 16 * n - 3:
        raise BadMessage(f"it has {len(data)} bytes for {n} events")
    kinds = (("s", "u4"), ("ns", "u4"), ("p", "u1"), ("", "u1"), ("x", "u2"), ("y", "u2"), ("", "u2"))
    row = np.dtype([(name, order + kind) for name, kind in kinds])  # x and y are those of the event after this one
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
    """A sensor_msgs/Imu: SI already."""
    fields = Fields(data, cdr=cdr)
    stamp_ns = fields.header_ns()
    numbers = fields.numbers("d", 4 + 9 + 3 + 9 + 3)  # orientation, covariance, rate, covariance, acceleration
    return ImuSample(stamp_ns, numbers[13:16], numbers[25:28])


def pose(data: bytes, *, cdr: bool) -> PoseSample:
    """A geometry_msgs/PoseStamped."""
    fields = Fields(data, cdr=cdr)
    return _pose(fields.header_ns(), fields)


def odometry(data: bytes, *, cdr: bool) -> PoseSample:
    """The pose of a nav_msgs/Odometry."""
    fields = Fields(data, cdr=cdr)
    stamp_ns = fields.header_ns()
    fields.text()  # child_frame_id
    return _pose(stamp_ns, fields)


def _pose(stamp_ns: int, fields: Fields) -> PoseSample:
    numbers = fields.numbers("d", 7)
    return PoseSample(stamp_ns, numbers[:3], numbers[3:])


def camera_info(data: bytes, *, cdr: bool) -> CameraInfo | None:
    """The lens of a sensor_msgs/CameraInfo, or None where it is not calibrated or of a model that we do not have."""
    fields = Fields(data, cdr=cdr)
    fields.header_ns()
    height, width = fields.numbers("I", 2)
    model = fields.text().lower()
    count = int(fields.number("I"))
    if count > 64:
        raise BadMessage(f"a lens has no {count} coefficients")
    distortion = fields.numbers("d", count)
    fx, _, cx, _, fy, cy, *_ = fields.numbers("d", 9)
    if model not in _LENSES or fx <= 0 or fy <= 0:  # all zeros: not calibrated
        return None
    try:
        return CameraInfo(
            stream=_SENSOR,
            width=width,
            height=height,
            lens=_LENSES[model],  # type: ignore[arg-type]  # the table has no other
            fx=fx,
            fy=fy,
            cx=cx,
            cy=cy,
            distortion=distortion if any(distortion) else (),
        )
    except (ValueError, InvalidField):
        return None
