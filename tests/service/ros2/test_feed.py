"""Messages of a ROS camera become packets of a stream: events, gaps, restarts, times, lens and inertial samples."""

import numpy as np
import pytest

from neurove_core.io.formats.ros import types
from neurove_core.io.formats.ros.types import CameraMessage, EventsMessage, Header, ImuMessage
from neurove_protocol import CameraInfo, Events, Sensor
from neurove_protocol.events import decode_packet
from neurove_protocol.imu import decode_imu
from neurove_service.ros2.feed import SECOND_PUBLISHER_NS, Feed
from neurove_service.ros2.link import Received
from tests.builders import SENSOR, make_events
from tests.builders_evt import write_evt3
from tests.recordings import assert_same

UNIX_NS = 1_700_000_000 * 10**9
A, B = b"a" * 16, b"b" * 16


def mono(events, base_us):
    rows = np.zeros(events.n, [("dt", "<u4"), ("x", "<u2"), ("y", "<u2")])
    rows["dt"], rows["x"], rows["y"] = (
        (events.t - base_us) * 1000,
        events.x,
        events.y | events.p.astype(np.uint16) << 15,
    )
    return rows.tobytes()


def evt3(events):
    return write_evt3(events).words.tobytes()


def packet(seq, data, *, base_us=0, stamp_ns=UNIX_NS, encoding="mono", sensor=SENSOR):
    head = Header.at(stamp_ns, "camera")
    return EventsMessage(head, sensor.height, sensor.width, seq, base_us * 1000, encoding, False, data)


def received(message, kind=types.EVENTS, at_ns=0, publisher=A):
    payload = message if isinstance(message, bytes) else types.encode(message)
    return Received(kind, payload, at_ns, UNIX_NS + at_ns, publisher)


def part(i, n=100, sensor=SENSOR):
    return make_events(n, seed=20_100 + i, start_us=i * 4000, duration_us=4000, sensor=sensor)


def play(feed, seqs, **how):
    """Mono messages with these numbers, each of 4 ms of sensor time by its number."""
    return [
        decode_packet(one.payload)
        for i in seqs
        for one in feed.accept(
            received(packet(i, mono(part(i), i * 4000), base_us=i * 4000, stamp_ns=UNIX_NS + i * 4_000_000), **how)
        )
    ]


@pytest.mark.parametrize("encoding", ["mono", "evt3"])
def test_the_events_are_those_of_the_messages_and_numbers_have_no_gap(encoding):
    feed, parts, packets = Feed("cam0"), [part(i) for i in range(5)], []
    whole = write_evt3(Events.join(parts))
    ends = [whole.ends[sum(one.n for one in parts[: i + 1]) - 1] for i in range(5)]
    for i, one in enumerate(parts):
        data = mono(one, i * 4000) if encoding == "mono" else whole.words[ends[i - 1] if i else 0 : ends[i]].tobytes()
        packets += feed.accept(received(packet(i, data, base_us=i * 4000, encoding=encoding)))
    decoded = [decode_packet(one.payload) for one in packets]
    assert [one.seq for one in decoded] == list(range(5))
    assert {one.stream for one in decoded} == {"cam0"}
    assert_same(Events.join([one.events for one in decoded]), Events.join(parts))
    assert (feed.counts.messages, feed.counts.events, feed.counts.packets) == (5, 500, 5)


def test_a_long_message_is_split_into_packets():
    events = make_events(50_000, seed=20_200, duration_us=200_000)
    packets = [decode_packet(one.payload) for one in Feed("cam0").accept(received(packet(0, mono(events, 0))))]
    assert_same(Events.join([one.events for one in packets]), events)
    assert max(one.events.n for one in packets) <= 20_000
    assert max(int(one.events.t[-1]) - one.t0_us for one in packets) < 1 << 16


def test_lost_messages_are_counted_and_leave_a_gap_in_the_numbers():
    feed = Feed("cam0")
    assert [one.seq for one in play(feed, [0, 1, 5, 6])] == [0, 1, 5, 6]
    assert (feed.counts.lost_messages, feed.counts.restarts) == (3, 0)


def test_a_refused_message_leaves_a_gap_too_and_says_why():
    feed = Feed("cam0")
    assert [one.seq for one in play(feed, [0])] == [0]
    assert feed.accept(received(packet(1, b"abc", encoding="trigger"))) == []
    assert "unknown encoding 'trigger'; supported: evt2, evt21, evt3, evt4, libcaer, libcaer_cmp, mono" in feed.refusal
    assert [one.seq for one in play(feed, [2])] == [2]
    assert feed.accept(received(b"\0\1\0\0garbage")) == []
    assert "header.stamp.nanosec='3 bytes left': it needs 4 bytes" in feed.refusal
    assert feed.counts.refused_messages == 2
    feed.accept(received(b"", kind="std_msgs/msg/String"))
    assert (feed.counts.other_type, "std_msgs/msg/String" in feed.refusal) == (1, True)


def test_evt3_after_a_gap_waits_for_a_time():
    """The row and the time of the words before are unknown."""
    feed, events = Feed("cam0"), part(0)
    words = write_evt3(events)
    half = int(words.ends[49])
    feed.accept(received(packet(0, words.words[:half].tobytes(), encoding="evt3")))
    rest = feed.accept(received(packet(2, words.words[half:].tobytes(), encoding="evt3")))
    assert sum(decode_packet(one.payload).events.n for one in rest) < 50
    assert feed.counts.lost_messages == 1


def test_a_publisher_that_restarts_begins_with_a_new_clock():
    feed = Feed("cam0")
    before = play(feed, range(1000, 1004), at_ns=0)
    after = play(feed, range(3), at_ns=10, publisher=A)
    assert [one.seq for one in (*before, *after)] == [0, 1, 2, 3, 5, 6, 7]
    assert after[0].t0_us < before[0].t0_us
    assert (feed.counts.restarts, feed.counts.lost_messages) == (1, 0)
    assert feed.clock.ros_ns(1001 * 4000) is None  # an estimate of the clock before


def test_of_two_publishers_the_second_waits_until_the_first_is_silent():
    feed = Feed("cam0")
    play(feed, [0], at_ns=0, publisher=A)
    assert play(feed, [900], at_ns=1000, publisher=B) == []
    assert len(play(feed, [1], at_ns=2000, publisher=A)) == 1
    later = 2000 + SECOND_PUBLISHER_NS
    assert len(play(feed, [901], at_ns=later, publisher=B)) == 1
    assert (feed.counts.foreign_messages, feed.counts.restarts) == (1, 1)


def test_events_outside_the_sensor_and_late_ones_are_counted_and_left_out():
    feed = Feed("cam0")
    events = Events.from_columns([10, 20, 15, 30], [1, 64, 3, 4], [1, 1, 1, 1], [1, 1, 1, 1])
    (one,) = feed.accept(received(packet(0, mono(events, 0))))
    assert decode_packet(one.payload).events.t.tolist() == [10, 30]
    assert (feed.counts.outside_events, feed.counts.late_events) == (1, 1)
    (one,) = feed.accept(received(packet(1, mono(Events.from_columns([25, 40], [1, 1], [1, 1], [0, 0]), 0))))
    assert decode_packet(one.payload).events.t.tolist() == [40]


def test_another_size_of_the_sensor_is_followed():
    feed, larger = Feed("cam0"), Sensor(80, 60)
    play(feed, [0])
    (one,) = feed.accept(received(packet(1, mono(part(1, sensor=larger), 4000), base_us=4000, sensor=larger)))
    assert (decode_packet(one.payload).sensor, feed.counts.resizes) == (larger, 1)
    assert feed.accept(received(packet(2, b"", sensor=larger)._replace(width=0))) == []
    assert "width=0" in feed.refusal


def test_the_stamp_of_the_quickest_message_gives_the_time_of_ros():
    feed = Feed("cam0")
    for i, delay_ms in enumerate((8, 3, 5)):
        base_us = i * 4000
        stamp_ns = UNIX_NS + base_us * 1000 + delay_ms * 1_000_000
        feed.accept(received(packet(i, mono(part(i), base_us), base_us=base_us, stamp_ns=stamp_ns)))
    assert abs(feed.clock.ros_ns(10_000) - (UNIX_NS + 10_000_000 + 3_000_000)) < 10_000  # within the drift of a crystal
    assert feed.clock.ros_ns(-1_000_000) is None
    assert feed.clock.ros_ns(5_000_000) is None


def test_the_time_base_of_evt3_has_no_meaning():
    feed, events = Feed("cam0"), part(3)
    feed.accept(received(packet(0, evt3(events), base_us=77_000_000, encoding="evt3")))
    assert feed.clock.ros_ns(int(events.t[0])) == UNIX_NS


def test_messages_without_events_let_the_time_go_on():
    """A scene without motion: EVT3 then has only times."""
    feed = Feed("cam0")
    feed.accept(received(packet(0, evt3(part(0)), encoding="evt3", stamp_ns=UNIX_NS)))
    (tick,) = feed.accept(received(packet(1, b"", encoding="evt3", stamp_ns=UNIX_NS + 200_000_000)))
    tick = decode_packet(tick.payload)
    assert (tick.seq, tick.events.n) == (1, 0)
    assert 100_000 < tick.t0_us < 200_000 + 4000
    assert feed.clock.ros_ns(tick.t0_us) is not None


def lens(model="plumb_bob", d=(0.1, 0.0, 0.0, 0.0, 0.0), sensor=SENSOR):
    k = (60.0, 0.0, 31.5, 0.0, 61.0, 23.5, 0.0, 0.0, 1.0)
    return CameraMessage(Header.at(0, "c"), sensor.height, sensor.width, model, d, k, (0.0,) * 9, (0.0,) * 12)


def test_a_camera_info_becomes_a_lens_with_the_height_and_is_sent_once():
    feed = Feed("cam0", height_m=1.2)
    (sent,) = feed.accept(received(lens(), types.CAMERA))
    info = CameraInfo.decode(sent.payload)
    assert (sent.kind, info.stream, info.fx, info.fy, info.height_m) == ("camera", "cam0", 60, 61, 1.2)
    assert feed.accept(received(lens(), types.CAMERA)) == []
    assert len(feed.accept(received(lens(d=(0.2, 0.0, 0.0, 0.0, 0.0)), types.CAMERA))) == 1
    assert feed.accept(received(lens("rational_polynomial"), types.CAMERA)) == []
    assert "distortion_model='rational_polynomial'" in feed.refusal


def test_a_calibration_file_replaces_the_camera_info(tmp_path):
    text = "image_width: 64\nimage_height: 48\ncamera_matrix: {data: [50, 0, 32, 0, 50, 24, 0, 0, 1]}\n"
    (tmp_path / "lens.yaml").write_text(text)
    feed = Feed("cam0", calibration=str(tmp_path / "lens.yaml"))
    assert feed.accept(received(lens(), types.CAMERA)) == []
    kinds = [one.kind for one in feed.accept(received(packet(0, mono(part(0), 0))))]
    assert kinds == ["camera", "events"]


def sample(t_us, gyro=(0.1, 0.2, 0.3), accel=(1.0, 2.0, 9.0)):
    nine = (0.0,) * 9
    return ImuMessage(Header.at(UNIX_NS + t_us * 1000, "imu"), (0.0,) * 4, nine, gyro, nine, accel, nine)


def test_inertial_samples_go_before_the_events_on_the_sensor_clock_in_the_optical_frame():
    axes = np.array([[0.0, -1, 0], [0, 0, -1], [1, 0, 0]])  # from x forward, y left, z up
    feed = Feed("cam0", imu_axes=axes)
    play(feed, [0])
    for t_us in (5000, 6000):
        assert feed.accept(received(sample(t_us), types.IMU)) == []
    message = packet(1, mono(part(1), 4000), base_us=4000, stamp_ns=UNIX_NS + 4_000_000)
    inertial, events = feed.accept(received(message))
    assert (inertial.kind, events.kind) == ("imu", "events")
    samples = decode_imu(inertial.payload).samples
    assert samples.t.tolist() == [5000, 6000]
    np.testing.assert_allclose(samples.gyro_rad_s, [[-0.2, -0.3, 0.1]] * 2)
    np.testing.assert_allclose(samples.accel_m_s2, [[-2.0, -9.0, 1.0]] * 2)


def test_samples_without_axes_late_or_not_finite_are_ignored_and_counted():
    feed = Feed("cam0")
    feed.accept(received(sample(0), types.IMU))
    play(feed, [0])
    feed.accept(received(sample(5000), types.IMU))
    assert len(play(feed, [1])) == 1
    assert (feed.counts.ignored_imu, "give --imu-axes" in feed.refusal) == (2, True)
    feed = Feed("cam0", imu_axes=np.eye(3))
    play(feed, [0])
    for one in (sample(6000), sample(5000, gyro=(np.nan, 0.0, 0.0)), sample(5500, accel=(2e4, 0.0, 0.0))):
        feed.accept(received(one, types.IMU))
    feed.accept(received(packet(1, mono(part(1), 4000), base_us=4000)))
    assert (feed.counts.imu_samples, feed.counts.ignored_imu) == (1, 2)
