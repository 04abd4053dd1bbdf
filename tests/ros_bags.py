"""Bags for tests, written by the rosbags package: events in driver layouts, IMU samples, poses and lenses."""

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from neurove_protocol import Events, Sensor
from tests.builders import SENSOR

PACKET, DVS, IMU = "event_camera_msgs/msg/EventPacket", "dvs_msgs/msg/EventArray", "sensor_msgs/msg/Imu"
PROPHESEE = "prophesee_event_msgs/msg/EventArray"
POSE, ODOMETRY, CAMERA = "geometry_msgs/msg/PoseStamped", "nav_msgs/msg/Odometry", "sensor_msgs/msg/CameraInfo"

_OWN = {
    PACKET: "std_msgs/Header header\nuint32 height\nuint32 width\nuint64 seq\nuint64 time_base\nstring encoding\n"
    "bool is_bigendian\nuint8[] events\n",
    "dvs_msgs/msg/Event": "uint16 x\nuint16 y\ntime ts\nbool polarity\n",
    DVS: "std_msgs/Header header\nuint32 height\nuint32 width\ndvs_msgs/Event[] events\n",
}
_OWN |= {
    name.replace("dvs_msgs", "prophesee_event_msgs"): _OWN[name].replace("dvs_msgs", "prophesee_event_msgs")
    for name in ("dvs_msgs/msg/Event", DVS)
}


class Store:
    """Message types of one ROS version: 1 or 2."""

    def __init__(self, ros: int) -> None:
        self.ros = ros
        self.types = get_typestore(Stores.ROS1_NOETIC if ros == 1 else Stores.ROS2_HUMBLE)
        for name, text in _OWN.items():
            text = text if ros == 1 else text.replace("time ts", "builtin_interfaces/Time ts")
            self.types.register(get_types_from_msg(text, name))

    def of(self, name: str, *fields: Any) -> Any:
        return self.types.types[name](*fields)

    def time(self, ns: int) -> Any:
        return self.of("builtin_interfaces/msg/Time", ns // 10**9, ns % 10**9)

    def header(self, ns: int, frame: str = "camera") -> Any:
        fields = (self.time(ns), frame)
        return self.of("std_msgs/msg/Header", *((0, *fields) if self.ros == 1 else fields))

    def raw(self, message: Any) -> bytes:
        name = message.__msgtype__
        return bytes(
            self.types.serialize_ros1(message, name) if self.ros == 1 else self.types.serialize_cdr(message, name)
        )


def packet(
    store: Store, data: bytes, *, ns: int, seq: int, base_ns: int = 0, encoding: str = "evt3", sensor: Sensor = SENSOR
) -> Any:
    blob = np.frombuffer(data, np.uint8)
    return store.of(PACKET, store.header(ns), sensor.height, sensor.width, seq, base_ns, encoding, False, blob)


def dvs(store: Store, events: Events, sensor: Sensor = SENSOR, *, kind: str = DVS) -> Any:
    """A dvs_msgs/EventArray, or another type of its layout, of events with unix times [us]."""
    rows = [
        store.of(kind.removesuffix("Array"), x, y, store.time(t * 1000), bool(p))
        for t, x, y, p in zip(*(column.tolist() for column in events), strict=True)
    ]
    return store.of(kind, store.header(int(events.t[0]) * 1000 if events.n else 0), sensor.height, sensor.width, rows)


def write_bag(
    path: Path, store: Store, messages: Iterable[tuple[str, int, Any]], *, compression: str = "", mcap: bool = False
) -> Path:
    """Write a bag of (topic, log time [ns], message); return its file or folder."""
    if store.ros == 1:
        writer: Any = Writer1(path)
        if compression:
            writer.set_compression(Writer1.CompressionFormat[compression.upper()])
    else:
        writer = Writer2(path, version=9, storage_plugin=StoragePlugin.MCAP if mcap else StoragePlugin.SQLITE3)
    with writer:
        known: dict[tuple[str, str], Any] = {}
        for topic, ns, message in messages:
            key = topic, message.__msgtype__
            if key not in known:
                known[key] = writer.add_connection(*key, typestore=store.types)
            writer.write(known[key], ns, store.raw(message))
    return path
