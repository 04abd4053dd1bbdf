"""ROS bags whose messages rosbag2 compressed one by one, and samples beside the events that are out of order."""

import sqlite3
import sys

import numpy as np
import pytest

from neurove_core.extras import MissingExtra
from neurove_core.io import BrokenRecording, UnknownSource
from neurove_core.sources import open_source
from tests import ros_bags
from tests.builders import make_events
from tests.neurove_core.io.test_rosbag import beside, in_packets
from tests.recordings import assert_same, read, read_broken

zstandard = pytest.importorskip("zstandard")
EVENTS = make_events(2000, duration_us=200_000)


@pytest.fixture
def packed(tmp_path):
    """A folder of rosbag2 with `compression_mode: message`, five messages of events in it."""
    folder = ros_bags.write_bag(tmp_path / "packed", ros_bags.Store(2), in_packets(ros_bags.Store(2), EVENTS))
    with sqlite3.connect(folder / "packed.db3") as connection:
        rows = connection.execute("SELECT id, data FROM messages").fetchall()
        compressed = [(zstandard.compress(data), number) for number, data in rows]
        connection.executemany("UPDATE messages SET data = ? WHERE id = ?", compressed)
    connection.close()
    return folder


def change(folder, number, changed):
    with sqlite3.connect(folder / "packed.db3") as connection:
        (data,) = connection.execute("SELECT data FROM messages WHERE id = ?", (number,)).fetchone()
        connection.execute("UPDATE messages SET data = ? WHERE id = ?", (changed(data), number))
    connection.close()


def test_messages_that_were_compressed_one_by_one_are_read_as_they_were(packed):
    assert_same(read(open_source(str(packed))), EVENTS)


@pytest.mark.parametrize("changed", [lambda data: data[:10] + b"\xff" * 40, lambda data: "a text"])
def test_a_message_that_can_not_be_unpacked_ends_the_recording_at_its_place(packed, changed):
    change(packed, 3, changed)
    events, error = read_broken(open_source(str(packed)))
    assert_same(events, EVENTS.span(0, 800))
    assert error is not None
    assert "message 3" in str(error.details["where"])


def test_without_the_library_its_absence_is_told(packed, monkeypatch):
    monkeypatch.setitem(sys.modules, "zstandard", None)
    with pytest.raises(MissingExtra, match="zstandard is not installed"):
        open_source(str(packed))


def test_files_that_were_compressed_as_a_whole_say_what_to_do(tmp_path):
    (tmp_path / "run_0.db3.zstd").write_bytes(zstandard.compress(b"a bag"))
    with pytest.raises(UnknownSource, match="`zstd -d` them"):
        open_source(str(tmp_path))


def test_an_imu_whose_time_runs_backwards_ends_there_after_what_was_good(tmp_path):
    store = ros_bags.Store(2)
    samples = [next(beside(store, i)) for i in (0, 1, 2, 0, 3)]
    messages = [*in_packets(store, EVENTS), *((topic, samples[-1][1], one) for topic, _, one in samples)]
    blocks = open_source(str(ros_bags.write_bag(tmp_path / "a", store, messages))).imu()
    np.testing.assert_array_equal(np.diff(next(blocks).t), [1000, 1000])
    with pytest.raises(BrokenRecording, match="message 9.*time runs backwards"):
        next(blocks)


def test_topics_without_a_message_give_no_poses_and_no_triggers(tmp_path):
    store = ros_bags.Store(2)
    recording = open_source(str(ros_bags.write_bag(tmp_path / "a", store, in_packets(store, EVENTS))))
    assert recording.poses() is None
    assert recording.twists() is None
    assert list(recording.triggers()) == []
