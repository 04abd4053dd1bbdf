import threading
import time
from dataclasses import replace

import pytest

from neurove_core.ingest.wire import read_packet
from neurove_protocol import CameraInfo, Flag, TwistEstimate
from neurove_protocol.errors import Malformed
from neurove_protocol.events import PacketLimits, encode_packet
from neurove_service.streams.intake import Arrival
from neurove_service.streams.lanes import Lanes
from neurove_service.streams.overload import Overload
from neurove_service.streams.runs import SMALL_BYTES
from neurove_service.streams.stream import Stream
from neurove_service.streams.turns import Slots
from neurove_service.streams.worker import Inbox, Outlet, Sample, StreamWorker
from tests.builders import make_packet, make_packets
from tests.live.conftest import wait_until


def sample(number, received_ns=0, size=0):
    return Sample(bytes([number]) + bytes(size), received_ns, is_camera=False)


def drain(inbox):
    samples, dropped = inbox.take_all(0)
    return [one.payload[0] for one in samples], dropped


def test_an_inbox_keeps_the_order_and_loses_nothing_within_its_bounds():
    inbox = Inbox(max_age_s=1, max_bytes=1 << 20)
    for number in range(100):
        inbox.put(sample(number, received_ns=number * 1_000_000))
    assert drain(inbox) == (list(range(100)), 0)


def test_an_inbox_drops_and_counts_the_samples_that_waited_too_long():
    inbox = Inbox(max_age_s=0.01, max_bytes=1 << 20)
    for number in range(100):
        inbox.put(sample(number, received_ns=number * 1_000_000))
    assert drain(inbox) == (list(range(89, 100)), 89)


def test_a_camera_info_keeps_its_place_whatever_is_dropped():
    inbox = Inbox(max_age_s=0.01, max_bytes=1 << 20)
    for number in range(100):
        if number in (0, 50, 95):
            assert inbox.put_camera(Sample(bytes([200 + number // 10]), 0, is_camera=True))
        inbox.put(sample(number, received_ns=number * 1_000_000))
    kept, dropped = drain(inbox)
    assert kept == [200, 205, *range(89, 95), 209, *range(95, 100)]
    assert dropped == 89
    assert drain(inbox) == ([], 0)


def test_many_camera_infos_displace_no_packet():
    inbox = Inbox(max_age_s=60, max_bytes=10_000)
    inbox.put(sample(1))
    queued = [inbox.put_camera(Sample(bytes(8000), 0, is_camera=True)) for _ in range(100)]
    assert 0 < sum(queued) < 100
    assert drain(inbox) == ([1, *[0] * sum(queued)], 0)


def test_an_inbox_never_exceeds_its_maximum_size():
    inbox = Inbox(max_age_s=1, max_bytes=10_000)
    for number in range(20):
        inbox.put(sample(number, size=1000))
    kept, dropped = drain(inbox)
    assert kept == list(range(20 - len(kept), 20))
    assert 0 < len(kept) * 1000 <= 10_000
    assert dropped == 20 - len(kept)
    inbox.put(sample(0, size=100_000))  # larger than the maximum
    assert drain(inbox) == ([], 1)


def put(worker, payload):
    """Queue a packet of a replay, whose sensor clock says nothing about its age."""
    now_ns = time.monotonic_ns()
    worker.put_packet(payload, now_ns, now_ns // 1000)


class Published:
    """An outlet that records the published estimates."""

    def __init__(self, camera=None):
        self.estimates: list[TwistEstimate] = []
        self.closed = threading.Event()
        self.camera = camera
        self.came = threading.Condition()

    def open(self):
        return Outlet(self.camera or (lambda: None), self.publish, self.closed.set)

    def publish(self, payload):
        with self.came:
            self.estimates.append(TwistEstimate.decode(payload))
            self.came.notify_all()

    def wait_for(self, count):
        with self.came:
            assert self.came.wait_for(lambda: len(self.estimates) >= count, timeout=60)
        return self.estimates


@pytest.fixture
def published():
    return Published()


@pytest.fixture
def worker(slot, published):
    worker = StreamWorker(Stream("cam0", slot, max_age_s=60), published.open, Inbox(60, 1 << 26), PacketLimits())
    yield worker
    worker.stop()
    worker.join(60)


def test_bytes_in_estimates_out(worker, published):
    for packet in make_packets(100):
        put(worker, encode_packet(packet))
    assert [one.seq for one in published.wait_for(7)] == list(range(7))
    assert all(one.trace.received_ns <= one.trace.queued_ns <= one.trace.computed_ns for one in published.estimates)


def test_malformed_packets_are_counted_and_lose_nothing_else(worker, published):
    for packet in make_packets(100):
        put(worker, encode_packet(packet))
        put(worker, b"\x81garbage")
    published.wait_for(7)
    assert worker.stream.counters.losses().nonzero().keys() <= {"malformed_packets"}


def test_an_internal_error_on_a_packet_does_not_end_the_stream(worker, published, monkeypatch, caplog):
    push, planted = worker.stream.lanes.push, []

    def faulty(packet, **how):
        if packet.seq >= 20 and not planted:
            planted.append(packet)
            raise RuntimeError("planted")
        return push(packet, **how)

    monkeypatch.setattr(worker.stream.lanes, "push", faulty)
    for packet in make_packets(100):
        put(worker, encode_packet(packet))
    published.wait_for(5)
    counters = worker.stream.counters
    assert 1 <= counters.failed_packets < 20
    assert counters.resets == 1


def test_a_standby_model_runs_however_often_packets_arrive(worker, monkeypatch):
    turns = []
    monkeypatch.setattr(Lanes, "has_backlog", property(lambda _: True))
    monkeypatch.setattr(worker.stream.lanes, "run_standby", lambda: turns.append(threading.Event().wait(0.03)))
    for packet in make_packets(400, n=5):
        put(worker, encode_packet(packet))
        threading.Event().wait(0.005)  # a packet arrives in each of its pauses
        if len(turns) == 4:
            return
    pytest.fail(f"{len(turns)} turns in 400 packets")


def test_an_unreadable_camera_info_is_refused_and_the_stream_continues(slot):
    def broken():
        raise Malformed("camera info", "planted")

    published = Published(broken)
    worker = StreamWorker(Stream("cam0", slot, max_age_s=60), published.open, Inbox(60, 1 << 26), PacketLimits())
    worker.put_camera(b"garbage", time.monotonic_ns())
    good = CameraInfo(stream="cam0", width=64, height=48, lens="pinhole", fx=40, fy=40, cx=32, cy=24)
    worker.put_camera(good.encode(), time.monotonic_ns())
    for packet in make_packets(30):
        put(worker, encode_packet(packet))
    assert "uncalibrated" not in published.wait_for(2)[0].flags
    worker.stop()
    worker.join(60)
    assert published.closed.is_set()


@pytest.mark.parametrize(
    ("payload", "why"),
    [
        (b"garbage", "camera info: not a valid message"),
        (bytes(1_000_000), "at most 8192 bytes"),
        (CameraInfo(stream="cam1", width=64, height=48, lens="pinhole", fx=40, fy=40, cx=32, cy=24).encode(), "cam1"),
    ],
    ids=["garbage", "a megabyte", "of another stream"],
)
def test_a_camera_info_that_is_refused_is_counted_with_its_reason(worker, payload, why):
    worker.put_camera(payload, time.monotonic_ns())
    wait_until(lambda: worker.stream.counters.refused_cameras == 1)
    assert why in worker.stream.activity.refusal
    assert worker.stream.camera is None


def test_packets_that_wait_together_give_the_same_estimates_as_one_by_one(slot):
    packets = [replace(packet, seq=packet.seq + (packet.seq > 150)) for packet in make_packets(400, n=10, step_us=1000)]
    payloads = [encode_packet(packet, "soa8" if packet.seq % 37 == 0 else None) for packet in packets]
    payloads[60] = b"garbage"
    expected = Stream("cam0", slot)
    for payload in payloads:
        try:
            packet = read_packet(payload)
        except Malformed:
            expected.refused(time.monotonic_ns(), "")
        else:
            now_ns = time.monotonic_ns()
            expected.accept(packet, Arrival(now_ns, now_ns, now_ns // 1000))
    published = Published()
    gate = threading.Event()
    worker = StreamWorker(
        Stream("cam0", slot, max_age_s=60),
        lambda: published.open() if gate.wait(60) else None,
        Inbox(60, 1 << 26),
        PacketLimits(),
    )
    for payload in payloads:
        put(worker, payload)
    gate.set()
    published.wait_for(expected.counters.estimates)
    wait_until(lambda: worker.stream.counters.packets_received == expected.counters.packets_received)
    worker.stop()
    worker.join(60)
    counters = worker.stream.counters
    assert counters == expected.counters
    assert (counters.gap_packets, counters.malformed_packets) == (1, 1)
    assert len(published.estimates) == 7


def test_runs_and_single_packets_count_the_same_events(slot):
    packets = make_packets(100, n=7, step_us=500)
    alone, together = Stream("cam0", slot), Stream("cam0", slot)
    now_ns = time.monotonic_ns()
    arrival = Arrival(now_ns, now_ns, now_ns // 1000)
    estimates = [one for packet in packets for one in alone.accept(packet, arrival)]
    tick = make_packet(0, seq=101, t0_us=50_000)
    found, index = [], 0
    payloads = [encode_packet(packet) for packet in packets]
    while index < len(payloads):
        run = together.collect(payloads[index:], PacketLimits())
        if run is None:
            found += together.accept(read_packet(payloads[index]), arrival)
            index += 1
        else:
            found += together.accept_run(run, arrival)
            index += len(run.marks)
    estimates += alone.accept(replace(tick, seq=100), arrival)
    found += together.accept(replace(tick, seq=100), arrival)
    assert len(found) == 1
    assert [(one.twists, one.events, one.flags) for one in found] == [
        (one.twists, one.events, one.flags) for one in estimates
    ]
    assert together.counters == alone.counters


class SlowModel:
    """Makes each window of a stream take longer than the window lasts."""

    def __init__(self, stream, seconds):
        push = stream.lanes.push

        def slow(packet, **how):
            pushing = push(packet, **how)
            time.sleep(seconds * len(pushing.estimates))
            return pushing

        stream.lanes.push = slow


def test_an_overloaded_worker_answers_whole_windows_of_the_newest_data(slot):
    published = Published()
    stream = Stream("cam0", slot, max_age_s=5)
    SlowModel(stream, 0.15)  # windows of 50 ms: three times the load
    worker = StreamWorker(stream, published.open, Inbox(1, 1 << 26), PacketLimits())
    began = time.monotonic()
    packets = make_packets(1200, n=20)  # 4.8 s
    for packet in packets:
        time.sleep(max(0.0, began + packet.t0_us * 1e-6 - time.monotonic()))
        put(worker, encode_packet(packet))
    worker.stop()
    worker.join(60)
    late = published.estimates[len(published.estimates) // 2 :]
    assert all(Flag.GAP not in one.flags for one in late)  # each has all of its events
    assert all(Flag.RESET not in one.flags for one in late)
    assert any(Flag.OVERLOAD in one.flags for one in late)
    lost = stream.counters.losses().nonzero()
    assert lost.keys() == {"overload_packets", "shed_windows"}
    answered = stream.counters.windows + stream.counters.shed_windows
    assert answered == published.estimates[-1].end_us // 50_000
    assert late[-1].trace.queued_ns - late[-1].trace.received_ns < 600e6


def test_an_overloaded_worker_answers_a_window_at_each_of_its_turns(slot):
    published, slots, turns = Published(), Slots(1), []
    worker = StreamWorker(
        Stream("cam0", slot, max_age_s=60), published.open, Inbox(0.5, 1 << 26), PacketLimits(), slots
    )
    packets = iter(make_packets(500, n=SMALL_BYTES, step_us=10_000))  # five in a window, none of them small
    try:
        while len(turns) < 15:  # between two turns of the worker other streams work for 0.3 s
            with slots.serving.turn():
                began = time.monotonic()
                while time.monotonic() < began + 0.3:
                    put(worker, encode_packet(next(packets)))
                    time.sleep(0.01)
            turns.append(len(published.estimates))
    finally:
        worker.stop()
        worker.join(60)
    late = published.estimates[turns[7] :]
    assert len(late) >= 5  # of eight turns
    assert all(Flag.OVERLOAD in one.flags for one in late)
    assert not any({Flag.GAP, Flag.RESET} & set(one.flags) for one in late)


def test_a_stall_that_is_shorter_than_the_patience_loses_nothing():
    overload = Overload(patience_s=1)
    ms = 1_000_000
    assert not any(overload.must_shed(waited * ms, (1000 + waited) * ms) for waited in range(0, 900, 10))
    assert not overload.must_shed(50 * ms, 2000 * ms)
    assert not any(overload.must_shed(300 * ms, at * ms) for at in range(2100, 3000, 10))
    assert overload.must_shed(300 * ms, 3200 * ms)
    assert overload.must_shed(150 * ms, 3300 * ms)
    assert not overload.must_shed(50 * ms, 3400 * ms)
    assert not overload.must_shed(150 * ms, 9000 * ms)  # the overload has ended long ago
