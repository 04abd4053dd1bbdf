import threading

import pytest

from neurove_core.geometry.tables import TABLES
from neurove_protocol import CameraInfo
from neurove_protocol.errors import NoTable
from neurove_protocol.events import PacketLimits, encode_packet
from neurove_service.guard import Guard
from neurove_service.streams import preparing
from neurove_service.streams.preparing import Prepared, Preparing
from neurove_service.streams.stream import Stream
from neurove_service.streams.worker import Inbox, Outlet, StreamWorker
from tests.builders import make_packets
from tests.live.conftest import wait_until

CAMERA = CameraInfo(stream="cam0", width=1280, height=1280, lens="pinhole", fx=900, fy=900, cx=640, cy=640)


def test_a_newer_camera_replaces_the_one_that_waits():
    built, go, done = [], threading.Event(), threading.Event()

    def build(camera):
        built.append(camera.fx)
        assert go.wait(60)
        return camera.fx

    def finished():
        if len(built) == 2:
            done.set()

    tables = Preparing(build, finished, Guard())
    tables.start(CAMERA)
    wait_until(lambda: built == [900])
    for fx in (41.0, 42.0, 43.0):
        tables.start(CAMERA.model_copy(update={"fx": fx}))
    go.set()
    assert done.wait(60)
    assert built == [900, 43]
    assert tables.take() == Prepared(CAMERA.model_copy(update={"fx": 43.0}), None)
    assert tables.take() is None


def test_an_error_of_a_build_is_a_result_and_a_fault_is_counted():
    refused, guard, done = NoTable("64x48", 1, 2, 3), Guard(), threading.Semaphore(0)

    def build(camera):
        raise refused if camera.fx == 900 else RuntimeError("planted")

    tables = Preparing(build, done.release, guard)
    tables.start(CAMERA)
    assert done.acquire(timeout=60)
    assert tables.take() == Prepared(CAMERA, refused)
    tables.start(CAMERA.model_copy(update={"fx": 41.0}))
    assert done.acquire(timeout=60)
    prepared = tables.take()
    assert (prepared.camera.fx, prepared.error.code) == (41.0, "internal")
    assert guard.counts == {"look-up table": 1}


@pytest.fixture
def worker(slot):
    outlet = Outlet(lambda: None, lambda _: None, lambda: None)
    worker = StreamWorker(Stream("cam0", slot), lambda: outlet, Inbox(60, 1 << 26), PacketLimits())
    yield worker
    worker.stop()
    worker.join(60)


def test_packets_are_processed_while_the_table_of_a_large_sensor_is_built(worker):
    with preparing.ONE_AT_A_TIME:  # as if another stream's table were under way
        worker.put_camera(CAMERA.encode(), 1)
        for packet in make_packets(3):
            worker.put_packet(encode_packet(packet), 1)
        wait_until(lambda: worker.stream.counters.packets_received == 3)
        assert worker.stream.camera is None
    wait_until(lambda: worker.stream.camera == CAMERA)


def test_a_sensor_whose_table_has_no_memory_is_refused_with_the_reason(worker, monkeypatch):
    monkeypatch.setattr(TABLES, "max_bytes", 0)
    worker.put_camera(CAMERA.model_copy(update={"fx": 833.0}).encode(), 1)
    wait_until(lambda: worker.stream.counters.refused_cameras == 1)
    assert "tables_mib" in worker.stream.activity.refusal
