"""The inertial unit of a stream in the service: what a consumer and an operator see."""

import time

import numpy as np
import pytest

from neurove_core import carried
from neurove_core.stream_state import WindowEstimate
from neurove_protocol import ImuPacket
from neurove_protocol.events import PacketLimits
from neurove_protocol.imu import encode_imu
from neurove_service.cli.inertial_text import imu_text
from neurove_service.guard import Guard
from neurove_service.node.health import stream_status
from neurove_service.streams import inertial
from neurove_service.streams.history import RingSize
from neurove_service.streams.inertial import Inertial
from neurove_service.streams.registry import StreamRegistry, StreamSettings
from neurove_service.streams.stream import Stream
from neurove_service.streams.worker import Inbox, Sample
from tests.builders import SENSOR, make_packets
from tests.neurove_core.inertial import units
from tests.service.conftest import arrived


def imu_packets(imu, size=4, stream="cam0", first_seq=0):
    """The samples as a driver sends them."""
    return [
        encode_imu(ImuPacket(stream, first_seq + number, imu.span(first, min(first + size, imu.n))))
        for number, first in enumerate(range(0, imu.n, size))
    ]


@pytest.fixture
def stream(slot):
    return Stream("cam0", slot)


def feed(stream, packets, inertial=(), received_ns=0):
    """Everything in the order of a driver: the samples up to the end of an event packet before it."""
    waiting = list(inertial)
    found = []
    for packet in packets:
        for payload in waiting[:1]:
            stream.inertial.accept(payload, received_ns or time.monotonic_ns())
        waiting = waiting[1:]
        found += stream.accept(packet, arrived())
    return found


def test_the_gyroscope_gives_the_angular_part_and_the_estimate_says_so(stream):
    imu = units.samples(units.shaking, 0.5)
    estimates = feed(stream, make_packets(100), imu_packets(imu, size=2))
    assert [one.source for one in estimates] == ["gyro"] * 7
    times = np.array([[one.start_us + 10_000 * k + 5_000 for k in range(5)] for one in estimates]).ravel() / 1e6
    found = [twist[3:] for one in estimates for twist in one.twists]
    np.testing.assert_allclose(found, units.shaking(times), atol=0.02)


def test_a_stream_without_a_unit_loses_nothing(slot, stream):
    plain = feed(stream, make_packets(100))
    assert {one.source for one in plain} == {"network"}
    assert stream_status("n1", stream).imu is None


def test_an_error_of_the_stage_leaves_the_answer_of_the_events_and_is_counted(slot, monkeypatch):
    guard = Guard()
    stream = Stream("cam0", slot, guard=guard)
    monkeypatch.setattr(inertial, "aided", lambda *_: 1 / 0)
    estimates = feed(stream, make_packets(100), imu_packets(units.samples(units.shaking, 0.5), size=2))
    assert [(one.seq, one.source) for one in estimates] == [(number, "network") for number in range(7)]
    assert guard.counts == {"gyroscope": 7}
    assert (stream.counters.resets, stream.counters.losses().nonzero()) == (0, {})


def test_packets_that_are_refused_or_lost_are_counted_and_the_events_are_unharmed(slot, stream):
    imu = units.samples(units.shaking, 0.5)
    payloads = imu_packets(imu, size=2)
    payloads[3], payloads[5] = b"nonsense", encode_imu(ImuPacket("other", 5, imu.span(10, 12)))
    estimates = feed(stream, make_packets(100), [*payloads[:20], *payloads[22:]])
    assert len(estimates) == 7
    assert stream.counters.losses().nonzero() == {}
    unit = stream_status("n1", stream).imu
    assert (unit.refused_packets, unit.lost_packets, unit.samples) == (2, 4, 2 * 98)


def test_samples_that_stop_leave_the_estimate_to_the_events_and_the_status_says_so(slot):
    clock = [0]
    stream = Stream("cam0", slot, lambda: clock[0])
    payloads = imu_packets(units.samples(units.shaking, 0.5), size=2)
    estimates = feed(stream, make_packets(100), payloads[:50], received_ns=1)
    assert (estimates[0].source, estimates[-1].source) == ("gyro", "network")
    assert "no samples at the time of the newest window" in stream.inertial.status().problem
    clock[0] = 3_000_000_000
    assert stream.inertial.status().problem == "no packet for 3.0 s"
    assert stream.inertial.status().rate_hz == 0
    assert imu_text(stream.inertial.status()).endswith("the estimates use the events alone")


def test_a_unit_on_another_clock_is_told(stream):
    feed(stream, make_packets(100), imu_packets(units.samples(units.shaking, 0.5, start_us=60_000_000), size=2))
    assert "s after the events: its clock is not that of the camera" in stream.inertial.status().problem


def aided(unit, estimator, imu, seen, windows, *, speed=0.0, first=0):
    """The estimates of consecutive windows whose events show the motion `seen`, with these samples."""
    at, found = int(imu.t.searchsorted(50_000 * first + 4_000)) if first else 0, []
    for seq, end_us in enumerate(range(50_000 * (first + 1), 50_000 * (windows + 1), 50_000), first):
        stop = int(imu.t.searchsorted(end_us + 4_000))
        unit.accept(encode_imu(ImuPacket("cam0", seq, imu.span(at, stop))), time.monotonic_ns())
        at = stop
        window = units.window(end_us - 50_000, seen, speed=speed)
        estimate = WindowEstimate(
            end_us - 50_000, end_us, window.twists, 1000, False, True, False, False, window.covariance, source="refined"
        )
        found += unit.aid([estimate], estimator, None)
    return found


def test_the_status_has_rate_and_bias_after_a_rest_in_words(slot):
    unit = Inertial("cam0", time.monotonic_ns)
    imu = units.samples(units.still, 2.1, rate_hz=1000, bias=(0.01, -0.02, 0.005))
    assert unit.status() is None
    aided(unit, slot.active.estimator, imu, units.still, 5)
    assert "bias not known before the first rest" in imu_text(unit.status())
    unit = Inertial("cam0", time.monotonic_ns)
    found = aided(unit, slot.active.estimator, imu, units.still, 40)
    status = unit.status()
    assert status.rate_hz == pytest.approx(1000)
    np.testing.assert_allclose(status.bias_rad_s, (0.01, -0.02, 0.005), atol=1e-3)
    assert (status.used, status.resting, status.problem) == (True, True, "")
    assert imu_text(status).startswith("inertial unit 1,000 Hz, gyroscope bias +0.0")
    assert imu_text(status).endswith("; the camera rests")
    assert not found[-1].twists.any()


def test_a_gyroscope_that_disagrees_is_flagged_told_and_not_used(slot):
    unit = Inertial("cam0", time.monotonic_ns)
    imu = units.samples(lambda t_s: -units.shaking(t_s), 6.1)
    found = aided(unit, slot.active.estimator, imu, units.shaking, 120, speed=1.0)
    assert (found[1].source, found[1].gyro_disagrees) == ("gyro", False)
    assert (found[-1].source, found[-1].gyro_disagrees) == ("refined", True)
    status = unit.status()
    assert status.disagrees
    assert imu_text(status).startswith("gyroscope disagrees with the events: the gyroscope turns the other way about")
    assert imu_text(status).endswith("the estimates use the events alone")


def still_then_shaking(t_s):
    return np.where(np.asarray(t_s)[..., None] < 2.0, units.still(t_s), units.shaking(t_s))


def test_a_node_that_takes_the_state_goes_on_with_the_bias_bit_for_bit(slot):
    estimator, imu = slot.active.estimator, units.samples(still_then_shaking, 6.1, bias=(0.01, -0.02, 0.005))
    leader, follower, cold = (Inertial("cam0", time.monotonic_ns) for _ in range(3))
    aided(leader, estimator, imu, still_then_shaking, 80, speed=1.0)
    for unit in (follower, cold):  # they join after the rest
        aided(unit, estimator, imu, still_then_shaking, 80, speed=1.0, first=45)
    state = estimator.initial_state(SENSOR)._replace(end_us=50_000 * 80)
    taken = carried.decode(carried.encode(state, leader.learned), state)
    follower.adopt(50_000 * 80, taken.inertial)
    wanted, got, other = (
        aided(unit, estimator, imu, still_then_shaking, 120, speed=1.0, first=80) for unit in (leader, follower, cold)
    )
    assert [one.twists.tobytes() for one in got] == [one.twists.tobytes() for one in wanted]
    assert [one.covariance.tobytes() for one in got] == [one.covariance.tobytes() for one in wanted]
    assert other[-1].twists.tobytes() != wanted[-1].twists.tobytes()
    assert (follower.status().bias_rad_s, follower.status().offset_ms) == (
        leader.status().bias_rad_s,
        leader.status().offset_ms,
    )


def test_a_state_that_is_taken_too_late_changes_nothing(slot):
    estimator, imu = slot.active.estimator, units.samples(units.shaking, 2.1, bias=(0.01, -0.02, 0.005))
    one, two = (Inertial("cam0", time.monotonic_ns) for _ in range(2))
    aided(one, estimator, imu, units.shaking, 20, speed=1.0)
    two.adopt(50_000, one.learned)
    found = aided(two, estimator, imu, units.shaking, 30, speed=1.0, first=20)
    plain = aided(Inertial("cam0", time.monotonic_ns), estimator, imu, units.shaking, 30, speed=1.0, first=20)
    assert [x.twists.tobytes() for x in found] == [x.twists.tobytes() for x in plain]


def test_the_queue_of_samples_is_bounded_and_counts_what_it_drops():
    inbox = Inbox(max_age_s=1, max_bytes=1 << 20)
    for number in range(3000):
        inbox.put_imu(Sample(number.to_bytes(2, "big"), 0, is_camera=False))
    samples, dropped = inbox.take_imu()
    assert dropped == 3000 - len(samples) > 0
    assert int.from_bytes(samples[-1].payload, "big") == 2999
    assert inbox.take_imu()[1] == 0
    assert not inbox.take_all(0)[0]


def test_samples_alone_start_no_stream(slot):
    settings = StreamSettings(4, 30, 1, 1 << 20, RingSize(), PacketLimits())
    registry = StreamRegistry(slot, settings, lambda _: None)
    for payload in imu_packets(units.samples(units.still, 0.1)):
        registry.put_imu("cam0", payload, 0)
    assert registry.streams() == []
