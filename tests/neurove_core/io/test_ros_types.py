"""The codec of ROS 2 messages, held against rosbags: bytes, values and type hashes; and what it refuses."""

import contextlib

import numpy as np
import pytest
from rosbags.typesys import Stores

from neurove_core.io.formats.ros import types
from neurove_core.io.formats.ros.types import (
    CameraMessage,
    DiagnosticsMessage,
    EventsMessage,
    Header,
    ImuMessage,
    KeyValue,
    PoseMessage,
    Status,
    TwistMessage,
)
from neurove_protocol.errors import InvalidField
from tests import ros_peer
from tests.ros_peer import TYPES, make

NS = 12 * 10**9 + 345
FRAMES = ["", "a", "abc", "base_link", "cam0_optical"]  # lengths that need every padding


def numbers(count, seed=20_900):
    return tuple(np.random.default_rng(seed + count).normal(size=count).tolist())


def ours(frame):
    """One message of each type, by ours."""
    head = Header.at(NS, frame)
    values = (KeyValue("lost", "3"), KeyValue("a", ""))
    return {
        types.EVENTS: EventsMessage(head, 260, 346, 7, 99, "evt3", False, bytes(range(11))),
        types.TWIST: TwistMessage(head, numbers(3), numbers(3), numbers(36)),
        types.IMU: ImuMessage(head, numbers(4), numbers(9), numbers(3), numbers(9), numbers(3), numbers(9)),
        types.CAMERA: CameraMessage(head, 260, 346, "plumb_bob", numbers(5), numbers(9), numbers(9), numbers(12), 1, 2),
        types.DIAGNOSTICS: DiagnosticsMessage(
            head, (Status(1, "neurove: cam0", "lossy", "edge", values), Status(0, *"abc", ()))
        ),
        types.POSE: PoseMessage(head, numbers(3), numbers(4)),
    }


def theirs(kind, frame):
    """The same by rosbags."""
    head = ros_peer.header(NS, frame)

    def vector(*three, name="Vector3"):
        return make(f"geometry_msgs/msg/{name}", *three)

    def rotation(*four):
        return make("geometry_msgs/msg/Quaternion", *four)

    match kind:
        case types.EVENTS:
            return make(kind, head, 260, 346, 7, 99, "evt3", False, np.arange(11, dtype=np.uint8))
        case types.TWIST:
            twist = make("geometry_msgs/msg/Twist", vector(*numbers(3)), vector(*numbers(3)))
            return make(kind, head, make("geometry_msgs/msg/TwistWithCovariance", twist, np.array(numbers(36))))
        case types.IMU:
            three, nine = vector(*numbers(3)), np.array(numbers(9))
            return make(kind, head, rotation(*numbers(4)), nine, three, nine, three, nine)
        case types.CAMERA:
            region = make("sensor_msgs/msg/RegionOfInterest", 0, 0, 0, 0, False)
            arrays = [np.array(numbers(n)) for n in (5, 9, 9, 12)]
            return make(kind, head, 260, 346, "plumb_bob", *arrays, 1, 2, region)
        case types.DIAGNOSTICS:
            pairs = [make("diagnostic_msgs/msg/KeyValue", *pair) for pair in (("lost", "3"), ("a", ""))]
            status = "diagnostic_msgs/msg/DiagnosticStatus"
            return make(
                kind, head, [make(status, 1, "neurove: cam0", "lossy", "edge", pairs), make(status, 0, *"abc", [])]
            )
        case _:
            pose = make("geometry_msgs/msg/Pose", vector(*numbers(3), name="Point"), rotation(*numbers(4)))
            return make(kind, head, pose)


@pytest.mark.parametrize("frame", FRAMES)
@pytest.mark.parametrize("kind", types.HASHES)
def test_the_bytes_are_those_of_rosbags_and_read_back_to_the_same_values(kind, frame):
    message = ours(frame)[kind]
    data = types.encode(message)
    assert data == ros_peer.cdr(theirs(kind, frame))
    assert types.decode(kind, data) == message


@pytest.mark.parametrize("store", [Stores.ROS2_HUMBLE, Stores.ROS2_JAZZY, Stores.ROS2_KILTED, Stores.LATEST])
def test_the_type_hashes_are_those_of_rosbags(store):
    known = ros_peer.typestore(store)
    assert {kind: known.hash_rihs01(kind) for kind in types.HASHES} == types.HASHES


@pytest.mark.parametrize("kind", types.HASHES)
def test_every_truncated_message_is_refused_with_field_value_and_bound(kind):
    data = types.encode(ours("cam0")[kind])
    for length in range(len(data)):
        with pytest.raises(InvalidField) as caught:
            types.decode(kind, data[:length])
        assert {"field", "value", "bound"} <= set(caught.value.details)


@pytest.mark.parametrize("kind", types.HASHES)
@pytest.mark.parametrize("seed", range(20_910, 20_915))
def test_damaged_bytes_are_read_or_refused_and_nothing_else(kind, seed):
    rng, whole = np.random.default_rng(seed), types.encode(ours("cam0")[kind])
    for _ in range(200):
        data = bytearray(whole)
        for at in rng.integers(0, len(data), 4):
            data[at] = rng.integers(256)
        with contextlib.suppress(InvalidField):
            types.decode(kind, bytes(data))


def test_padding_of_any_content_is_read():
    padded = bytearray(types.encode(ours("a")[types.TWIST]))
    assert padded[18:20] == b"\0\0"  # between the two bytes of the name and the numbers
    padded[18:20] = b"go"
    assert types.decode(types.TWIST, bytes(padded)) == ours("a")[types.TWIST]


@pytest.mark.parametrize(
    ("change", "field", "bound"),
    [
        (lambda data: b"\0\0" + data[2:], "encapsulation", "00 01"),
        (lambda data: b"\0\x07" + data[2:], "encapsulation", "00 01"),
        (lambda data: data + bytes(8), "bytes after the last field", "at most 7"),
        (lambda data: data[:8] + (10**9).to_bytes(4, "little") + data[12:], "header.stamp.nanosec", "below 1000000000"),
        (lambda data: data[:12] + b"\xff\xff\xff\x7f" + data[16:], "header.frame_id", "at most 257"),
        (lambda data: data[:16] + b"\xff" + data[17:], "header.frame_id", "UTF-8"),
    ],
)
def test_a_wrong_field_is_named(change, field, bound):
    with pytest.raises(InvalidField) as caught:
        types.decode(types.TWIST, change(types.encode(ours("cam0")[types.TWIST])))
    assert caught.value.details["field"] == field
    assert bound in caught.value.details["bound"]


def test_what_does_not_fit_is_not_written():
    whole = ours("cam0")
    for message, field in (
        (whole[types.TWIST]._replace(linear=(1.0, 2.0)), "linear"),
        (whole[types.EVENTS]._replace(seq=-1), "seq"),
        (whole[types.CAMERA]._replace(d=(0.0,) * 65), "d"),
        (whole[types.POSE]._replace(header=Header.at(NS, "x" * 257)), "frame_id"),
    ):
        with pytest.raises(InvalidField) as caught:
            types.encode(message)
        assert caught.value.details["field"] == field
    with pytest.raises(InvalidField, match="stamp"):
        Header.at(-1, "")
    with pytest.raises(InvalidField, match="is_bigendian"):
        whole[types.EVENTS]._replace(is_bigendian=True).message()


def test_the_peer_of_the_live_tests_knows_the_types():
    assert {ros_peer.EVENTS, ros_peer.TWIST, ros_peer.IMU, ros_peer.CAMERA} <= set(TYPES.types)
