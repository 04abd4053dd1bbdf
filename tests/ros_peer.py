"""A node of rmw_zenoh in plain zenoh-python. It shares no code with the bridge: rosbags writes its CDR."""

import json
import struct
import time

import xxhash
import zenoh
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from zenoh import ext

EVENTS = "event_camera_msgs/msg/EventPacket"
TWIST = "geometry_msgs/msg/TwistWithCovarianceStamped"
IMU, CAMERA = "sensor_msgs/msg/Imu", "sensor_msgs/msg/CameraInfo"
DIAGNOSTICS = "diagnostic_msgs/msg/DiagnosticArray"
BEST_EFFORT, RELIABLE, LATCHED = "2::,1000:,:,:,,", "::,10:,:,:,,", ":1:,1:,:,:,,"

_EVENTS_TEXT = (
    "std_msgs/Header header\nuint32 height\nuint32 width\nuint64 seq\nuint64 time_base\nstring encoding\n"
    "bool is_bigendian\nuint8[] events\n"
)


def typestore(store=Stores.ROS2_KILTED):
    types = get_typestore(store)
    types.register(get_types_from_msg(_EVENTS_TEXT, EVENTS))
    return types


TYPES = typestore()


def make(kind, *fields):
    return TYPES.types[kind](*fields)


def header(ns, frame="camera_optical"):
    return make("std_msgs/msg/Header", make("builtin_interfaces/msg/Time", ns // 10**9, ns % 10**9), frame)


def cdr(message):
    return bytes(TYPES.serialize_cdr(message, message.__msgtype__))


def parsed(data, kind):
    return TYPES.deserialize_cdr(data, kind)


def dds(kind):
    package, _, name = kind.split("/")
    return f"{package}::msg::dds_::{name}_"


class RosNode:
    """One node, as a client of a router.

    Args:
        endpoint: of the router.
        name: of the node.
    """

    def __init__(self, endpoint, name="driver", hash_of=TYPES.hash_rihs01):
        config = zenoh.Config()
        common = {"mode": "client", "connect/endpoints": [endpoint], "scouting/multicast/enabled": False}
        for key, value in (common | {"transport/shared_memory/enabled": False, "timestamping/enabled": True}).items():
            config.insert_json5(key, json.dumps(value))
        self.session, self.name, self._hash_of = zenoh.open(config), name, hash_of
        self._kept, self._entity = [], 0
        self._declare(f"@ros2_lv/0/{self.session.zid()}/0/0/NN/%/%/{name}")

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.close()

    def close(self):
        self.session.close()

    def _declare(self, token):
        self._kept.append(self.session.liveliness().declare_token(token))

    def _token(self, kind, topic, type_, qos):
        self._entity += 1
        ids = f"{self.session.zid()}/0/{self._entity}/{kind}/%/%/{self.name}"
        token = f"@ros2_lv/0/{ids}/{topic.replace('/', '%')}/{dds(type_)}/{self._hash_of(type_)}/{qos}"
        self._declare(token)
        return token

    def publisher(self, topic, type_, qos=BEST_EFFORT):
        """Returns a function that publishes CDR; its `matching()` says whether a subscriber is connected."""
        digest = xxhash.xxh3_128_digest(self._token("MP", topic, type_, qos).encode())  # big-endian
        gid = digest[7::-1] + digest[:7:-1]
        key, sent = f"0{topic}/{dds(type_)}/{self._hash_of(type_)}", 0
        if qos == LATCHED:
            cache = ext.CacheConfig(max_samples=1)
            publisher = ext.declare_advanced_publisher(self.session, key, cache=cache, publisher_detection=True)
        else:
            publisher = self.session.declare_publisher(key)
        self._kept.append(publisher)

        def publish(data):
            nonlocal sent
            sent += 1
            publisher.put(data, attachment=struct.pack("<qqB", sent, time.time_ns(), 16) + gid)

        publish.matching = lambda: getattr(publisher.matching_status, "matching", publisher.matching_status)
        return publish

    def subscribe(self, topic, type_, qos=RELIABLE, on_message=lambda: None):
        """Returns a list that grows: (message, attachment) of every sample of this type and hash."""
        self._token("MS", topic, type_, qos)
        received = []

        def receive(sample):
            attachment = sample.attachment.to_bytes()
            received.append((parsed(sample.payload.to_bytes(), type_), attachment))
            on_message()

        key = f"0{topic}/{dds(type_)}/{self._hash_of(type_)}"
        handler = zenoh.handlers.Callback(receive, indirect=False)
        self._kept.append(self.session.declare_subscriber(key, handler))
        return received

    def tokens(self):
        replies = self.session.liveliness().get("@ros2_lv/**", timeout=5.0)
        return [str(reply.ok.key_expr) for reply in replies if reply.ok is not None]
