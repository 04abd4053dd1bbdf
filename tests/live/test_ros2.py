"""The bridge to ROS 2 over Zenoh: real processes, a real router, and a node of rmw_zenoh in plain zenoh-python."""

import contextlib
import json
import threading
from contextlib import ExitStack

import numpy as np
import pytest

from neurove_core.geometry.mounting import Mounting
from neurove_core.io.formats.ros.types import HASHES
from neurove_protocol import Sensor
from neurove_service.clients import ask
from neurove_service.config import ClientConfig
from neurove_service.guard import Guard
from neurove_service.ros2 import graph
from neurove_service.ros2.graph import Entity, Topic
from neurove_service.ros2.zenoh_link import ZenohLink
from neurove_service.transport import TIMESTAMPS, open_transport
from tests import ros_peer
from tests.builders import make_events
from tests.builders_evt import write_evt3
from tests.live.conftest import START_S, Heard, Process, client, free_endpoint, is_alive, wait_until
from tests.recordings import shared
from tests.ros_peer import CAMERA, DIAGNOSTICS, EVENTS, IMU, LATCHED, TWIST, RosNode, header, make

pytestmark = pytest.mark.live

SENSOR = Sensor(64, 48)
ROS_NS = 1_700_000_000 * 10**9  # ROS time of the sensor's time 0
MESSAGE_US, WINDOW_US = 10_000, 50_000


class Place:
    """A router, a service behind it, and the bridge; the router can be restarted."""

    def __init__(self, stack):
        self.endpoint = free_endpoint()
        self._stack = stack
        self.router = self.start_router()
        client(self.endpoint, START_S).close()
        flags = ("--mode", "client", "--connect", self.endpoint, "--node", "n1", "--log-level", "warning")
        self.service = self.process("serve", *flags, "--queue-s", "30", "--idle-evict-s", "600")
        self.config = ClientConfig(connect=(self.endpoint,))
        self.transport = stack.enter_context(client(self.endpoint))
        wait_until(lambda: is_alive(self.transport, self.config), START_S)

    def process(self, *arguments):
        process = Process(*arguments)
        self._stack.callback(process.end)
        return process

    def start_router(self):
        router = Process(self.endpoint, module="tests.live.router")
        self._stack.callback(router.end)
        return router

    def bridge(self, stream, *flags, topic):
        """A bridge whose node other nodes see."""
        process = self.process(
            "ros2", "--connect", self.endpoint, "--events", topic, "--stream", stream, "--json", *flags
        )
        wait_until(
            lambda: any(f"/bridge_{stream}" in one for one in self.ros_tokens()) or process.child.poll() is not None
        )
        return process

    def ros_tokens(self):
        return self.transport.tokens("@ros2_lv/**", 5.0)

    def counted(self, stream):
        found = [one for one in ask.health(self.transport, self.config)[0].streams if one.stream == stream]
        return found[0] if found else None


@pytest.fixture(scope="module")
def place():
    with ExitStack() as stack:
        yield Place(stack)


class Camera:
    """The event messages of one camera: a new one begins with the message 0 and the time 0."""

    def __init__(self, publish, sensor=SENSOR, encoding="evt3", seed=20_000):
        self._publish, self.sensor, self._encoding, self._seed = publish, sensor, encoding, seed
        self.seq = self.t_us = 0

    def message(self, n=200, skip=0):
        self.seq += skip
        self.t_us += skip * MESSAGE_US
        span = {"start_us": self.t_us, "duration_us": MESSAGE_US}
        made = make_events(n, seed=self._seed + self.seq, sensor=self.sensor, **span)
        made.t[0] = self.t_us  # so that the stamp is the time of the first event
        data = np.frombuffer(write_evt3(made).words.tobytes(), np.uint8)
        stamp = header(ROS_NS + self.t_us * 1000)
        size = (self.sensor.height, self.sensor.width)
        packet = make(EVENTS, stamp, *size, self.seq, 0, self._encoding, False, data)
        self.seq, self.t_us = self.seq + 1, self.t_us + MESSAGE_US
        return ros_peer.cdr(packet)

    def play(self, count, pause_s=0.004, **message):
        for _ in range(count):
            self._publish(self.message(**message))
            threading.Event().wait(pause_s)


def camera_info(sensor=SENSOR):
    k = np.array([60, 0, 31.5, 0, 60, 23.5, 0, 0, 1], float)
    region = make("sensor_msgs/msg/RegionOfInterest", 0, 0, 0, 0, False)
    size = (sensor.height, sensor.width)
    return ros_peer.cdr(
        make(CAMERA, header(0), *size, "plumb_bob", np.zeros(5), k, np.eye(3).ravel(), np.zeros(12), 0, 0, region)
    )


def imu(ns):
    def vector(*xyz):
        return make("geometry_msgs/msg/Vector3", *xyz)

    nine = np.zeros(9)
    fields = (make("geometry_msgs/msg/Quaternion", 0.0, 0.0, 0.0, 1.0), nine, vector(0.0, 0.0, 0.1), nine)
    return ros_peer.cdr(make(IMU, header(ns), *fields, vector(0.0, -9.8, 0.0), nine))


def values(status):
    return {pair.key: pair.value for pair in status.values}


def test_events_become_velocities_and_every_count_is_exact(place):
    topics = [f"/exact{i}/events" for i in range(2)]
    with RosNode(place.endpoint) as node, client(place.endpoint) as consumer:
        latched = node.publisher("/exact0/camera_info", CAMERA, LATCHED)
        latched(camera_info())  # before the bridge: only a latched message reaches it
        more = ("--events", topics[1], "--stream", "exact1", "--height", "1.2", "--imu-axes", "x,y,z")
        bridge = place.bridge("exact0", *more, topic=topics[0])
        heard = Heard(consumer, place.config)
        twists = [node.subscribe(f"/neurove/exact{i}/velocity", TWIST) for i in range(2)]
        diagnostics = node.subscribe("/diagnostics", DIAGNOSTICS)
        plain = node.publisher("/exact1/camera_info", CAMERA)  # not latched
        publishers = [node.publisher(topic, EVENTS) for topic in topics]
        publish_imu = node.publisher("/exact0/imu", IMU)
        wait_until(lambda: all(one.matching() for one in (*publishers, publish_imu, plain)))
        plain(camera_info())
        assert_listed(node.tokens(), "exact0_exact1", topics)
        cameras = [Camera(publish, seed=20_000 + 500 * i) for i, publish in enumerate(publishers)]
        for _ in range(60):
            publish_imu(imu(ROS_NS + cameras[0].t_us * 1000))
            for camera in cameras:
                camera.play(1, pause_s=0.003)
        windows = 59 * MESSAGE_US // WINDOW_US
        wait_until(lambda: all(len(one) >= windows for one in twists))
        wait_until(lambda: all(len(heard.of(f"exact{i}")) >= windows for i in range(2)))
        wait_until(lambda: diagnostics and values(diagnostics[-1][0].status[0]).get("messages") == "60")
        counted = [place.counted(f"exact{i}") for i in range(2)]
    code, out, err = bridge.end()
    assert (code, err.count("->")) == (0, 4)
    for i, (found, one) in enumerate(zip(twists, counted, strict=True)):
        assert (one.packets_received, one.events_received, one.calibrated) == (60, 60 * 200, True)
        assert (one.windows, one.lost.nonzero()) == (windows, {})
        assert_published(found, heard.of(f"exact{i}"))
    assert counted[0].imu.samples == 60
    summary = json.loads(out)
    assert summary["internal_errors"] == {}
    assert summary["streams"]["exact0"]["velocity_sent"] == windows
    assert {name: count for name, count in summary["streams"]["exact0"].items() if count and "lost" in name} == {}
    status = diagnostics[-1][0].status
    assert [one.name for one in status] == ["neurove: exact0", "neurove: exact1"]


def assert_listed(tokens, name, topics):
    """What `ros2 node list` and `ros2 topic list` read."""
    ours = [token for token in tokens if f"/bridge_{name}" in token]
    assert sum("/NN/" in token for token in ours) == 1
    published = {token.split("/")[9].replace("%", "/") for token in ours if "/MP/" in token}
    assert published == {"/diagnostics", *(f"/neurove/{topic.split('/')[1]}/velocity" for topic in topics)}
    heard = {token.split("/")[9].replace("%", "/") for token in ours if "/MS/" in token}
    assert heard == {topic.replace("events", leaf) for topic in topics for leaf in ("events", "imu", "camera_info")}


def assert_published(twists, estimates):
    """Each estimate is one message, in order, with its time and its covariance."""
    assert [int.from_bytes(attachment[:8], "little") for _, attachment in twists] == list(range(1, len(twists) + 1))
    for (message, _), estimate in zip(twists, estimates, strict=True):
        stamp = message.header.stamp
        assert stamp.sec * 10**9 + stamp.nanosec == ROS_NS + estimate.end_us * 1000
        assert message.header.frame_id == "camera_optical"
        twist, covariance = message.twist.twist, message.twist.covariance.reshape(6, 6)
        sent = [getattr(part, axis) for part in (twist.linear, twist.angular) for axis in "xyz"]
        np.testing.assert_array_equal(sent, estimate.twist)
        doubtful = {"uncertain", "unscaled", "settling", "reset"} & set(estimate.flags)
        assert (covariance[0, 0] == 1e6) == bool(doubtful)
        known = np.array(estimate.covariance).reshape(6, 6)
        if not {"settling", "reset"} & set(estimate.flags):
            np.testing.assert_array_equal(covariance[3:, 3:], known[3:, 3:])
            assert not covariance[:3, 3:].any() or not doubtful


def test_the_bridge_lives_through_faults_and_counts_them(place):
    with RosNode(place.endpoint) as node:
        bridge = place.bridge("faulty", "--camera-info", "none", topic="/faulty/events")
        diagnostics = node.subscribe("/diagnostics", DIAGNOSTICS)
        twists = node.subscribe("/neurove/faulty/velocity", TWIST)
        publish = node.publisher("/faulty/events", EVENTS)
        wait_until(publish.matching)
        camera = Camera(publish)
        camera.play(12)
        camera.play(1, skip=3)
        for garbage in (b"", b"\0\1\0\0", b"no CDR at all, of some length", camera.message()[:-7], bytes(200)):
            publish(garbage)
        other = node.publisher("/faulty/events", IMU)
        wait_until(other.matching)
        other(imu(ROS_NS))

        def status():
            mine = [one for message, _ in list(diagnostics) for one in message.status if one.name == "neurove: faulty"]
            return values(mine[-1]) if mine else {}

        camera.play(12)
        wait_until(lambda: status().get("messages") == "25")
        found = {name: int(count) for name, count in status().items() if count.isdecimal() and int(count)}
        assert (found["lost_messages"], found["refused_messages"], found["other_type"]) == (4, 5, 1)
        assert "sends the type sensor_msgs/msg/Imu instead of event_camera_msgs/msg/EventPacket" in status()["refusal"]
        wait_until(lambda: len(twists) >= 4)
        assert twists[-1][0].twist.covariance[0] == 1e6  # no lens: no metre
    with RosNode(place.endpoint, "driver_again") as node:  # the driver restarts, with another sensor
        publish = node.publisher("/faulty/events", EVENTS)
        twists, diagnostics = (
            node.subscribe("/neurove/faulty/velocity", TWIST),
            node.subscribe("/diagnostics", DIAGNOSTICS),
        )
        wait_until(publish.matching)
        threading.Event().wait(0.6)  # a second publisher is followed after half a second
        camera = Camera(publish, Sensor(80, 60))
        camera.play(32)
        wait_until(lambda: status().get("messages") == "57")
        wait_until(lambda: len(twists) >= 4)
        found = {name: int(count) for name, count in status().items() if count.isdecimal()}
        assert (found["restarts"], found["resizes"], found["foreign_messages"]) == (1, 1, 0)
        counted = place.counted("faulty")
        assert (counted.width, counted.height) == (80, 60)
    assert bridge.end()[0] == 0


def test_a_robot_with_humble_receives_twists_of_its_base(place, tmp_path):
    mounting = Mounting.from_angles(pitch_deg=20, position_m=(0.5, 0.1, 0.8))
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = mounting
    (tmp_path / "camera.txt").write_text(str(pose.tolist()))
    flags = ("--distro", "humble", "--frame", "base_link", "--extrinsics", str(tmp_path / "camera.txt"))
    with RosNode(place.endpoint, hash_of=lambda _: "TypeHashNotSupported") as node, client(place.endpoint) as consumer:
        bridge = place.bridge("humble", *flags, topic="/humble/events")
        heard, twists = Heard(consumer, place.config), node.subscribe("/neurove/humble/velocity", TWIST)
        publish = node.publisher("/humble/events", EVENTS)
        wait_until(publish.matching)
        camera = Camera(publish)
        wait_until(lambda: camera.play(5) or (len(twists) >= 2 and len(heard.of("humble")) >= 2))
    assert bridge.end()[0] == 0
    (message, _), estimate = twists[1], heard.of("humble")[1]
    twist = message.twist.twist
    sent = [getattr(part, axis) for part in (twist.linear, twist.angular) for axis in "xyz"]
    np.testing.assert_allclose(sent, mounting.adjoint @ estimate.twist, atol=1e-12)
    assert message.header.frame_id == "base_link"


def test_the_recorded_node_of_rmw_zenoh_is_heard_as_a_peer(place):
    """Its tokens and messages, byte for byte: each arrives with its type and the identity of its publisher."""
    recorded = json.loads(shared("ros2/rmw_zenoh_kilted.json").read_text())
    tokens = [token for _, token in recorded["tokens"] if "/MP/" in token]
    entities = {graph.gid_of(token): Entity.of_token(token) for token in tokens}
    entities = {gid: entity for gid, entity in entities.items() if entity.type in HASHES}
    samples = [sample for sample in recorded["samples"] if graph.type_of(sample["key"]) in HASHES]
    own = open_transport("client", connect=(place.endpoint,), patience_s=START_S, more=TIMESTAMPS)
    link, heard = ZenohLink(own, 0, "/neurove", "listener", "kilted", Guard()), []
    with contextlib.closing(link), client(place.endpoint) as peer:
        for entity in entities.values():
            link.subscribe(Topic(entity.topic, entity.type), entity.qos, heard.append)
        for token in tokens:
            peer.token(token)
        kept = [peer.session.declare_publisher(sample["key"]) for sample in samples]
        wait_until(lambda: all(getattr(one.matching_status, "matching", False) for one in kept))
        for sample, publisher in zip(samples, kept, strict=True):
            publisher.put(bytes.fromhex(sample["payload"]), attachment=bytes.fromhex(sample["attachment"]))
        wait_until(lambda: len(heard) == len(samples))
        assert link.fault == ""
    assert len(samples) == 10
    for one, sample in zip(heard, samples, strict=True):
        entity = entities[one.publisher]
        assert (one.type, one.payload.hex()) == (entity.type, sample["payload"])
        assert sample["key"].startswith(f"0{entity.topic}/")


def test_after_a_restart_of_the_router_the_node_is_back_and_velocities_come(place):
    bridge = place.bridge("again", topic="/again/events")
    place.router.end()
    place.router = place.start_router()
    client(place.endpoint, START_S).close()
    with RosNode(place.endpoint) as node:
        publish, twists = node.publisher("/again/events", EVENTS), node.subscribe("/neurove/again/velocity", TWIST)
        wait_until(publish.matching)
        wait_until(lambda: sum("/bridge_again/" in token for token in node.tokens()) == 5)
        camera = Camera(publish)
        wait_until(lambda: camera.play(5) or len(twists) >= 5)
    code, out, _ = bridge.end()
    assert (code, json.loads(out)["internal_errors"]) == (0, {})
