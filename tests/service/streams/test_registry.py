import threading
import time

import pytest

from neurove_protocol import CameraInfo, TwistEstimate
from neurove_protocol.events import PacketLimits, encode_packet
from neurove_service.streams.history import RingSize
from neurove_service.streams.registry import StreamRegistry, StreamSettings
from neurove_service.streams.worker import Outlet
from tests.builders import make_packets
from tests.service.models.swapping import wait_until


class Network:
    """Opens outlets and records what their workers publish and close."""

    def __init__(self):
        self.estimates, self.closed = [], []

    def open(self, stream):
        return Outlet(lambda: None, self._publish, lambda: self.closed.append(stream))

    def _publish(self, payload):
        self.estimates.append(TwistEstimate.decode(payload))

    def of(self, stream):
        return [one for one in list(self.estimates) if one.stream == stream]


@pytest.fixture
def network():
    return Network()


@pytest.fixture
def make(slot, network):
    made = []

    def registry(**settings):
        defaults = {"max_streams": 4, "idle_evict_s": 60.0, "queue_s": 60.0, "queue_bytes": 1 << 26}
        bounds = StreamSettings(**defaults | settings, ring=RingSize(), limits=PacketLimits())
        made.append(StreamRegistry(slot, bounds, network.open))
        return made[-1]

    yield registry
    for one in made:
        one.close()


def put(registry, stream, count=30):
    for packet in make_packets(count, stream=stream):
        registry.put_packet(stream, encode_packet(packet), time.monotonic_ns())


def test_each_stream_gets_a_worker_and_its_own_estimates(make, network):
    registry = make()
    put(registry, "cam0"), put(registry, "cam1")
    wait_until(lambda: len(network.estimates) == 4)
    assert [len(network.of(name)) for name in ("cam0", "cam1")] == [2, 2]
    assert {stream.name for stream in registry.streams()} == {"cam0", "cam1"}
    assert registry.alive()


def test_a_camera_info_before_the_first_packet_calibrates_it(make, network):
    registry = make()
    camera = CameraInfo(stream="cam0", width=64, height=48, lens="pinhole", fx=40, fy=40, cx=32, cy=24)
    registry.put_camera("cam0", camera.encode(), time.monotonic_ns())
    put(registry, "cam0")
    wait_until(lambda: len(network.estimates) == 2)
    assert not any("uncalibrated" in one.flags for one in network.estimates)


def test_streams_beyond_max_streams_are_refused_and_each_counts_once(make):
    registry = make(max_streams=1)
    put(registry, "cam0"), put(registry, "cam1"), put(registry, "cam2")
    registry.refuse("not/a/name")
    assert [stream.name for stream in registry.streams()] == ["cam0"]
    assert registry.refused == 3


def test_a_stream_that_is_not_idle_stays(make):
    registry = make(idle_evict_s=3600.0)
    put(registry, "cam0")
    assert registry.evict_idle() == []
    assert [stream.name for stream in registry.streams()] == ["cam0"]


def test_an_idle_stream_is_evicted_and_makes_a_refused_one_possible(make, network):
    registry = make(max_streams=1, idle_evict_s=0.2)
    put(registry, "cam0"), put(registry, "cam1")
    wait_until(lambda: registry.evict_idle() == ["cam0"])
    wait_until(lambda: network.closed == ["cam0"])
    wait_until(lambda: registry.evict_idle() == [] and registry.refused == 0)
    put(registry, "cam1")
    wait_until(lambda: len(network.of("cam1")) == 2)


def test_a_closed_registry_has_ended_its_workers_and_starts_no_new_ones(make, network):
    registry = make()
    put(registry, "cam0")
    wait_until(lambda: network.of("cam0"))
    registry.close()
    wait_until(lambda: network.closed == ["cam0"])
    put(registry, "cam1")
    assert registry.streams() == []
    assert not any(thread.name == "stream cam1" for thread in threading.enumerate())
