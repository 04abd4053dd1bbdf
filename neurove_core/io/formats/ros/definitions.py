"""Definitions of the messages in a written bag, in the text form `ros2msg`, with which tools decode them."""

from typing import Final

from neurove_core.io.formats.ros import types

_PARTS: Final = {
    "std_msgs/Header": "builtin_interfaces/Time stamp\nstring frame_id",
    "builtin_interfaces/Time": "int32 sec\nuint32 nanosec",
    "geometry_msgs/Vector3": "float64 x\nfloat64 y\nfloat64 z",
    "geometry_msgs/Point": "float64 x\nfloat64 y\nfloat64 z",
    "geometry_msgs/Quaternion": "float64 x\nfloat64 y\nfloat64 z\nfloat64 w",
    "geometry_msgs/Twist": "geometry_msgs/Vector3 linear\ngeometry_msgs/Vector3 angular",
    "geometry_msgs/TwistWithCovariance": "geometry_msgs/Twist twist\nfloat64[36] covariance",
    "geometry_msgs/Pose": "geometry_msgs/Point position\ngeometry_msgs/Quaternion orientation",
    "sensor_msgs/RegionOfInterest": "uint32 x_offset\nuint32 y_offset\nuint32 height\nuint32 width\nbool do_rectify",
}

_MESSAGES: Final = {
    types.EVENTS: (
        "std_msgs/Header header\nuint32 height\nuint32 width\nuint64 seq\nuint64 time_base\nstring encoding\n"
        "bool is_bigendian\nuint8[] events"
    ),
    types.TWIST: "std_msgs/Header header\ngeometry_msgs/TwistWithCovariance twist",
    types.POSE: "std_msgs/Header header\ngeometry_msgs/Pose pose",
    types.IMU: (
        "std_msgs/Header header\ngeometry_msgs/Quaternion orientation\nfloat64[9] orientation_covariance\n"
        "geometry_msgs/Vector3 angular_velocity\nfloat64[9] angular_velocity_covariance\n"
        "geometry_msgs/Vector3 linear_acceleration\nfloat64[9] linear_acceleration_covariance"
    ),
    types.CAMERA: (
        "std_msgs/Header header\nuint32 height\nuint32 width\nstring distortion_model\nfloat64[] d\nfloat64[9] k\n"
        "float64[9] r\nfloat64[12] p\nuint32 binning_x\nuint32 binning_y\nsensor_msgs/RegionOfInterest roi"
    ),
}

_LINE: Final = "=" * 80


def definition(type_: str) -> str:
    """The definition of a message, followed by those of all types in it."""
    found: list[str] = []
    text = _MESSAGES[type_]
    waiting = [text]
    while waiting:
        names = [line.split(" ")[0].partition("[")[0] for line in waiting.pop(0).splitlines()]
        for name in names:
            if name in _PARTS and name not in found:
                found.append(name)
                waiting.append(_PARTS[name])
    return "\n".join([text, *(f"{_LINE}\nMSG: {name}\n{_PARTS[name]}" for name in found)]) + "\n"
