"""AEDAT 2.0: a real recording with inertial samples, and small files in the layout of jAER."""

import numpy as np
import pytest

from neurove_core.io import UnknownSource
from neurove_core.sources import open_source
from neurove_protocol import Events, Sensor
from tests.builders import make_events
from tests.recordings import all_samples, assert_same, put, read, read_broken, shared

SCALE = (
    b'#<entry key="ImuGyroScale" value="GyroFullScaleDegPerSec%d"/>\r\n'
    b'#<entry key="ImuAccelScale" value="ImuAccelScaleG%d"/>\r\n'
)


def header(chip: bytes, more: bytes = b"") -> bytes:
    return b"#!AER-DAT2.0\r\n# Timestamps tick is 1 us\r\n# AEChip: eu.seebetter." + chip + b"\r\n" + more


def pairs(address: np.ndarray, t: np.ndarray) -> bytes:
    return np.stack([address, t], axis=1).astype(">u4").tobytes()


def davis(events: Events, sensor: Sensor) -> np.ndarray:
    """Addresses of the events, which count from the lower right corner."""
    _, x, y, p = (column.astype(np.int64) for column in events)
    return (sensor.height - 1 - y) << 22 | (sensor.width - 1 - x) << 12 | p << 11


def imu_words(values: list[int]) -> np.ndarray:
    return np.array([1 << 31 | 3 << 10 | code << 28 | (value & 0xFFFF) << 12 for code, value in enumerate(values)])


def test_the_real_recording_gives_its_known_events_and_samples():
    recording = open_source(str(shared("aedat2/IMU_translBoxes.aedat")))
    events = read(recording)
    assert recording.streams == ("events", "imu")
    assert (recording.sensor, events.n) == (Sensor(240, 180), 162_771)
    assert (events.t[-1] - events.t[0]) / 1e6 == pytest.approx(2.073, abs=1e-3)
    imu = all_samples(recording)
    assert imu.t.size == 4833
    assert 1e6 * (imu.t.size - 1) / (imu.t[-1] - imu.t[0]) == pytest.approx(2463, rel=0.06)
    # the camera is nearly upright: the specific force is about g upwards, which is -y in the image
    assert imu.accel_m_s2.mean(0)[1] == pytest.approx(-9.9, abs=0.2)
    np.testing.assert_allclose(np.degrees(imu.gyro_rad_s.mean(0)), (3.50, -4.89, 0.30), atol=0.01)


@pytest.mark.parametrize(("chip", "sensor"), [(b"DAVIS240C", Sensor(240, 180)), (b"Davis346blue", Sensor(346, 260))])
def test_events_of_a_davis_are_read_between_words_of_other_types(chip, sensor, tmp_path):
    events = make_events(500, seed=1, sensor=sensor)
    other = np.array([1 << 31 | 5, 1 << 10])  # a pixel of a frame, an edge on the camera's input
    address = np.insert(davis(events, sensor), [0, 100], other)
    t = np.insert(events.t, [0, 100], [0, events.t[100]])
    recording = open_source(put(tmp_path, "a.aedat", header(chip) + pairs(address, t)))
    assert recording.sensor == sensor
    assert_same(read(recording), events)
    assert not list(recording.imu())


def test_on_events_of_a_dvs128_have_a_clear_polarity_bit(tmp_path):
    sensor = Sensor(128, 128)
    events = make_events(500, seed=1, sensor=sensor)
    t, x, y, p = (column.astype(np.int64) for column in events)
    data = header(b"DVS128") + pairs((127 - y) << 8 | (127 - x) << 1 | 1 - p, t)
    recording = open_source(put(tmp_path, "a.aedat", data))
    assert_same(read(recording), events)
    assert recording.streams == ("events",)


def test_samples_are_scaled_to_si_by_the_header_and_in_the_camera_frame(tmp_path):
    words = imu_words([4096, -4096, 2048, 0, 655, 1310, -655])
    data = header(b"DAVIS240C", SCALE % (500, 8)) + pairs(words, np.full(7, 1234))
    imu = all_samples(open_source(put(tmp_path, "a.aedat", data)))
    assert imu.t.tolist() == [1234]
    np.testing.assert_allclose(imu.accel_m_s2, [[-9.80665, -9.80665, -9.80665 / 2]])
    np.testing.assert_allclose(np.degrees(imu.gyro_rad_s), [[-10, 20, 10]])


def test_an_incomplete_sample_is_skipped(tmp_path):
    sample = imu_words([1, 2, 3, 4, 5, 6, 7])
    words = np.concatenate([sample[3:], sample, sample[:4], sample, sample[:6]])
    data = header(b"DAVIS240C", SCALE % (1000, 8)) + pairs(words, np.arange(words.size))
    assert all_samples(open_source(put(tmp_path, "a.aedat", data))).t.tolist() == [4, 15]


@pytest.mark.parametrize("more", [b"", SCALE % (1000, 3), SCALE % (1000, 8) + SCALE % (250, 8)])
def test_samples_without_a_scale_are_not_given_and_events_are_still_read(more, tmp_path):
    data = header(b"DAVIS240C", more) + pairs(imu_words([1, 2, 3, 4, 5, 6, 7]), np.arange(7))
    recording = open_source(put(tmp_path, "a.aedat", data))
    assert read(recording).n == 0
    assert not list(recording.imu())
    assert "ImuGyroScale" in recording.faults.unread[0].why


def test_the_clock_is_unwrapped(tmp_path):
    t = np.array([(1 << 32) - 2, (1 << 32) - 1, 1])
    events = Events.from_columns(t, [1, 2, 3], [4, 5, 6], [0, 1, 0])
    data = header(b"DAVIS240C") + pairs(davis(events, Sensor(240, 180)), t)
    assert read(open_source(put(tmp_path, "a.aedat", data))).t.tolist() == [*t[:2].tolist(), (1 << 32) + 1]


@pytest.mark.parametrize(
    ("last", "t", "why"),
    [
        (200 << 22, 9, "y=-21 lies outside the sensor 240x180"),
        (1 << 22 | 300 << 12, 9, "outside the sensor"),
        (1 << 22, 2, "after t=3 us"),
    ],
)
def test_a_bad_pair_is_skipped_and_counted_with_its_byte(last, t, why, tmp_path):
    head = header(b"DAVIS240C")
    data = head + pairs(np.array([1 << 22, 1 << 31, last, 1 << 22]), np.array([3, 4, t, 20]))
    events, error = read_broken(open_source(put(tmp_path, "a.aedat", data)))
    assert events.t.tolist() == [3, 20]
    assert error is not None
    assert error.details["where"] == f"byte {len(head) + 16}"
    assert why in error.message


def test_old_events_before_the_clock_of_the_recording_are_discarded(tmp_path):
    n = 400
    t = np.arange(n) * 100
    t[:10] += 500_000_000
    recording = open_source(put(tmp_path, "a.aedat", header(b"DAVIS240C") + pairs(np.full(n, 1 << 22), t)))
    assert read(recording).t.tolist() == t[10:].tolist()
    (fault,) = recording.faults.found
    assert (fault.reason, fault.count) == ("stale_start", 10)


def test_without_a_chip_in_the_header_the_sensor_selects_the_layout(tmp_path):
    sensor = Sensor(346, 260)
    events = make_events(100, seed=2, sensor=sensor)
    path = put(tmp_path, "a.aedat", b"#!AER-DAT2.0\r\n# tick is 1 us\r\n" + pairs(davis(events, sensor), events.t))
    assert_same(read(open_source(path, sensor)), events)
    with pytest.raises(UnknownSource, match="give --sensor WIDTHxHEIGHT: the size selects the chip: DAVIS240 240x180"):
        open_source(path)
    with pytest.raises(UnknownSource, match="--sensor 640x480 is none of them"):
        open_source(path, Sensor(640, 480))


def test_a_truncated_pair_is_reported_after_the_complete_pairs(tmp_path):
    head = header(b"DAVIS240C")
    events, error = read_broken(
        open_source(put(tmp_path, "a.aedat", head + pairs(np.full(3, 1 << 22), np.arange(3))[:-3]))
    )
    assert events.n == 2
    assert error is not None
    assert error.details["where"] == f"byte {len(head) + 16}"


@pytest.mark.parametrize(
    ("head", "why"),
    [
        (header(b"CochleaAMS1c"), "its chip is 'CochleaAMS1c'"),
        (b"#!AER-DAT2.0\r\n", "has no AEChip"),
        (b"#!AER-DAT1.0\r\n", "does not begin with the AEDAT 2.0 signature"),
    ],
)
def test_an_unknown_chip_or_version_is_refused(head, why, tmp_path):
    with pytest.raises(UnknownSource, match=why):
        open_source(put(tmp_path, "a.aedat", head))
