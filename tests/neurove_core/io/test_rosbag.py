"""ROS bags: real bags, every encoding and container as the rosbags package writes them, and damaged bags."""

import re
import struct

import mcap.writer
import numpy as np
import pytest

from neurove_core.io import UnknownSource
from neurove_core.io.formats.ros.libcaer import WORD_EVENTS, LibcaerState, libcaer_decode, libcaer_reference
from neurove_core.sources import open_source
from neurove_protocol import Events, Sensor
from tests import ros_bags
from tests.builders import SENSOR, make_events
from tests.builders_evt import ADDR_X, ADDR_Y, TIME_HIGH, TRIGGER, evt3, write_evt3
from tests.recordings import assert_same, read, read_broken, shared

TOPIC = "/cam/events"
STAMP_NS = 1_700_000_000 * 10**9


def mono(events: Events, base_ns: int = 0) -> bytes:
    rows = np.zeros(events.n, [("dt", "<u4"), ("x", "<u2"), ("y", "<u2")])
    rows["dt"], rows["x"], rows["y"] = events.t * 1000 - base_ns, events.x, events.y | events.p.astype(np.uint16) << 15
    return rows.tobytes()


def in_packets(store, events, per=400, encoding="mono"):
    """Yield (topic, log time, message) of all events, split into packets."""
    for seq, first in enumerate(range(0, events.n, per)):
        part = events.span(first, min(first + per, events.n))
        base_ns = int(part.t[0]) * 1000
        ns = STAMP_NS + base_ns
        message = ros_bags.packet(store, mono(part, base_ns), ns=ns, seq=seq, base_ns=base_ns, encoding=encoding)
        yield TOPIC, ns, message


# --- real bags ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("path", "sensor", "on", "off", "first_us", "last_us"),
    [
        ("test_events_1", Sensor(640, 480), 125_183, 218_291, 7_139_845, 9_218_023),
        ("test_events_1/test_events_1.db3", Sensor(640, 480), 125_183, 218_291, 7_139_845, 9_218_023),
        ("test_events_1.bag", Sensor(640, 480), 125_183, 218_291, 7_139_845, 9_218_023),
        ("test_events_2", Sensor(346, 260), 211_043, 360_223, 1744227144732712, 1744227145732708),
        ("test_data_evt3_trigger", Sensor(1280, 720), 41_439, 41_030, 14_224_870, 15_476_187),
        ("test_data_libcaer_rollover", Sensor(640, 480), 181_908, 152_423, 1702309120762236, 1702309122762222),
        ("test_data_mono_cd", Sensor(640, 480), 50, 50, 0, 99),
    ],
)
def test_a_real_bag_holds_its_known_events(path, sensor, on, off, first_us, last_us):
    recording = open_source(str(shared(f"rosbag/{path}")))
    events = read(recording)
    assert recording.sensor == sensor
    assert (int(events.p.sum()), events.n - int(events.p.sum())) == (on, off)
    assert (events.t[0], events.t[-1]) == (first_us, last_us)


def test_the_sum_of_event_and_trigger_times_equals_that_of_the_public_decoder():
    recording = open_source(str(shared("rosbag/test_events_1")))
    triggers = list(recording.triggers())
    t = np.concatenate([part.t for part in triggers])
    level = np.concatenate([part.level for part in triggers])
    assert int(read(recording).t.sum() + t.sum()) == 2_885_601_049_874  # event_camera_py, tests/test_1.py
    assert (int(level.sum()), int((1 - level).sum())) == (2079, 2078)
    assert set(np.diff(t)) == {500}
    assert "triggers" in recording.streams


@pytest.mark.parametrize("path", ["test_events_1", "test_events_1.bag", "test_events_2", "test_data_libcaer_rollover"])
def test_since_gives_exactly_the_later_events_of_a_real_bag(path):
    recording = open_source(str(shared(f"rosbag/{path}")))
    events = read(recording)
    for t_us in (int(events.t[0]) - 5, int(events.t[events.n // 2]), int(events.t[-1]) + 1):
        later = Events.join(list(recording.since(t_us)))
        assert_same(later, events.span(int(np.searchsorted(events.t, t_us)), events.n))


def test_the_first_half_of_a_real_bag_gives_its_events_and_an_error_with_the_place(tmp_path):
    for name in ("test_events_1.bag", "test_events_2/test_events_2_0.mcap", "test_events_1/test_events_1.db3"):
        path = shared(f"rosbag/{name}")
        truncated = tmp_path / path.name
        truncated.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
        complete = read(open_source(str(path)))
        events, error = read_broken(open_source(str(truncated)))
        assert 0.2 * complete.n < events.n < 0.8 * complete.n
        assert_same(events, complete.span(0, events.n))
        assert error is not None
        assert ("byte" if path.suffix != ".db3" else "message") in error.details["where"]


# --- every container ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("container", ["bag", "bag bz2", "bag lz4", "db3", "mcap"])
def test_events_are_read_unchanged_from_every_container(tmp_path, container):
    events = make_events(5000, duration_us=500_000)
    name, _, compression = container.partition(" ")
    store = ros_bags.Store(1 if name == "bag" else 2)
    path = tmp_path / ("a.bag" if name == "bag" else "a")
    ros_bags.write_bag(path, store, in_packets(store, events), compression=compression, mcap=name == "mcap")
    recording = open_source(str(path))
    assert_same(read(recording), events)
    assert (recording.sensor, recording.streams, recording.name) == (SENSOR, ("events",), path.name)
    assert_same(Events.join(list(recording.since(250_000))), events.span(int(np.searchsorted(events.t, 250_000)), 5000))


@pytest.mark.parametrize("ros", [1, 2])
@pytest.mark.parametrize("n", [0, 1, 2, 777])
def test_dvs_msgs_are_read_in_both_layouts(tmp_path, ros, n):
    store = ros_bags.Store(ros)
    events = make_events(n, start_us=STAMP_NS // 1000)
    closing = make_events(3, start_us=STAMP_NS // 1000 + 200_000)
    messages = [(TOPIC, STAMP_NS, ros_bags.dvs(store, part)) for part in (events, closing)]
    path = ros_bags.write_bag(tmp_path / "a.bag", store, messages)
    assert_same(read(open_source(str(path))), Events.join([events, closing]))


def test_the_files_of_a_folder_are_read_in_the_order_of_their_numbers(tmp_path):
    store, events = ros_bags.Store(2), make_events(3000, duration_us=300_000)
    folder = tmp_path / "folder"
    folder.mkdir()
    packets = list(in_packets(store, events, 250))
    for part in range(12):
        ros_bags.write_bag(tmp_path / f"p{part}", store, packets[part : part + 1])
        (tmp_path / f"p{part}" / f"p{part}.db3").rename(folder / f"run_{part}.db3")
    assert_same(read(open_source(str(folder))), events)


# --- encodings ------------------------------------------------------------------------------------------------------


def evt3_bag(tmp_path, parts, *, seqs=None, stamps_us=None):
    store = ros_bags.Store(2)
    messages = []
    for i, words in enumerate(parts):
        ns = STAMP_NS + (stamps_us[i] if stamps_us else i) * 1000
        messages.append((TOPIC, ns, ros_bags.packet(store, words.tobytes(), ns=ns, seq=seqs[i] if seqs else i)))
    return ros_bags.write_bag(tmp_path / "a", store, messages)


@pytest.mark.parametrize("seed", range(3))
def test_evt3_events_do_not_depend_on_how_the_words_are_split_into_messages(tmp_path, seed):
    events = make_events(4000, seed=seed, start_us=16_700_000, duration_us=300_000)  # includes a wrap of 24 bits
    written = write_evt3(events)
    splits = np.sort(np.random.default_rng(seed).integers(0, written.words.size, 9))
    got = read(open_source(str(evt3_bag(tmp_path, np.split(written.words, splits)))))
    assert_same(got, events)


def test_after_lost_messages_evt3_time_follows_the_stamps_across_a_wrap(tmp_path):
    before, after = make_events(50, start_us=1_000_000, duration_us=1000), make_events(60, start_us=40_000_000)
    stamps = [1_000_000, 40_000_000 + 3_000]
    path = evt3_bag(tmp_path, [write_evt3(before).words, write_evt3(after).words], seqs=[0, 7], stamps_us=stamps)
    assert_same(read(open_source(str(path))), Events.join([before, after]))


def test_a_row_from_before_a_gap_is_not_used_after_the_gap(tmp_path):
    first = evt3((TIME_HIGH, 1), (ADDR_Y, 5), (ADDR_X, 3))
    path = evt3_bag(tmp_path, [first, evt3((TIME_HIGH, 2), (ADDR_X, 4)), evt3((ADDR_X, 9))], seqs=[0, 2, 3])
    assert read(open_source(str(path))).n == 1


def test_triggers_have_the_time_level_and_channel_of_their_words(tmp_path):
    words = [evt3((TIME_HIGH, 2), (6, 7), (TRIGGER, 0x601)), evt3((6, 9), (TRIGGER, 0x300), (ADDR_Y, 0), (ADDR_X, 1))]
    triggers = list(open_source(str(evt3_bag(tmp_path, words))).triggers())
    assert [(list(t), list(c), list(level)) for t, c, level in triggers] == [([8199], [6], [1]), ([8201], [3], [0])]


def test_triggers_stay_on_the_clock_of_the_events_after_a_gap(tmp_path):
    words = [evt3((TIME_HIGH, 2), (ADDR_Y, 0), (ADDR_X, 1), (TRIGGER, 1)), evt3((TIME_HIGH, 4), (TRIGGER, 0))]
    path = evt3_bag(tmp_path, words, seqs=[0, 9], stamps_us=[8_192, (1 << 24) + 16_384 + 500])
    triggers = list(open_source(str(path)).triggers())
    assert [int(part.t[0]) for part in triggers] == [8_192, (1 << 24) + 16_384]


def libcaer(low, x, y, p, valid=1):
    return np.array([(valid | p << 1 | y << 2 | x << 17, low)], [("data", "<u4"), ("t", "<i4")]).tobytes()


def test_libcaer_time_is_unwrapped_and_invalid_events_are_skipped(tmp_path):
    store = ros_bags.Store(2)
    data = libcaer((1 << 31) - 2, 1, 2, 1) + libcaer((1 << 31) - 1, 9, 9, 0, valid=0) + libcaer(3, 4, 5, 0)
    message = ros_bags.packet(store, data, ns=STAMP_NS, seq=0, base_ns=7_000, encoding="libcaer")
    path = ros_bags.write_bag(tmp_path / "a", store, [(TOPIC, STAMP_NS, message)])
    events = read(open_source(str(path)))
    assert [list(column) for column in events] == [[(1 << 31) + 5, (1 << 31) + 10], [1, 4], [2, 5], [1, 0]]


@pytest.mark.parametrize("seed", range(20))
def test_libcaer_cmp_agrees_with_its_reference_implementation(seed):
    rng = np.random.default_rng(seed)
    kinds = rng.choice(6 if seed % 2 else 7, 500, p=None if seed % 2 else [1 / 6] * 5 + [0.16, 1 / 6 - 0.16])
    words = (kinds << 12 | rng.integers(0, 1 << 12, 500) & rng.choice([0x81F, 0xFFF], 500, p=[0.98, 0.02])).astype(
        "<u2"
    )
    state, base_us = LibcaerState(), 10**15
    for part in np.split(words, [100, 101, 350]):
        n = part.size * WORD_EVENTS
        out = Events(np.empty(n, np.int64), np.empty(n, np.uint16), np.empty(n, np.uint16), np.empty(n, np.uint8))
        reserved = np.zeros(2, np.int64)
        state_after, n = libcaer_decode(part, state, base_us, out, reserved)
        want, events, want_reserved = libcaer_reference(part, state, base_us)
        assert_same(out.span(0, n), events)
        assert reserved.tolist() == [len(want_reserved), want_reserved[0] if want_reserved else 0]
        assert state_after == want
        state = state_after


# --- IMU, poses and lens --------------------------------------------------------------------------------------------


def imu_and_pose(store, i):
    of, ns = store.of, STAMP_NS + i * 10**6
    point = of("geometry_msgs/msg/Point", float(i), 2.0, 3.0)
    rotation = of("geometry_msgs/msg/Quaternion", 0.0, 0.0, 0.6, 0.8)
    zeros = np.zeros(9)
    gyro, accel = of("geometry_msgs/msg/Vector3", 0.1, 0.2, float(i)), of("geometry_msgs/msg/Vector3", 1.0, 2.0, 9.8)
    yield "/cam/imu", ns, of(ros_bags.IMU, store.header(ns, "imu"), rotation, zeros, gyro, zeros, accel, zeros)
    yield "/cam/pose", ns, of(ros_bags.POSE, store.header(ns, "w"), of("geometry_msgs/msg/Pose", point, rotation))


def camera_message(store, sensor, model="plumb_bob"):
    k = np.array([50.0, 0, 31.5, 0, 51.0, 23.5, 0, 0, 1])
    roi = store.of("sensor_msgs/msg/RegionOfInterest", 0, 0, 0, 0, False)
    fields = (sensor.height, sensor.width, model, np.array([0.1, 0.2, 0.0, 0.0, 0.0]), k, np.eye(3).ravel())
    return store.of(ros_bags.CAMERA, store.header(STAMP_NS), *fields, np.zeros(12), 0, 0, roi)


@pytest.mark.parametrize(("encoding", "sign"), [("mono", 1), ("libcaer_cmp", -1)])
def test_samples_of_libcaer_are_rotated_into_the_optical_frame(tmp_path, encoding, sign):
    store = ros_bags.Store(2)
    packet = ros_bags.packet(store, b"", ns=STAMP_NS, seq=0, base_ns=0, encoding=encoding)
    messages = [(TOPIC, STAMP_NS, packet), next(iter(imu_and_pose(store, 3)))]
    (imu,) = open_source(str(ros_bags.write_bag(tmp_path / "a", store, messages))).imu()
    np.testing.assert_allclose(imu.accel_m_s2, [[sign * 1.0, 2.0, sign * 9.8]])
    np.testing.assert_allclose(imu.gyro_rad_s, [[sign * 0.1, 0.2, sign * 3.0]])


@pytest.mark.parametrize("ros", [1, 2])
def test_imu_poses_and_lens_are_read_on_the_clock_of_the_events(tmp_path, ros):
    store, events = ros_bags.Store(ros), make_events(100, start_us=2_000_000, duration_us=1000)
    base_ns = int(events.t[0]) * 1000
    packet = ros_bags.packet(store, mono(events, base_ns), ns=STAMP_NS, seq=0, base_ns=base_ns, encoding="mono")
    messages = [(TOPIC, STAMP_NS, packet), ("/cam/camera_info", STAMP_NS, camera_message(store, SENSOR))]
    messages += [("/other/camera_info", STAMP_NS, camera_message(store, Sensor(9, 9)))]
    messages += [one for i in range(5000) for one in imu_and_pose(store, i)]
    recording = open_source(str(ros_bags.write_bag(tmp_path / "a.bag", store, messages)))
    assert recording.streams == ("events", "imu", "poses", "twists")
    parts = list(recording.imu())
    t = np.concatenate([part.t for part in parts])
    np.testing.assert_array_equal(t, events.t[0] + np.arange(5000) * 1000)
    np.testing.assert_allclose(parts[-1].gyro_rad_s[-1], (0.1, 0.2, 4999.0))
    np.testing.assert_allclose(parts[0].accel_m_s2[0], (1.0, 2.0, 9.8))
    poses = recording.poses()
    assert poses is not None
    np.testing.assert_array_equal(poses.t, t)
    np.testing.assert_allclose(poses.position_m[7], (7, 2, 3))
    np.testing.assert_allclose(poses.orientation[7], (0, 0, 0.6, 0.8))
    twists = recording.twists()  # 1 m in x per ms, in the frame of a body rotated by 73.7 degrees about z
    assert twists is not None
    np.testing.assert_allclose(twists.twist[2500], (280, -960, 0, 0, 0, 0), atol=1e-6)
    camera = recording.camera("cam3")
    assert camera is not None
    assert (camera.stream, camera.lens, camera.fx, camera.cy, camera.distortion[:2]) == (
        "cam3",
        "pinhole",
        50,
        23.5,
        (0.1, 0.2),
    )


@pytest.mark.parametrize(
    ("second", "why"),
    [((STAMP_NS - 1, 1.0), "time runs backwards"), ((STAMP_NS + 10**6, 2.0), "are not a pose")],
)
def test_an_invalid_pose_is_skipped_and_a_repeated_pose_is_kept_once(tmp_path, second, why):
    store, of = ros_bags.Store(2), ros_bags.Store(2).of
    messages = list(in_packets(store, make_events(10)))
    for ns, w in ((STAMP_NS, 1.0), (STAMP_NS, 1.0), second):
        rotation, point = (
            of("geometry_msgs/msg/Quaternion", 0.0, 0.0, 0.0, w),
            of("geometry_msgs/msg/Point", 1.0, 2.0, 3.0),
        )
        messages.append(
            ("/pose", ns, of(ros_bags.POSE, store.header(ns), of("geometry_msgs/msg/Pose", point, rotation)))
        )
    recording = open_source(str(ros_bags.write_bag(tmp_path / "a", store, messages)))
    poses = recording.poses()
    assert poses is not None
    assert poses.t.size == 1
    (fault,) = recording.faults.found
    assert fault.where == "message 4 of a.db3"
    assert why in fault.why


def test_odometry_gives_poses(tmp_path):
    store, of = ros_bags.Store(2), ros_bags.Store(2).of
    pose = of(
        "geometry_msgs/msg/Pose",
        of("geometry_msgs/msg/Point", 1.0, 2.0, 3.0),
        of("geometry_msgs/msg/Quaternion", 0.0, 0.0, 0.0, 1.0),
    )
    zero = of("geometry_msgs/msg/Vector3", 0.0, 0.0, 0.0)
    twist = of("geometry_msgs/msg/TwistWithCovariance", of("geometry_msgs/msg/Twist", zero, zero), np.zeros(36))
    odometry = of(
        ros_bags.ODOMETRY,
        store.header(STAMP_NS),
        "base_link",
        of("geometry_msgs/msg/PoseWithCovariance", pose, np.zeros(36)),
        twist,
    )
    messages = [*in_packets(store, make_events(10)), ("/odom", STAMP_NS, odometry)]
    poses = open_source(str(ros_bags.write_bag(tmp_path / "a", store, messages, mcap=True))).poses()
    assert poses is not None
    assert list(poses.position_m[0]) == [1, 2, 3]


# --- selection and errors -------------------------------------------------------------------------------------------


def test_the_first_topic_or_the_given_topic_is_read(tmp_path):
    store, left, right = ros_bags.Store(2), make_events(50, seed=1), make_events(60, seed=2)
    messages = [("/right/events", ns, message) for _, ns, message in in_packets(store, right)]
    messages += [("/left/events", ns, message) for _, ns, message in in_packets(store, left)]
    path = str(ros_bags.write_bag(tmp_path / "a", store, messages))
    first, second = open_source(path), open_source(path, topic="/right/events")
    assert_same(read(first), left)
    assert_same(read(second), right)
    assert (first.name, second.name) == ("a (/left/events, the first of 2 topics with events)", "a (/right/events)")
    with pytest.raises(
        UnknownSource, match="topic '/nowhere' has no events; topics with events are /left/events, /right"
    ):
        open_source(path, topic="/nowhere")


def test_the_error_for_a_bag_without_events_lists_its_topics(tmp_path):
    store = ros_bags.Store(2)
    path = ros_bags.write_bag(tmp_path / "a", store, imu_and_pose(store, 0))
    with pytest.raises(UnknownSource, match=r"no topic has events; it has /cam/imu \(sensor_msgs/Imu\), /cam/pose"):
        open_source(str(path))


@pytest.mark.parametrize("name", ["a.bag", "a.db3", "a.mcap"])
@pytest.mark.parametrize("data", [b"", b"no bag at all, but some text" * 20])
def test_a_file_that_is_not_a_bag_is_rejected(tmp_path, name, data):
    (tmp_path / name).write_bytes(data)
    with pytest.raises(UnknownSource):
        open_source(str(tmp_path / name))


# --- damage between chunks of a file without an index -----------------------------------------------------------------


def chunks_of_ros1(folder, parts, compression):
    """The bytes of a bag without an index, and where each chunk begins."""
    head, chunks = b"", []
    for i, message in enumerate(parts):
        path = folder / f"{i}.bag"
        ros_bags.write_bag(path, ros_bags.Store(1), [message], compression=compression)
        data = path.read_bytes()
        first = 13 + 8 + sum(struct.unpack_from("<I", data, at)[0] for at in (13,))
        first += struct.unpack_from("<I", data, first - 4)[0]  # after the record of the bag
        size = struct.unpack_from("<I", data, first)[0]
        stop = first + 8 + size + struct.unpack_from("<I", data, first + 4 + size)[0]
        head = head or data[:first].replace(
            b"index_pos=" + data[13:].partition(b"index_pos=")[2][:8], b"index_pos=" + bytes(8)
        )
        chunks.append(data[first:stop])
    starts = np.cumsum([len(head), *map(len, chunks[:-1])]).tolist()
    return head + b"".join(chunks), starts


@pytest.mark.parametrize("compression", ["", "bz2", "lz4"])
def test_after_a_damaged_chunk_of_a_bag_without_an_index_the_next_one_is_found(tmp_path, compression):
    parts = [make_events(400, seed=i, start_us=i * 300_000, duration_us=100_000) for i in range(3)]
    store = ros_bags.Store(1)
    messages = [
        (TOPIC, STAMP_NS + i, ros_bags.packet(store, mono(one, 0), ns=STAMP_NS + i, seq=i, encoding="mono"))
        for i, one in enumerate(parts)
    ]
    data, starts = chunks_of_ros1(tmp_path, messages, compression)
    (tmp_path / "a.bag").write_bytes(data)
    assert_same(read(open_source(str(tmp_path / "a.bag"))), Events.join(parts))
    damaged = bytearray(data)
    damaged[starts[1] : starts[1] + 12] = b"\xff" * 12
    (tmp_path / "a.bag").write_bytes(damaged)
    recording = open_source(str(tmp_path / "a.bag"))
    assert_same(read(recording), Events.join([parts[0], parts[2]]))
    assert [(fault.reason, fault.where) for fault in recording.faults.found] == [("damaged", f"byte {starts[1]}")]


@pytest.mark.parametrize("compression", ["ZSTD", "LZ4"])
def test_after_a_damaged_chunk_of_an_mcap_file_without_an_index_the_next_one_is_found(tmp_path, compression):
    parts = [make_events(400, seed=i, start_us=i * 300_000, duration_us=100_000) for i in range(4)]
    store, path = ros_bags.Store(2), tmp_path / "a.mcap"
    with path.open("wb") as file:
        kind = mcap.writer.CompressionType[compression]
        writer = mcap.writer.Writer(file, chunk_size=100, compression=kind, index_types=mcap.writer.IndexType.NONE)
        writer.start("ros2", "x")
        schema = writer.register_schema("event_camera_msgs/msg/EventPacket", "ros2msg", b"")
        channel = writer.register_channel(TOPIC, "cdr", schema)
        for i, one in enumerate(parts):
            message = ros_bags.packet(store, mono(one, 0), ns=STAMP_NS, seq=i, encoding="mono")
            writer.add_message(channel, STAMP_NS, store.raw(message), STAMP_NS)
        writer.finish()
    assert_same(read(open_source(str(path))), Events.join(parts))
    data = bytearray(path.read_bytes())
    name = b"\x04\0\0\0zstd" if compression == "ZSTD" else b"\x03\0\0\0lz4"
    second = [match.start() - 37 for match in re.finditer(re.escape(name), data)][1]
    data[second + 1 : second + 9] = b"\xff" * 8  # the length of the record
    path.write_bytes(data)
    recording = open_source(str(path))
    assert_same(read(recording), Events.join([parts[0], parts[2], parts[3]]))
    (fault,) = recording.faults.found
    assert (fault.reason, fault.where) == ("damaged", f"byte {second}")
