"""Inertial samples in step with events: each once, in time, for any batches, in a loop too."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from neurove_core.io import Imu
from neurove_core.io.axes import with_axes
from neurove_core.io.formats.packet_log.writer import write_mcap
from neurove_core.io.imu_feed import ImuFeed, Turn
from neurove_core.io.recording import EventsOnly
from neurove_core.sources import open_source
from neurove_protocol import Sensor
from neurove_protocol.errors import InvalidField
from neurove_protocol.imu import MAX_SAMPLES, decode_imu
from tests.builders import make_events
from tests.datasets import make_imu
from tests.recordings import all_samples


class Recorded(EventsOnly):
    """Events at 0 to 100 ms, and these samples in batches of this size."""

    def __init__(self, imu: Imu, size: int = 7) -> None:
        self.samples, self.size = imu, size
        self.name, self.sensor, self.endless = "recorded", Sensor(64, 48), False

    @property
    def streams(self):
        return ("events", "imu")

    def chunks(self):
        yield make_events(500, seed=1, duration_us=100_000)

    def imu(self):
        for first in range(0, self.samples.n, self.size):
            yield self.samples.span(first, min(first + self.size, self.samples.n))


@given(st.integers(1, 60), st.lists(st.integers(-5_000, 60_000), max_size=12))
def test_every_sample_comes_once_and_before_the_time_that_was_asked_for(size, times):
    imu = make_imu(50, seed=1)
    feed, parts = ImuFeed(Recorded(imu, size)), []
    for t_us in [*sorted(times), 1_000_000]:
        part = feed.until(t_us)
        assert (part.t < t_us).all()
        parts.append(part)
    for name in Imu._fields:
        np.testing.assert_array_equal(np.concatenate([getattr(part, name) for part in parts]), getattr(imu, name))


def test_samples_long_before_the_events_do_not_make_a_packet_too_large():
    imu = make_imu(3 * MAX_SAMPLES)
    part = ImuFeed(Recorded(imu, 1000)).until(1 << 60)
    np.testing.assert_array_equal(part.t, imu.t[-MAX_SAMPLES:])


def test_a_sample_that_no_packet_may_hold_is_left_out():
    imu = make_imu(20)
    imu.gyro_rad_s[3, 1], imu.accel_m_s2[5, 0] = 2e3, -2e4
    part = ImuFeed(Recorded(imu)).until(1 << 60)
    assert part.t.tolist() == np.delete(imu.t, (3, 5)).tolist()


def test_in_a_loop_the_samples_of_each_turn_follow_its_events():
    turns = [Turn(0, 0)]
    feed = ImuFeed(Recorded(make_imu(30, step_us=5_000)), turns)  # to 145 ms, where the next turn has begun
    first = feed.until(100_000)
    turns.append(Turn(100_000, 100_000))
    second = feed.until(200_000)
    np.testing.assert_array_equal(first.t, np.arange(0, 100_000, 5_000))
    np.testing.assert_array_equal(second.t, np.arange(100_000, 200_000, 5_000))
    np.testing.assert_array_equal(second.gyro_rad_s, first.gyro_rad_s)


def test_a_converted_recording_holds_published_packets_in_step_with_the_events(tmp_path: Path):
    pytest.importorskip("mcap")
    imu = make_imu(90)
    write_mcap(Recorded(imu), tmp_path / "a.mcap", "left")
    recording = open_source(str(tmp_path / "a.mcap"))
    again = all_samples(recording)
    for name in Imu._fields:
        np.testing.assert_array_equal(getattr(again, name), getattr(imu, name))
    kinds, packets, newest_us = [], [], 0
    for message in recording.driven():
        kinds.append(message.kind)
        if message.kind == "imu":
            packets.append(decode_imu(message.payload))
            assert packets[-1].stream == message.stream == "left"
            assert packets[-1].samples.t[0] >= newest_us - 8_000
        newest_us = message.log_ns // 1000
    assert [packet.seq for packet in packets] == list(range(len(packets)))
    assert kinds[0] == "imu"  # before the events of its time
    assert kinds.index("events") < len(packets)


def test_axes_of_another_mounting_are_rotated_and_what_is_no_rotation_is_refused():
    imu = make_imu(20)
    (turned,) = with_axes(Recorded(imu, 20), "-y,x,z").imu()
    np.testing.assert_array_equal(turned.gyro_rad_s, imu.gyro_rad_s[:, (1, 0, 2)] * (-1, 1, 1))
    np.testing.assert_array_equal(turned.accel_m_s2, imu.accel_m_s2[:, (1, 0, 2)] * (-1, 1, 1))
    for wrong in ("x,y", "x,y,y", "-x,y,z", "x,z,y", "x,y,w", ""):
        with pytest.raises(InvalidField, match="axes"):
            with_axes(Recorded(imu), wrong)
    with pytest.raises(InvalidField, match="no inertial samples"):
        with_axes(open_source("pattern://"), "-x,y,-z")
