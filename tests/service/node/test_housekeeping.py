import time

import pytest

from neurove_protocol.control import StreamStatus
from neurove_protocol.events import PacketLimits, encode_packet
from neurove_service.guard import Guard
from neurove_service.node.condition import Watch
from neurove_service.node.health import node_verdict
from neurove_service.node.housekeeping import Housekeeping
from neurove_service.node.watchdog import STOPPED_LOOP_S, Watchdog
from neurove_service.streams.activity import IDLE_NS
from neurove_service.streams.history import RingSize
from neurove_service.streams.registry import StreamRegistry, StreamSettings
from neurove_service.streams.worker import Outlet
from tests.builders import make_packets
from tests.service.models.swapping import wait_until


class Recorder:
    """A publisher that keeps what it gets, or raises if it is broken."""

    def __init__(self, sent, *, broken):
        self._sent, self._broken = sent, broken

    def put(self, payload):
        if self._broken:
            raise RuntimeError("planted")
        self._sent.append(StreamStatus.decode(payload))

    def close(self):
        if self._broken:
            raise RuntimeError("planted")


@pytest.fixture
def guard():
    return Guard()


@pytest.fixture
def make(slot, guard):
    made = []

    def registry(open_outlet=lambda _: Outlet(lambda: None, lambda _: None, lambda: None), idle_evict_s=60.0):
        settings = StreamSettings(4, idle_evict_s, 60.0, 1 << 26, RingSize(), PacketLimits())
        made.append(StreamRegistry(slot, settings, open_outlet, guard))
        return made[-1]

    yield registry
    for one in made:
        one.close()


def put(registry, stream):
    for packet in make_packets(3, stream=stream):
        registry.put_packet(stream, encode_packet(packet), time.monotonic_ns())


def test_a_stream_whose_status_fails_costs_itself(make, guard, monkeypatch):
    registry = make()
    for name in ("cam0", "cam1", "cam2"):
        put(registry, name)
    broken = next(stream for stream in registry.streams() if stream.name == "cam1")
    monkeypatch.setattr(broken.verdicts, "at", lambda _: 1 / 0)
    sent, watch = [], Watch("edge", registry, guard)
    housekeeping = Housekeeping(
        registry, watch.statuses, lambda name: Recorder(sent, broken=name == "cam2"), 1.0, guard
    )
    housekeeping.turn(time.monotonic() + 2)
    assert [status.stream for status in sent] == ["cam0"]
    assert guard.counts == {"status message": 1, "stream status": 1}
    ok, why = node_verdict(watch.statuses(), watch.condition().reasons())
    assert not ok
    assert "internal errors within a minute, total by place: status message 1, stream status 2" in why


def test_an_eviction_goes_on_after_a_publisher_that_cannot_be_closed(make, guard):
    registry = make(idle_evict_s=1e-9)
    sent, watch = [], Watch("edge", registry, guard)
    housekeeping = Housekeeping(
        registry, watch.statuses, lambda name: Recorder(sent, broken=name == "cam0"), 1.0, guard
    )
    put(registry, "cam0"), put(registry, "cam1")
    housekeeping.turn(time.monotonic() + 2)
    assert registry.streams() == []
    assert guard.counts == {"end of a status publisher": 1, "status message": 1}


def test_a_stream_whose_outlet_cannot_be_opened_starts_later(make, guard):
    opened = []

    def open_outlet(stream):
        opened.append(stream)
        if len(opened) == 1:
            raise RuntimeError("planted")
        return Outlet(lambda: None, lambda _: None, lambda: None)

    registry = make(open_outlet)
    put(registry, "cam0")
    (stream,) = registry.streams()
    wait_until(lambda: stream.counters.packets_received == 3)
    assert guard.counts == {"start of a stream": 1}


def test_the_loop_of_a_stream_goes_on_after_an_error_in_it(make, guard, monkeypatch):
    registry = make()
    put(registry, "cam0")
    (stream,) = registry.streams()
    wait_until(lambda: stream.counters.packets_received == 3)
    monkeypatch.setattr(stream, "accept", lambda *_: 1 / 0)
    monkeypatch.setattr(stream, "failed", lambda: 1 / 0)
    put(registry, "cam0")
    wait_until(lambda: guard.counts == {"packet": 3, "stream loop": 3})
    assert registry.alive()


def test_the_watchdog_pings_while_housekeeping_turns_and_no_longer(guard):
    pings = []
    watchdog = Watchdog(lambda: 100.0, guard, lambda: pings.append(1))
    assert watchdog.turn(100.5)
    assert not watchdog.turn(101.0 + STOPPED_LOOP_S)
    assert not watchdog.turn(102.0 + STOPPED_LOOP_S)
    assert len(pings) == 1


def test_an_expected_stream_that_never_came_or_has_died_is_named(make, guard):
    registry = make()
    put(registry, "cam0"), put(registry, "cam1")
    watch = Watch("edge", registry, guard, ("cam0", "cam1", "cam2"))
    assert watch.condition().missing_streams == ("cam2",)
    dead = next(stream for stream in registry.streams() if stream.name == "cam1")
    wait_until(lambda: dead.counters.packets_received == 3)
    dead.activity.last_packet_ns -= 2 * IDLE_NS
    dead.activity.arrived_ns = dead.activity.last_packet_ns
    assert watch.condition().missing_streams == ("cam1", "cam2")
    ok, why = node_verdict(watch.statuses(), watch.condition().reasons())
    assert not ok
    assert "expected stream cam2 is missing" in why


def test_another_node_of_the_name_is_a_reason(make, guard):
    watch = Watch("edge", make(), guard, namesakes=lambda: 1)
    assert "1 other nodes of this name" in node_verdict([], watch.condition().reasons())[1]
