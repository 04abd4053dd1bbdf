"""Events and samples of a live source are valid, and its time advances while nothing arrives."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from neurove_core.io.faults import Reason, Tally
from neurove_core.live.order import RESTART_US, ImuOrder, LiveOrder
from neurove_core.live.source import QuietClock
from neurove_protocol import Events, Sensor
from neurove_protocol.imu import Imu

SENSOR = Sensor(64, 48)


def at(*times, x=1, y=1):
    n = len(times)
    return Events(np.array(times, np.int64), np.full(n, x, np.int32), np.full(n, y, np.int32), np.ones(n, np.uint8))


def counts(tally):
    return {fault.reason: fault.count for fault in tally.faults}


@given(st.lists(st.lists(st.integers(0, RESTART_US), max_size=6), max_size=6))
def test_what_passes_never_runs_backwards_and_the_rest_is_counted(batches):
    tally = Tally("events")
    order = LiveOrder(SENSOR, tally)
    passed = [int(t) for batch in batches for t in order.take(at(*batch)).events.t]
    given_times = [t for batch in batches for t in batch]
    assert passed == sorted(passed)
    assert passed == [t for i, t in enumerate(given_times) if t >= max(given_times[: i + 1])]
    assert len(passed) + counts(tally).get(Reason.LATE, 0) == len(given_times)


def test_ordered_events_pass_whole():
    order = LiveOrder(SENSOR, Tally("events"))
    taken = order.take(at(1, 2, 2, 9))
    assert taken.events.t.tolist() == [1, 2, 2, 9]
    assert not taken.restarted
    assert order.last_us == 9


@pytest.mark.parametrize(("x", "y"), [(64, 0), (0, 48), (-1, 0), (0, -5)])
def test_events_outside_the_sensor_are_counted(x, y):
    tally = Tally("events")
    order = LiveOrder(SENSOR, tally)
    assert order.take(at(1, 2, x=x, y=y)).events.n == 0
    assert counts(tally) == {Reason.OUTSIDE: 2}


@pytest.mark.parametrize("t_us", [-1, 1 << 62])
def test_a_time_that_no_packet_can_hold_is_counted(t_us):
    tally = Tally("events")
    assert LiveOrder(SENSOR, tally).take(at(t_us)).events.n == 0
    assert counts(tally) == {Reason.OUTSIDE: 1}


def test_a_clock_that_begins_again_is_followed():
    order = LiveOrder(SENSOR, Tally("events"))
    order.take(at(5 * RESTART_US))
    taken = order.take(at(3, 4))
    assert taken.restarted
    assert taken.events.t.tolist() == [3, 4]
    assert not order.take(at(5)).restarted


def test_a_tick_is_given_once_and_events_before_it_are_late():
    tally = Tally("events")
    order = LiveOrder(SENSOR, tally)
    order.take(at(100))
    assert order.tick(None) is None
    assert order.tick(100) is None
    assert order.tick(150) == 150
    assert order.tick(150) is None
    assert order.take(at(149, 150)).events.t.tolist() == [150]
    assert counts(tally) == {Reason.LATE: 1}


def test_samples_out_of_bounds_or_late_are_counted():
    tally = Tally("imu")
    order = ImuOrder(tally)
    t = np.array([10, 20, 15, 30], np.int64)
    accel = np.array([[0, 0, 9.8], [np.nan, 0, 0], [0, 0, 9.8], [0, 0, 9.8]])
    kept = order.take(Imu(t, accel, np.zeros((4, 3))))
    assert kept.t.tolist() == [10, 30]
    assert counts(tally) == {Reason.INVALID: 2}


class TestQuietClock:
    def test_the_time_advances_after_the_longest_delay(self):
        now = [100.0]
        quiet = QuietClock(0.05, clock=lambda: now[0])
        assert quiet.now_us() is None
        quiet.arrived(1_000_000)
        now[0] += 0.05
        assert quiet.now_us() is None
        now[0] += 0.25
        assert quiet.now_us() == pytest.approx(1_250_000, abs=1)

    def test_nothing_is_known_after_a_loss(self):
        now = [0.0]
        quiet = QuietClock(0.0, clock=lambda: now[0])
        quiet.arrived(5)
        quiet.stop()
        now[0] += 10
        assert quiet.now_us() is None
