"""The ROS 2 messages that NeuroVE sends and receives: values, bytes, type hashes and definitions.

Sources: the .msg files of event_camera_msgs, geometry_msgs, sensor_msgs, diagnostic_msgs, std_msgs and
builtin_interfaces. The hashes are those of ROS 2 Iron and later (REP 2016): tests compute them again with rosbags.
"""

from typing import Any, Final, NamedTuple, Self

from neurove_core.io.formats.ros import cdr
from neurove_core.io.formats.ros.cdr import Field
from neurove_core.io.formats.ros.messages import EventMessage
from neurove_protocol.errors import InvalidField
from neurove_protocol.events import MAX_PACKET_BYTES

EVENTS: Final = "event_camera_msgs/msg/EventPacket"
TWIST: Final = "geometry_msgs/msg/TwistWithCovarianceStamped"
IMU: Final = "sensor_msgs/msg/Imu"
CAMERA: Final = "sensor_msgs/msg/CameraInfo"
DIAGNOSTICS: Final = "diagnostic_msgs/msg/DiagnosticArray"
POSE: Final = "geometry_msgs/msg/PoseStamped"

HASHES: Final = {
    EVENTS: "RIHS01_d6fa176260b1f37e5a40845305315e150a0f18191241eb64f407442aa29844aa",
    TWIST: "RIHS01_77b67434531e6529b7a0091357b186b6ebdb17fd9ffd3e0c7ce9d3fb11a44563",
    IMU: "RIHS01_7d9a00ff131080897a5ec7e26e315954b8eae3353c3f995c55faf71574000b5b",
    CAMERA: "RIHS01_b3dfd68ff46c9d56c80fd3bd4ed22c7a4ddce8c8348f2f59c299e73118e7e275",
    DIAGNOSTICS: "RIHS01_5a8a36efb05fb25070fa0fb3810290c0e6cd4862b54a8fb975a1ee8dc55a333e",
    POSE: "RIHS01_10f3786d7d40fd2b54367835614bff85d4ad3b5dab62bf8bca0cc232d73b4cd8",
}
"""Type hash of each message."""

AXES: Final = 6

_NS: Final = 10**9
_NAME, _TEXT, _ITEMS = 256, 4096, 1024  # longest frame and type names, other texts [bytes], and lists
_COEFFICIENTS = 64


class Time(NamedTuple):
    """builtin_interfaces/Time."""

    sec: int
    nanosec: int


class Header(NamedTuple):
    """std_msgs/Header."""

    stamp: Time
    frame_id: str

    @property
    def stamp_ns(self) -> int:
        """The stamp [ns]."""
        return self.stamp.sec * _NS + self.stamp.nanosec

    @classmethod
    def at(cls, stamp_ns: int, frame_id: str) -> Self:
        """A header with this stamp [ns].

        Raises:
            InvalidField: the stamp does not fit into 32 bits of seconds.
        """
        if not 0 <= stamp_ns < (1 << 31) * _NS:
            raise InvalidField("std_msgs/Header", "stamp", stamp_ns, "0 to 2^31 s")
        return cls(Time(*divmod(stamp_ns, _NS)), frame_id)


class EventsMessage(NamedTuple):
    """event_camera_msgs/EventPacket."""

    header: Header
    height: int  # [px]
    width: int  # [px]
    seq: int  # counts messages
    time_base: int  # [ns]; its meaning depends on the encoding
    encoding: str
    is_bigendian: bool
    events: memoryview | bytes

    def message(self) -> EventMessage:
        """The same for the decoder of events.

        Raises:
            InvalidField: its words are big-endian.
        """
        if self.is_bigendian:
            raise InvalidField(EVENTS, "is_bigendian", True, "little-endian events are supported")
        stamp_ns, data = self.header.stamp_ns, memoryview(self.events)
        return EventMessage(stamp_ns, self.width, self.height, self.seq, self.time_base, self.encoding, data)


class TwistMessage(NamedTuple):
    """geometry_msgs/TwistWithCovarianceStamped."""

    header: Header
    linear: tuple[float, ...]  # (3,) [m/s]
    angular: tuple[float, ...]  # (3,) [rad/s]
    covariance: tuple[float, ...]  # (36,) row by row, linear before angular


class ImuMessage(NamedTuple):
    """sensor_msgs/Imu."""

    header: Header
    orientation: tuple[float, ...]  # x y z w
    orientation_covariance: tuple[float, ...]  # (9,); -1 first: there is no orientation
    angular_velocity: tuple[float, ...]  # (3,) [rad/s]
    angular_velocity_covariance: tuple[float, ...]  # (9,)
    linear_acceleration: tuple[float, ...]  # (3,) [m/s2]
    linear_acceleration_covariance: tuple[float, ...]  # (9,)


class Region(NamedTuple):
    """sensor_msgs/RegionOfInterest; all zeros: the whole image."""

    x_offset: int = 0
    y_offset: int = 0
    height: int = 0
    width: int = 0
    do_rectify: bool = False


class CameraMessage(NamedTuple):
    """sensor_msgs/CameraInfo."""

    header: Header
    height: int
    width: int
    distortion_model: str
    d: tuple[float, ...]
    k: tuple[float, ...]  # (9,) fx 0 cx, 0 fy cy, 0 0 1
    r: tuple[float, ...]  # (9,)
    p: tuple[float, ...]  # (12,)
    binning_x: int = 0
    binning_y: int = 0
    roi: Region = Region()


class KeyValue(NamedTuple):
    """diagnostic_msgs/KeyValue."""

    key: str
    value: str


class Status(NamedTuple):
    """diagnostic_msgs/DiagnosticStatus."""

    level: int  # 0 OK, 1 WARN, 2 ERROR, 3 STALE
    name: str
    message: str
    hardware_id: str
    values: tuple[KeyValue, ...]


class DiagnosticsMessage(NamedTuple):
    """diagnostic_msgs/DiagnosticArray."""

    header: Header
    status: tuple[Status, ...]


class PoseMessage(NamedTuple):
    """geometry_msgs/PoseStamped."""

    header: Header
    position: tuple[float, ...]  # (3,) [m]
    orientation: tuple[float, ...]  # x y z w


_TEXT_FIELD: Final = ("text", _TEXT)
_TABLE: Final[cdr.Table] = {
    "Time": (Time, (Field("sec", "i"), Field("nanosec", "I"))),
    "Header": (Header, (Field("stamp", "Time"), Field("frame_id", "text", _NAME))),
    "Region": (Region, (*(Field(name, "I") for name in Region._fields[:4]), Field("do_rectify", "?"))),
    "KeyValue": (KeyValue, (Field("key", *_TEXT_FIELD), Field("value", *_TEXT_FIELD))),
    "Status": (
        Status,
        (
            Field("level", "B"),
            Field("name", *_TEXT_FIELD),
            Field("message", *_TEXT_FIELD),
            Field("hardware_id", *_TEXT_FIELD),
            Field("values", "KeyValue", _ITEMS),
        ),
    ),
    EVENTS: (
        EventsMessage,
        (
            Field("header", "Header"),
            Field("height", "I"),
            Field("width", "I"),
            Field("seq", "Q"),
            Field("time_base", "Q"),
            Field("encoding", "text", _NAME),
            Field("is_bigendian", "?"),
            Field("events", "bytes", MAX_PACKET_BYTES),
        ),
    ),
    TWIST: (
        TwistMessage,
        (Field("header", "Header"), Field("linear", "d3"), Field("angular", "d3"), Field("covariance", "d36")),
    ),
    IMU: (
        ImuMessage,
        (
            Field("header", "Header"),
            Field("orientation", "d4"),
            Field("orientation_covariance", "d9"),
            Field("angular_velocity", "d3"),
            Field("angular_velocity_covariance", "d9"),
            Field("linear_acceleration", "d3"),
            Field("linear_acceleration_covariance", "d9"),
        ),
    ),
    CAMERA: (
        CameraMessage,
        (
            Field("header", "Header"),
            Field("height", "I"),
            Field("width", "I"),
            Field("distortion_model", "text", _NAME),
            Field("d", "d", _COEFFICIENTS),
            Field("k", "d9"),
            Field("r", "d9"),
            Field("p", "d12"),
            Field("binning_x", "I"),
            Field("binning_y", "I"),
            Field("roi", "Region"),
        ),
    ),
    DIAGNOSTICS: (DiagnosticsMessage, (Field("header", "Header"), Field("status", "Status", _ITEMS))),
    POSE: (PoseMessage, (Field("header", "Header"), Field("position", "d3"), Field("orientation", "d4"))),
}

_KINDS: Final = {table[0]: kind for kind, table in _TABLE.items()}

Message = EventsMessage | TwistMessage | ImuMessage | CameraMessage | DiagnosticsMessage | PoseMessage


def type_of(message: Message) -> str:
    """The type of a message, such as sensor_msgs/msg/Imu."""
    return _KINDS[type(message)]


def encode(message: Message) -> bytes:
    """The CDR of a message.

    Raises:
        InvalidField: a field is out of its bound.
    """
    return cdr.encode(_TABLE, type_of(message), message)


def decode(kind: str, data: bytes) -> Any:
    """The message of this type in CDR.

    Raises:
        InvalidField: the bytes are no such message; names the field, its value and its bound.
    """
    return cdr.decode(_TABLE, kind, data)
