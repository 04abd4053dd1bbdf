"""ROS bags with messages that rosbag2 compressed one by one, and IMU samples that are out of order."""

import sqlite3
import sys

import numpy as np
import pytest

from neurove_core.extras import MissingExtra
from neurove_core.io import UnknownSource
from neurove_core.sources import open_source
from neurove_protocol import Events
from tests import ros_bags
from tests.builders import make_events
from tests.neurove_core.io.test_rosbag import imu_and_pose, in_packets
from tests.recordings import assert_same, read, read_broken

zstandard = pytest.importorskip("zstandard")
EVENTS = make_events(2000, duration_us=200_000)


@pytest.fixture
def compressed_bag(tmp_path):
    """A rosbag2 folder with `compression_mode: message` and five event messages."""
    folder = ros_bags.write_bag(tmp_path / "packed", ros_bags.Store(2), in_packets(ros_bags.Store(2), EVENTS))
    with sqlite3.connect(folder / "packed.db3") as connection:
        rows = connection.execute("SELECT id, data FROM messages").fetchall()
        rows = [(zstandard.compress(data), number) for number, data in rows]
        connection.executemany("UPDATE messages SET data = ? WHERE id = ?", rows)
    connection.close()
    return folder


def modify(folder, number, modified):
    with sqlite3.connect(folder / "packed.db3") as connection:
        (data,) = connection.execute("SELECT data FROM messages WHERE id = ?", (number,)).fetchone()
        connection.execute("UPDATE messages SET data = ? WHERE id = ?", (modified(data), number))
    connection.close()


def test_messages_compressed_one_by_one_are_read_unchanged(compressed_bag):
    assert_same(read(open_source(str(compressed_bag))), EVENTS)


@pytest.mark.parametrize("modified", [lambda data: data[:10] + b"\xff" * 40, lambda data: "a text"])
def test_a_message_that_cannot_be_decompressed_is_skipped_and_counted_with_its_place(compressed_bag, modified):
    modify(compressed_bag, 3, modified)
    events, error = read_broken(open_source(str(compressed_bag)))
    assert_same(events, Events.join([EVENTS.span(0, 800), EVENTS.span(1200, 2000)]))
    assert error is not None
    assert "message 3" in str(error.details["where"])


def test_a_missing_library_is_reported(compressed_bag, monkeypatch):
    monkeypatch.setitem(sys.modules, "zstandard", None)
    with pytest.raises(MissingExtra, match="zstandard is not installed"):
        open_source(str(compressed_bag))


def test_a_compressed_file_that_is_no_bag_is_refused(tmp_path):
    (tmp_path / "run_0.db3.zstd").write_bytes(zstandard.compress(b"a bag"))
    with pytest.raises(UnknownSource, match="not a ROS 2 bag"):
        open_source(str(tmp_path))


def test_a_late_imu_sample_is_discarded_and_counted_with_its_place(tmp_path):
    store = ros_bags.Store(2)
    samples = [next(imu_and_pose(store, i)) for i in (0, 1, 2, 0, 3)]
    messages = [*in_packets(store, EVENTS), *((topic, samples[-1][1], one) for topic, _, one in samples)]
    recording = open_source(str(ros_bags.write_bag(tmp_path / "a", store, messages)))
    t = np.concatenate([imu.t for imu in recording.imu()])
    np.testing.assert_array_equal(np.diff(t), [1000, 1000, 1000])
    (fault,) = recording.faults.found
    assert (fault.stream, fault.reason, fault.where) == ("imu", "late", "message 9 of a.db3")


def test_a_bag_without_poses_and_evt3_gives_no_poses_and_no_triggers(tmp_path):
    store = ros_bags.Store(2)
    recording = open_source(str(ros_bags.write_bag(tmp_path / "a", store, in_packets(store, EVENTS))))
    assert recording.poses() is None
    assert recording.twists() is None
    assert list(recording.triggers()) == []
