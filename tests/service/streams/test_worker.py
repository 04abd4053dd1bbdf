import threading
import time

import pytest

from neurove_protocol import CameraInfo, TwistEstimate
from neurove_protocol.errors import Malformed
from neurove_protocol.events import PacketLimits, encode_packet
from neurove_service.streams.lanes import Lanes
from neurove_service.streams.stream import Stream
from neurove_service.streams.worker import Inbox, Outlet, Sample, StreamWorker
from tests.builders import make_packets


def sample(number, received_ns=0, size=0):
    return Sample(bytes([number]) + bytes(size), received_ns, is_camera=False)


def drain(inbox):
    taken, dropped = [], 0
    while True:
        one, lost = inbox.take(0)
        dropped += lost
        if one is None:
            return taken, dropped
        taken.append(one.payload[0])


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
            assert self.came.wait_for(lambda: len(self.estimates) >= count, timeout=20)
        return self.estimates


@pytest.fixture
def published():
    return Published()


@pytest.fixture
def worker(slot, published):
    worker = StreamWorker(Stream("cam0", slot), published.open, Inbox(60, 1 << 26), PacketLimits())
    yield worker
    worker.stop()
    worker.join(5)


def test_bytes_in_estimates_out(worker, published):
    for packet in make_packets(100):
        worker.put_packet(encode_packet(packet), time.monotonic_ns())
    assert [one.seq for one in published.wait_for(7)] == list(range(7))
    assert all(one.trace.received_ns <= one.trace.queued_ns <= one.trace.computed_ns for one in published.estimates)


def test_malformed_packets_are_counted_and_lose_nothing_else(worker, published):
    for packet in make_packets(100):
        worker.put_packet(encode_packet(packet), time.monotonic_ns())
        worker.put_packet(b"\x81garbage", 1)
    published.wait_for(7)
    assert worker.stream.counters.losses().nonzero().keys() <= {"malformed_packets"}


def test_an_internal_error_on_a_packet_does_not_end_the_stream(worker, published, monkeypatch, caplog):
    accept = worker.stream.accept

    def faulty(packet, arrival):
        if packet.seq == 20:
            raise RuntimeError("planted")
        return accept(packet, arrival)

    monkeypatch.setattr(worker.stream, "accept", faulty)
    for packet in make_packets(100):
        worker.put_packet(encode_packet(packet), time.monotonic_ns())
    published.wait_for(6)
    assert worker.stream.counters.failed_packets == 1


def test_a_standby_model_runs_however_often_packets_arrive(worker, monkeypatch):
    turns = []
    monkeypatch.setattr(Lanes, "has_backlog", property(lambda _: True))
    monkeypatch.setattr(worker.stream.lanes, "run_standby", lambda: turns.append(threading.Event().wait(0.03)))
    for packet in make_packets(400, n=5):
        worker.put_packet(encode_packet(packet), time.monotonic_ns())
        threading.Event().wait(0.005)  # a packet arrives in each of its pauses
        if len(turns) == 4:
            return
    pytest.fail(f"{len(turns)} turns in 400 packets")


def test_an_unreadable_camera_info_is_refused_and_the_stream_continues(slot):
    def broken():
        raise Malformed("camera info", "planted")

    published = Published(broken)
    worker = StreamWorker(Stream("cam0", slot), published.open, Inbox(60, 1 << 26), PacketLimits())
    worker.put_camera(b"garbage", 1)
    good = CameraInfo(stream="cam0", width=64, height=48, lens="pinhole", fx=40, fy=40, cx=32, cy=24)
    worker.put_camera(good.encode(), 1)
    for packet in make_packets(30):
        worker.put_packet(encode_packet(packet), time.monotonic_ns())
    assert "uncalibrated" not in published.wait_for(2)[0].flags
    worker.stop()
    worker.join(5)
    assert published.closed.is_set()
