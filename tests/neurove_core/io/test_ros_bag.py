"""A recording as a ROS 2 bag: rosbags reads it, our own reader reads it, and nothing differs."""

import numpy as np
import pytest
from rosbags.highlevel import AnyReader
from rosbags.typesys import Stores, get_typestore

from neurove_core.io.formats.ros import types
from neurove_core.io.formats.ros.bag_writer import write_bag
from neurove_core.io.formats.ros.definitions import definition
from neurove_core.sources import open_source
from neurove_protocol.errors import InvalidField
from neurove_service.cli.main import main
from tests import ros_bags
from tests.builders import make_events
from tests.recordings import all_samples, assert_same, read
from tests.ros_peer import TYPES

SOURCE = "sim://street?seed=20400&seconds=1.2&camera=davis346-half&imu=200"


@pytest.fixture(scope="module")
def converted(tmp_path_factory):
    """The source and its bag, converted with estimates by the command."""
    folder = tmp_path_factory.mktemp("bag")
    log, estimates, bag = (folder / name for name in ("night.mcap", "estimates.mcap", "night.ros2.mcap"))
    assert main(["convert", SOURCE, str(log)]) == 0
    assert main(["estimate", str(log), "--out", str(estimates)]) == 0
    assert main(["convert", str(log), str(bag), "--for", "ros2", "--estimates", str(estimates)]) == 0
    return open_source(str(log)), bag


def by_topic(bag):
    """Every message of a bag by topic, decoded by rosbags from the definitions in the file alone."""
    found = {}
    with AnyReader([bag], default_typestore=get_typestore(Stores.EMPTY)) as reader:
        for connection, ns, data in reader.messages():
            found.setdefault(connection.topic, []).append((ns, reader.deserialize(data, connection.msgtype)))
    return found


def test_rosbags_reads_every_topic_with_the_definitions_in_the_file(converted):
    recording, bag = converted
    found = by_topic(bag)
    counts = {topic: len(messages) for topic, messages in found.items()}
    assert set(counts) == {
        *(f"/cam0/{name}" for name in ("events", "camera_info", "imu", "truth/velocity")),
        "/neurove/cam0/velocity",
    }
    assert counts["/cam0/imu"] == all_samples(recording).n
    assert counts["/cam0/truth/velocity"] == recording.twists().t.size
    assert counts["/cam0/camera_info"] == 2
    assert sum(message.events.size for _, message in found["/cam0/events"]) == 8 * read(recording).n
    _, twist = found["/cam0/truth/velocity"][10]
    stamp_us = twist.header.stamp.sec * 10**6 + twist.header.stamp.nanosec // 1000
    truth = recording.twists()
    row = truth.twist[int(np.searchsorted(truth.t, stamp_us))]
    np.testing.assert_array_equal([twist.twist.twist.linear.z, twist.twist.twist.angular.y], row[[2, 4]])
    _, estimated = found["/neurove/cam0/velocity"][-1]
    assert (estimated.header.frame_id, estimated.twist.covariance.shape) == ("cam0_optical_frame", (36,))
    assert estimated.twist.covariance[0] > 0


def test_our_reader_reads_back_events_samples_lens_and_poses_exactly(converted):
    recording, bag = converted
    again = open_source(str(bag))
    assert again.sensor == recording.sensor
    assert_same(read(again), read(recording))
    for got, want in zip(all_samples(again), all_samples(recording), strict=True):
        np.testing.assert_array_equal(got, want)
    lens = recording.camera("cam0")
    assert again.camera("cam0") == lens.model_copy(update={"height_m": None})


def test_poses_are_read_back(tmp_path):
    store = ros_bags.Store(2)
    pose, point, turn = "geometry_msgs/msg/Pose", "geometry_msgs/msg/Point", "geometry_msgs/msg/Quaternion"
    events = [make_events(50, seed=20_410 + i, start_us=i * 100_000) for i in range(4)]
    messages = [("/dvs/events", one.first_us * 1000, ros_bags.dvs(store, one)) for one in events]
    for i in range(20):
        placed = store.of(pose, store.of(point, i * 0.1, 0.5, -0.25), store.of(turn, 0.0, 0.6, 0.0, 0.8))
        ns = i * 20_000_000
        messages.append(("/dvs/pose", ns, store.of(ros_bags.POSE, store.header(ns), placed)))
    source = open_source(str(ros_bags.write_bag(tmp_path / "a", store, sorted(messages, key=lambda one: one[1]))))
    write_bag(source, tmp_path / "b.mcap")
    again = open_source(str(tmp_path / "b.mcap"))
    assert again.poses().t.size == 20
    for got, want in zip(again.poses(), source.poses(), strict=True):
        np.testing.assert_array_equal(got, want)
    assert_same(read(again), read(source))


@pytest.mark.parametrize("kind", [types.EVENTS, types.TWIST, types.IMU, types.CAMERA, types.POSE])
def test_the_definitions_have_the_fields_of_rosbags(kind):
    def parts(text):
        first, *others = text.rstrip("\n").split("=" * 80 + "\n")
        return first.rstrip("\n"), {other.rstrip("\n") for other in others}

    assert parts(definition(kind)) == parts(TYPES.generate_msgdef(kind, ros_version=2)[0])


def test_what_cannot_become_a_bag_is_refused(run, tmp_path):
    for arguments, why in (
        (("a.h5", "--for", "ros2"), "must end in .mcap, for --for ros2"),
        (("a.mcap", "--estimates", "b.mcap"), "--estimates='b.mcap': it needs --for ros2"),
        (("a.mcap", "--for", "ros2", "--estimates", str(tmp_path / "none.mcap")), "No such file"),
    ):
        ran = run("convert", "sim://wall?seconds=0.1", str(tmp_path / arguments[0]), *arguments[1:])
        assert (ran.code, why in ran.err) == (2, True), ran.err
    assert list(tmp_path.iterdir()) == []


def test_a_source_without_end_is_refused(tmp_path):
    with pytest.raises(InvalidField, match="it has no end"):
        write_bag(open_source("sim://wall"), tmp_path / "a.mcap")
