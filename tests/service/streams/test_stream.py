import copy
import itertools
from dataclasses import replace

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from neurove_core.models import bundle
from neurove_core.models.bounds import Bounds
from neurove_core.models.uncertainty import Uncertainty
from neurove_protocol import CameraInfo, Flag, Sensor
from neurove_protocol.errors import InvalidField
from neurove_service.models.change import Rules
from neurove_service.models.slot import ModelSlot
from neurove_service.node.health import stream_status
from neurove_service.streams.intake import Arrival
from neurove_service.streams.stream import Stream
from tests.builders import make_packet, make_packets
from tests.service.conftest import SMALL, arrived

WINDOW_US = 50_000


@pytest.fixture
def stream(slot):
    return Stream("cam0", slot)


def feed(stream, packets):
    return list(itertools.chain.from_iterable(stream.accept(packet, arrived()) for packet in packets))


def without_trace(estimates):
    return [estimate.model_copy(update={"trace": None, "host": None}) for estimate in estimates]


def flagged(estimates, flag):
    return [estimate.start_us // WINDOW_US for estimate in estimates if flag in estimate.flags]


def test_every_window_gets_one_estimate_and_nothing_is_lost(stream):
    estimates = feed(stream, make_packets(100))
    assert [one.start_us for one in estimates] == list(range(0, 7 * WINDOW_US, WINDOW_US))
    assert [one.seq for one in estimates] == list(range(7))
    assert all(one.bin_end_us == tuple(one.start_us + 10_000 * (i + 1) for i in range(5)) for one in estimates)
    assert stream.counters.losses().nonzero() == {}
    assert stream.counters.events_received == 100 * 100
    assert sum(one.events for one in estimates) == sum(p.events.n for p in make_packets(100)) - tail_events()


def tail_events():
    return sum(int((packet.events.t >= 7 * WINDOW_US).sum()) for packet in make_packets(100))


def test_a_lost_packet_is_counted_and_flags_its_windows(stream):
    packets = make_packets(60)
    estimates = feed(stream, packets[:30] + packets[31:])
    assert stream.counters.losses().nonzero() == {"gap_packets": 1}
    assert flagged(estimates, Flag.GAP) == [30 * 4000 // WINDOW_US]
    assert len(estimates) == 4


def test_a_long_gap_flags_every_window_that_it_overlaps_and_no_other(stream):
    packets = make_packets(80)
    estimates = feed(stream, packets[:20] + packets[50:])  # 80 ms to 200 ms are missing
    assert flagged(estimates, Flag.GAP) == [1, 2, 3]
    assert stream.counters.gap_packets == 30


def test_packets_dropped_by_the_queue_count_as_overload_and_not_as_a_gap(stream):
    packets = make_packets(60)
    estimates = feed(stream, packets[:30])
    stream.overloaded(5)
    estimates += feed(stream, packets[35:])
    assert stream.counters.losses().nonzero() == {"overload_packets": 5}
    assert flagged(estimates, Flag.OVERLOAD) == flagged(estimates, Flag.GAP) == [2]


def test_a_malformed_packet_does_not_also_count_as_a_gap(stream):
    packets = make_packets(60)
    feed(stream, packets[:30])
    stream.refused(1)
    feed(stream, packets[31:])
    assert stream.counters.losses().nonzero() == {"malformed_packets": 1}


def test_duplicate_and_late_packets_are_counted_and_change_nothing(slot):
    packets = make_packets(60)
    clean = feed(Stream("cam0", slot), packets)
    disturbed = Stream("cam0", slot)
    estimates = feed(disturbed, [*packets[:30], packets[29], packets[10], *packets[30:]])
    assert without_trace(estimates) == without_trace(clean)
    assert disturbed.counters.losses().nonzero() == {"duplicate_packets": 2}


@given(st.lists(st.integers(0, 39), min_size=0, max_size=30, unique=True), st.randoms(use_true_random=False))
def test_every_sent_packet_is_counted(dropped, random):
    stream = Stream("cam0", _slot())
    kept = [packet for packet in make_packets(41, step_us=8000) if packet.seq not in dropped]
    repeats = random.sample(kept, min(3, len(kept)))
    for packet in kept:
        feed(stream, [packet, packet] if packet in repeats and packet.seq else [packet])
    counters = stream.counters
    assert counters.duplicate_packets == sum(1 for packet in repeats if packet.seq)
    first = min(packet.seq for packet in kept)
    assert counters.packets_received - counters.duplicate_packets + counters.gap_packets == 41 - first


_SLOTS: list = []


def _slot():
    if not _SLOTS:
        from neurove_service.models.slot import ModelSlot

        _SLOTS.append(ModelSlot("untrained"))
    return _SLOTS[0]


def test_a_restarted_driver_resets_the_stream_at_once(stream):
    feed(stream, make_packets(30))
    estimates = feed(stream, make_packets(30, start_us=10_000_000))
    assert estimates[0].start_us == 10_000_000
    assert Flag.RESET in estimates[0].flags
    assert stream.counters.losses().nonzero() == {"restart_windows": 1}
    assert stream.counters.resets == 1


def test_a_restarted_driver_whose_first_packet_was_lost_is_accepted_after_three_packets(stream):
    feed(stream, make_packets(30))
    estimates = feed(stream, make_packets(40, start_us=10_000_000)[1:])
    assert estimates
    assert stream.counters.out_of_order_packets == 2


def test_a_sensor_clock_that_goes_backwards_resets_the_stream(stream):
    feed(stream, make_packets(30, start_us=50_000_000))
    estimates = feed(stream, make_packets(30, first_seq=30))
    assert [one.start_us for one in estimates] == [0, WINDOW_US]
    assert Flag.RESET in estimates[0].flags


def test_another_sensor_size_resets_and_flags_the_next_estimate(stream):
    feed(stream, make_packets(30))
    estimates = feed(stream, make_packets(40, first_seq=30, start_us=120_000, sensor=Sensor(80, 60)))
    assert Flag.SENSOR_CHANGED in estimates[0].flags
    assert Flag.RESET in estimates[0].flags
    assert Flag.SENSOR_CHANGED not in estimates[1].flags
    assert stream.sensor == Sensor(80, 60)


def test_camera_info_calibrates_from_the_next_packet_on(stream):
    camera = CameraInfo(stream="cam0", width=64, height=48, lens="pinhole", fx=40, fy=40, cx=32, cy=24, height_m=1.0)
    before = feed(stream, make_packets(30))
    stream.set_camera(camera)
    stream.set_camera(camera)
    after = feed(stream, make_packets(40, first_seq=30, start_us=120_000))
    assert all({Flag.UNCALIBRATED, Flag.UNSCALED} <= set(one.flags) for one in before)
    assert not any({Flag.UNCALIBRATED, Flag.UNSCALED} & set(one.flags) for one in after)
    assert flagged(after, Flag.SENSOR_CHANGED) == [after[0].start_us // WINDOW_US]
    assert stream.counters.resets == 1


def test_camera_info_of_another_sensor_is_not_used(stream):
    stream.set_camera(CameraInfo(stream="cam0", width=9, height=9, lens="pinhole", fx=40, fy=40, cx=4, cy=4))
    assert all(Flag.UNCALIBRATED in one.flags for one in feed(stream, make_packets(30)))


def test_a_gap_in_sensor_time_without_lost_packets_skips_and_counts_windows(stream):
    feed(stream, make_packets(30))
    estimates = feed(stream, make_packets(30, first_seq=30, start_us=10_000_000))
    assert stream.counters.skipped_windows == (10_000_000 - 150_000) // WINDOW_US
    assert Flag.RESET in estimates[1].flags
    assert estimates[1].start_us == 10_000_000


def test_a_model_change_takes_effect_at_a_window_with_a_primed_state(slot):
    packets = make_packets(100)
    always_two = Stream("cam0", _at(slot, "two"))
    expected = feed(always_two, packets)
    slot.activate("one")
    stream = Stream("cam0", slot)
    estimates = feed(stream, packets[:50])
    slot.activate("two")
    estimates += feed(stream, packets[50:])
    assert [one.model for one in estimates] == ["one"] * 3 + ["two"] * 4
    assert [one.start_us for one in estimates] == [one.start_us for one in expected]
    assert [one.twists for one in estimates[3:]] == [one.twists for one in expected[3:]]  # as if it had always served
    assert len({one.epoch for one in estimates}) == 2


def _at(slot, model):
    slot.activate(model)
    return slot


def test_streams_do_not_leak_state_into_each_other(slot):
    a, b = make_packets(60), make_packets(60, first_seq=1000)
    alone = feed(Stream("cam0", slot), a)
    together, other = Stream("cam0", slot), Stream("cam0", slot)
    mixed = []
    for one, two in zip(a, b, strict=True):
        mixed += feed(together, [one])
        feed(other, [two])
    assert without_trace(mixed) == without_trace(alone)


def test_a_packet_of_another_stream_is_refused(stream):
    with pytest.raises(InvalidField, match="stream='cam1': received on the key of stream 'cam0'"):
        stream.accept(make_packet(stream="cam1"), arrived())


def test_an_internal_error_loses_one_packet_and_resets_the_stream(stream):
    feed(stream, make_packets(30))
    stream.failed()
    estimates = feed(stream, make_packets(30, first_seq=30, start_us=120_000))
    assert stream.counters.failed_packets == 1
    assert Flag.RESET in estimates[0].flags


def test_few_events_and_a_young_state_are_flagged(stream):
    estimates = feed(stream, make_packets(100, n=0))
    assert all(Flag.LOW_ACTIVITY in one.flags for one in estimates)
    assert flagged(estimates, Flag.SETTLING) == [0, 1, 2, 3]
    assert flagged(estimates, Flag.RESET) == [0]
    assert not any(Flag.UNTRAINED in one.flags for one in estimates)


def test_every_estimate_of_an_untrained_model_is_flagged():
    estimates = feed(Stream("cam0", _slot()), make_packets(40))
    assert estimates
    assert all(Flag.UNTRAINED in one.flags for one in estimates)


def test_an_estimate_of_a_calibrated_model_has_a_covariance_and_the_flag_uncertain(tmp_path):
    plain = bundle.untrained(1, SMALL, "one")
    network = copy.deepcopy(plain.network)
    network.add_spread()  # sigma is 1 in every axis
    sure, unsure = (
        replace(plain, network=network, uncertainty=Uncertainty(torch.eye(6), bound, "a test")) for bound in (1e6, 1e-6)
    )
    for model, flags in ((sure, []), (unsure, [0, 1, 2, 3])):
        path = tmp_path / "model.safetensors"
        bundle.save(model, path)
        estimates = feed(Stream("cam0", ModelSlot(str(path))), make_packets(60))
        assert flagged(estimates, Flag.UNCERTAIN) == flags
        assert estimates[-1].covariance == tuple(torch.eye(6).flatten().tolist())
        assert estimates[-1].sigma == (1,) * 6
        assert type(estimates[-1]).decode(estimates[-1].encode()) == estimates[-1]


def test_a_nodes_bounds_decide_what_is_uncertain_also_after_a_change_of_the_model(tmp_path):
    for seed, name in ((1, "one"), (2, "two")):
        plain = bundle.untrained(seed, SMALL, name)
        network = copy.deepcopy(plain.network)
        network.add_spread()  # sigma is 1 in every axis
        unsure = replace(plain, network=network, uncertainty=Uncertainty(torch.eye(6), 1e-6, "a test"))
        bundle.save(unsure, tmp_path / f"{name}.safetensors")
    slot = ModelSlot("one", tmp_path, Rules(bounds=Bounds(m_s=2.0, rad_s=2.0)))
    for _ in range(2):
        assert flagged(feed(Stream("cam0", slot), make_packets(60)), Flag.UNCERTAIN) == []
        slot.activate("two")


def test_an_estimate_of_a_model_without_calibration_has_no_covariance(stream):
    (newest, *_) = reversed(feed(stream, make_packets(60)))
    assert (newest.covariance, newest.sigma) == (None, None)
    assert Flag.UNCERTAIN not in newest.flags


def test_four_valid_packets_with_absurd_numbers_leave_a_status_that_can_be_sent(stream):
    largest = (1 << 63) - 1
    feed(stream, [make_packet(1, seq=seq, t0_us=4000 * i) for i, seq in enumerate((0, largest, 0, largest))])
    status = stream_status("edge", stream)
    assert type(status).decode(status.encode()) == status
    assert status.lost.gap_packets == 0


def test_absurd_sensor_times_leave_a_status_that_can_be_sent(slot):
    stream = Stream("cam0", slot)
    for seq in range(0, 40, 2):
        feed(stream, [make_packet(1, seq=seq, t0_us=-(1 << 62)), make_packet(1, seq=seq + 1, t0_us=(1 << 62) - 5000)])
    status = stream_status("edge", stream)
    assert type(status).decode(status.encode()) == status


def test_swapped_neighbours_lose_nothing_and_leave_no_flag(slot):
    packets = make_packets(60)
    clean = feed(Stream("cam0", slot), packets)
    disturbed = Stream("cam0", slot)
    packets[6], packets[7] = packets[7], packets[6]
    estimates = feed(disturbed, packets)
    assert without_trace(estimates) == without_trace(clean)
    counters = disturbed.counters
    assert counters.packets_received + counters.gap_packets - counters.recovered_packets == 60
    assert (counters.gap_packets, counters.recovered_packets, counters.out_of_order_packets) == (1, 1, 0)


def test_a_packet_that_arrives_after_its_window_was_answered_is_out_of_order(stream):
    packets = make_packets(60)
    feed(stream, [*packets[:6], *packets[7:30], packets[6]])
    counters = stream.counters
    assert (counters.gap_packets, counters.recovered_packets, counters.out_of_order_packets) == (1, 1, 1)


def test_refused_packets_flag_their_windows(stream):
    estimates = []
    for packet in make_packets(60):
        if packet.seq % 2:
            stream.refused(1, "planted")
        else:
            estimates += feed(stream, [packet])
    assert all(Flag.GAP in one.flags for one in estimates)
    assert stream.counters.losses().nonzero() == {"malformed_packets": 30}


def test_old_packets_are_dropped_counted_and_flagged(slot):
    stream = Stream("cam0", slot, max_age_s=0.5)
    packets = make_packets(200)
    estimates = []
    for packet in packets:
        delay_us = 800_000 if 50 <= packet.seq < 100 else 0
        now_ns = 1000 * (packet.t0_us + 10_000_000 + delay_us)
        estimates += stream.accept(packet, Arrival(now_ns, now_ns))
    assert stream.counters.losses().nonzero() == {"stale_packets": 50}
    assert flagged(estimates, Flag.GAP) == [3, 4, 5, 6, 7]  # the newest event before it was in window 3


def test_the_age_is_that_of_the_window_and_late_estimates_are_flagged(slot):
    clock = [0]
    stream = Stream("cam0", slot, lambda: clock[0], node="rover-1", max_age_s=1.0)
    estimates = []
    for packet in make_packets(200):
        delay_us = 300_000 if packet.seq >= 100 else 0
        clock[0] = 1000 * (int(packet.events.t[-1]) + 10_000_000 + delay_us)
        estimates += stream.accept(packet, Arrival(clock[0], clock[0]))
    assert flagged(estimates, Flag.LATE) == list(range(7, 15))  # a delayed packet completed window 7
    assert {one.node for one in estimates} == {"rover-1"}
    ages = [one.host.age_ns for one in estimates]
    assert max(ages[:7]) < 10_000_000 * 2
    assert min(ages[8:]) >= 300_000_000


def test_a_replay_that_is_slower_than_real_time_is_not_old(slot):
    stream = Stream("cam0", slot, max_age_s=0.5)
    for packet in make_packets(200):
        now_us = 10 * packet.t0_us + 1_000_000
        stream.accept(packet, Arrival(1000 * (now_us + 50), 1000 * (now_us + 50), now_us))
    assert stream.counters.losses().nonzero() == {}


def test_a_camera_that_repeats_its_events_is_frozen(slot):
    stream = Stream("cam0", slot)
    first = make_packets(50)
    hung = [
        replace(
            first[40 + i % 5],
            seq=50 + i,
            t0_us=(50 + i) * 4000,
            events=first[40 + i % 5].events._replace(t=first[40 + i % 5].events.t + (10 + i - i % 5) * 4000),
        )
        for i in range(50)
    ]
    estimates = feed(stream, first + hung)
    frozen = flagged(estimates, Flag.FROZEN)
    assert frozen == list(range(frozen[0], 7))
    assert frozen[0] in (4, 5)


def test_two_drivers_on_one_stream_are_counted_apart_and_one_is_answered(slot):
    stream = Stream("cam0", slot)
    first = make_packets(100, first_seq=1000)
    second = make_packets(100, first_seq=5, start_us=33)
    mixed = [packet for pair in zip(first, second, strict=True) for packet in pair]
    feed(stream, mixed)
    counters = stream.counters
    assert counters.foreign_packets + counters.out_of_order_packets == 100
    assert counters.out_of_order_packets <= 2
    assert counters.resets == 0


def test_a_driver_that_never_counts_is_answered(slot):
    clean = feed(Stream("cam0", slot), make_packets(60))
    stream = Stream("cam0", slot)
    estimates = feed(stream, [replace(packet, seq=0) for packet in make_packets(60)])
    assert without_trace(estimates) == without_trace(clean)
    assert (stream.counters.uncounted_packets, stream.counters.resets) == (59, 0)


def test_a_camera_info_of_another_size_is_told(stream):
    stream.set_camera(CameraInfo(stream="cam0", width=9, height=9, lens="pinhole", fx=40, fy=40, cx=4, cy=4))
    feed(stream, make_packets(3))
    assert stream.activity.refusal == "the camera info is for 9x9, the stream sends 64x48"
    assert stream.counters.refused_cameras == 1


def test_a_missing_packet_that_arrives_seconds_later_is_no_new_clock(stream):
    packets = make_packets(600)
    feed(stream, [*packets[:6], *packets[7:], packets[6]])
    counters = stream.counters
    assert (counters.recovered_packets, counters.out_of_order_packets, counters.resets) == (1, 1, 0)


def test_a_missing_number_with_another_sensor_is_not_counted_into_the_window(stream):
    packets = make_packets(10)
    wrong = replace(make_packet(seq=6, t0_us=packets[6].t0_us, sensor=Sensor(640, 480)))
    feed(stream, [*packets[:6], packets[7], wrong, *packets[8:]])
    counters = stream.counters
    assert (counters.recovered_packets, counters.out_of_order_packets, counters.resets) == (1, 1, 0)
    assert stream.sensor == packets[0].sensor
