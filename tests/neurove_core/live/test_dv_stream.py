"""dv network streams: of a NetworkWriter of dv-processing in a process of its own, and of servers that are wrong."""

import socket
import struct
import threading
import time
from contextlib import closing, contextmanager

import numpy as np
import pytest

from neurove_core.io.errors import UnknownSource
from neurove_core.io.faults import Reason
from neurove_core.live import dv_stream
from neurove_core.live.dv_stream import open_stream
from neurove_core.live.source import LiveEnded, NoCamera
from neurove_core.sources import is_live, open_live, open_source, supported
from neurove_protocol import Events
from neurove_protocol.errors import InvalidField
from tests.live.conftest import free_ports
from tests.live.dv_writer import DV_SENSOR, ask, dv_events, dv_writer, tell

pytestmark = pytest.mark.live

DEADLINE_S = 120.0
PATIENT = "delay=3600"  # no tick by the clock of a busy machine


@pytest.fixture
def ports():
    return free_ports()


class Read:
    """Batches of a source, read until a condition."""

    def __init__(self, source):
        self.batches, self._iterator = [], source.batches()

    def until(self, condition):
        deadline = time.monotonic() + DEADLINE_S
        while not condition(self):
            assert time.monotonic() < deadline, "the condition did not become true"
            self.batches.append(next(self._iterator))
        return self

    @property
    def events(self):
        return Events.join([one.events for one in self.batches])

    @property
    def samples(self):
        return [one.samples for one in self.batches if one.samples.n]

    @property
    def gaps(self):
        return sum(one.lost for one in self.batches)


def same(a, b):
    return all(np.array_equal(x, y) for x, y in zip(a, b, strict=True))


@pytest.mark.parametrize("compress", ["none", "lz4", "zstd"])
def test_every_event_arrives_once_and_in_order(ports, compress):
    with (
        dv_writer(ports[0], compress=compress) as writer,
        closing(open_live(f"dv://127.0.0.1:{ports[0]}?{PATIENT}")) as source,
    ):
        assert source.sensor == DV_SENSOR
        assert source.streams == ("events",)
        tell(writer, "clients 1", "events 20000 12000 5000000")
        read = Read(source).until(lambda one: one.events.n >= 12_000)
        assert same(read.events, dv_events(20000, 12_000, 5_000_000))
        assert read.gaps == 0
        assert source.faults.found == ()


def test_inertial_samples_have_a_port_of_their_own_and_are_in_the_optical_frame(ports):
    with (
        dv_writer(*ports, imu=True) as writer,
        closing(open_live(f"dv://127.0.0.1:{ports[0]}?imu={ports[1]}&{PATIENT}")) as source,
    ):
        assert source.streams == ("events", "imu")
        tell(writer, "clients 2", "imu 90 7000000")
        read = Read(source).until(lambda one: sum(each.n for each in one.samples) >= 90)
    (samples,) = read.samples
    assert samples.t.tolist() == [7_000_000 + 1000 * i for i in range(90)]
    np.testing.assert_allclose(samples.accel_m_s2, np.tile([0.0, 9.80665, 0.0], (90, 1)), rtol=1e-6)
    np.testing.assert_allclose(samples.gyro_rad_s[:, 2], -np.radians(np.arange(90)), rtol=1e-5)


def test_the_time_advances_while_the_scene_is_still(ports):
    with dv_writer(ports[0]) as writer, closing(open_live(f"dv://127.0.0.1:{ports[0]}?delay=0")) as source:
        tell(writer, "clients 1", "events 20001 1000 0")
        read = Read(source).until(lambda one: one.events.n >= 1000)
        last_us = int(read.events.t[-1])
        read.until(lambda one: sum(each.now_us is not None for each in one.batches) >= 3)
    ticks = [one.now_us for one in read.batches if one.now_us is not None]
    assert ticks == sorted(set(ticks))
    assert ticks[0] > last_us


def test_the_end_of_the_writer_ends_the_source_after_every_event(ports):
    with (
        dv_writer(ports[0]) as writer,
        closing(open_live(f"dv://127.0.0.1:{ports[0]}?{PATIENT}&reconnect=0")) as source,
    ):
        tell(writer, "clients 1", "events 20002 9000 0", "end")
        read = Read(source)
        with pytest.raises(LiveEnded) as ended:
            read.until(lambda _: False)
    assert same(read.events, dv_events(20002, 9000, 0))
    assert "the stream ended" in ended.value.message
    assert ended.value.exit_code == 1


def test_a_writer_that_returns_leaves_a_gap(ports):
    with dv_writer(ports[0]) as writer:
        source = open_live(f"dv://127.0.0.1:{ports[0]}?{PATIENT}&reconnect=600")
        tell(writer, "clients 1", "events 20003 1000 0", "end")
        read = Read(source).until(lambda one: one.events.n == 1000)
    with closing(source), dv_writer(ports[0]) as writer:
        ask(writer, "clients 1", "events 20004 1000 500000")  # the source connects while it is read
        read.until(lambda one: one.events.n == 2000)
        assert read.gaps == 1
        assert next(one.lost for one in read.batches if one.events.n) is False
        assert [fault.count for fault in source.faults.found if fault.reason is Reason.LOST] == [1]


class Server:
    """A TCP server that sends what it is given to each client, and then waits or closes."""

    def __init__(self, *parts, close=False):
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.port = self._listener.getsockname()[1]
        self._clients, self._close = [], close
        self._thread = threading.Thread(target=self._serve, args=(parts,), daemon=True)
        self._thread.start()

    def _serve(self, parts):
        while True:
            try:
                client, _ = self._listener.accept()
            except OSError:
                return
            self._clients.append(client)
            for part in parts:
                client.sendall(part)
            if self._close:
                client.close()

    def end(self):
        self._listener.shutdown(socket.SHUT_RDWR)
        self._listener.close()
        self._thread.join()
        for client in self._clients:
            client.close()


@contextmanager
def serving(*parts, close=False):
    server = Server(*parts, close=close)
    try:
        yield f"dv://127.0.0.1:{server.port}?{PATIENT}&reconnect=0"
    finally:
        server.end()


@pytest.fixture(scope="module")
def recorded():
    """Header and two packets of a real NetworkWriter, of 1,000 events each."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    with dv_writer(port) as writer, socket.create_connection(("127.0.0.1", port), 60) as client:
        tell(writer, "clients 1", "events 20005 2000 0")
        data = b""
        while len(found := list(parts_of(data))) < 3:
            data += client.recv(1 << 16)
    return found


def parts_of(data):
    """The header, and each whole packet."""
    at, head = 0, True
    while at + 8 <= len(data):
        size = struct.unpack_from("<i", data, at if head else at + 4)[0] + (4 if head else 8)
        if at + size > len(data):
            return
        yield data[at : at + size]
        at, head = at + size, False


@pytest.mark.parametrize("seed", range(20006, 20012))
def test_damaged_packets_are_counted_and_the_others_arrive(recorded, seed):
    """The same bytes end NetworkReader with a segmentation fault."""
    header, first, second = recorded
    rng = np.random.default_rng(seed)
    damaged = []
    for _ in range(20):
        bad = bytearray(first)
        bad[8 + int(rng.integers(4, 24))] ^= int(rng.integers(1, 256))  # among its offsets, not its length
        damaged.append(bytes(bad))
    with serving(header, first, *damaged, second, close=True) as url, closing(open_stream(url)) as source:
        read = Read(source)
        with pytest.raises(LiveEnded):
            read.until(lambda _: False)
    times = read.events.t
    assert (times[1:] >= times[:-1]).all()
    assert set(dv_events(20005, 2000, 0).t.tolist()) <= set(times.tolist())
    found = {fault.reason for fault in source.faults.found}
    assert found & {Reason.DAMAGED, Reason.LATE, Reason.OUTSIDE, Reason.NEW_CLOCK}


def test_a_packet_that_is_too_long_ends_the_connection(recorded):
    header, first, _ = recorded
    with (
        serving(header, first, struct.pack("<ii", 0, 1 << 30), b"x" * 64) as url,
        closing(open_stream(url)) as source,
    ):
        read = Read(source)
        with pytest.raises(LiveEnded) as ended:
            read.until(lambda _: False)
    assert read.events.n == 1000
    assert "1073741824 bytes" in ended.value.message


@pytest.mark.parametrize(
    ("parts", "close", "why"),
    [
        ((), True, "the server closed the connection"),
        ((b"HTTP/1.1 400 Bad Request\r\n\r\n",), False, "does not begin with the header"),
        ((struct.pack("<I", 40) + b"\xff" * 40,), False, "its header cannot be read"),
    ],
)
def test_what_is_no_dv_stream_is_refused_in_words(parts, close, why):
    with serving(*parts, close=close) as url, pytest.raises(NoCamera) as refused:
        open_stream(url)
    assert why in refused.value.message
    assert refused.value.exit_code == 1


def test_a_server_that_is_silent_is_refused_in_bounded_time(monkeypatch):
    monkeypatch.setattr(dv_stream, "OPEN_S", 0.3)
    with serving() as url, pytest.raises(NoCamera, match="it sends no header"):
        open_stream(url)


def test_nothing_at_the_address_is_one_sentence(ports):
    with pytest.raises(NoCamera, match="Connection refused"):
        open_stream(f"dv://127.0.0.1:{ports[0]}")


@pytest.mark.parametrize(
    ("url", "error", "why"),
    [
        ("dv://127.0.0.1", UnknownSource, "expected dv://HOST:PORT"),
        ("dv://127.0.0.1:7777/path", UnknownSource, "expected dv://HOST:PORT"),
        ("dv://127.0.0.1:7777?speed=3", UnknownSource, "expected dv://HOST:PORT"),
        ("dv://127.0.0.1:0", InvalidField, "from 1 to 65535"),
        ("dv://127.0.0.1:7777?imu=x", InvalidField, "from 1 to 65535"),
        ("dv://127.0.0.1:7777?delay=nan", InvalidField, "from 0 to 3600"),
    ],
)
def test_a_wrong_url_names_the_part(url, error, why):
    with pytest.raises(error) as refused:
        open_live(url)
    assert why in refused.value.message


def test_the_table_of_sources_has_the_live_ones():
    assert is_live("dv://127.0.0.1:7777")
    assert is_live("camera://")
    assert not is_live("sim://")
    assert not is_live("recording.aedat4")
    assert {line.partition(" ")[0] for line in supported() if "://" in line} >= {"dv://HOST:PORT", "camera://,"}


def test_a_command_that_needs_a_recording_names_the_ones_that_do_not():
    with pytest.raises(UnknownSource) as refused:
        open_source("dv://127.0.0.1:7777")
    assert "`neurove drive` publishes it, and `neurove record`" in refused.value.message
