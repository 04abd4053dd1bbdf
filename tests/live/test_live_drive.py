"""`neurove drive` of network streams and cameras: what a consumer on Zenoh receives, and how the command ends."""

import json
import socket
import subprocess
import sys

import numpy as np
import pytest

from neurove_core.config import CanonicalConfig, WindowConfig
from neurove_core.geometry.camera import lookup_table
from neurove_core.ingest.windows import WindowsState, push
from neurove_core.sources import open_source
from neurove_protocol import CameraInfo, Events
from neurove_protocol.events import decode_packet
from neurove_protocol.imu import decode_imu
from neurove_protocol.keys import Keys
from tests.live.conftest import client, free_ports, neurove, wait_until
from tests.live.dv_writer import DV_SENSOR, dv_events, dv_writer, store_of, tell
from tests.live.fake_camera import EVK4, SERIAL, camera_events

pytestmark = pytest.mark.live

CALIBRATION = """
image_width: {width}
image_height: {height}
camera_matrix: {{rows: 3, cols: 3, data: [{f}, 0, {cx}, 0, {f}, {cy}, 0, 0, 1]}}
distortion_model: plumb_bob
distortion_coefficients: {{rows: 1, cols: 5, data: [0, 0, 0, 0, 0]}}
"""


@pytest.fixture
def ports():
    return free_ports()


class Heard:
    """What a consumer receives of every stream."""

    def __init__(self, transport):
        self.packets, self.imu, self.cameras = [], [], []
        transport.subscribe(Keys().events(), lambda _key, data, _ns: self.packets.append(decode_packet(data)))
        transport.subscribe(Keys().imu(), lambda _key, data, _ns: self.imu.append(decode_imu(data)))
        transport.subscribe(Keys().camera(), lambda _key, data, _ns: self.cameras.append(CameraInfo.decode(data)))

    @property
    def events(self):
        return Events.join([one.events for one in self.packets])


class Driving:
    """A driver process, after its stream has a listener."""

    def __init__(self, *command):
        self.child = subprocess.Popen(
            [sys.executable, *map(str, command), "--wait", "90"],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
        self.lines = []
        while not self.lines or not self.lines[-1].startswith("neurove: driving"):
            line = self.child.stderr.readline()
            assert line, self.lines
            self.lines.append(line)

    def end(self, text=None):
        out, err = self.child.communicate(text, timeout=120)
        return self.child.returncode, out, "".join(self.lines) + err


def windows_of(pieces, sensor):
    """Windows of events with the time that each piece reaches."""
    canonical, config = CanonicalConfig(), WindowConfig()
    lut = lookup_table(canonical, sensor, None)
    state, found = WindowsState(), []
    for events, horizon_us in pieces:
        pushed = push(events, horizon_us, state, lut, config, canonical)
        state = pushed.state
        found += pushed.windows
        assert (pushed.late_events, pushed.skipped_windows) == (0, 0)
    return found


def same_events(a, b):
    return all(np.array_equal(x, y) for x, y in zip(a, b, strict=True))


def test_a_dv_stream_gives_the_windows_of_the_file_that_is_played(router, ports, tmp_path):
    import dv_processing as dv

    n, t0_us = 5000, 1_000_000
    pieces = [(20070 + i, n, t0_us + 10 * n * i) for i in range(6)] + [(20076, 1, t0_us + 60 * n)]
    config = dv.io.MonoCameraWriter.Config("Synthetic")
    config.addEventStream((DV_SENSOR.width, DV_SENSOR.height))
    file = tmp_path / "recording.aedat4"
    writer = dv.io.MonoCameraWriter(str(file), config)
    for piece in pieces:
        writer.writeEvents(store_of(dv_events(*piece)))
    del writer
    recorded = Events.join(list(open_source(str(file)).chunks()))

    url = f"dv://127.0.0.1:{ports[0]}?imu={ports[1]}&delay=3600&reconnect=0"
    with client(router) as transport, dv_writer(*ports, imu=True) as played:
        heard = Heard(transport)
        driving = Driving("-m", "neurove_service.cli", "drive", url, "--connect", router, "--stream", "left")
        tell(played, "clients 2", f"imu 300 {t0_us}")
        wait_until(lambda: sum(one.samples.n for one in heard.imu) == 300)
        for sent, (seed, count, start_us) in enumerate(pieces):  # by contract, a link may drop packets of a burst
            tell(played, f"events {seed} {count} {start_us}")
            wait_until(lambda sent=sent: heard.events.n >= min(n * (sent + 1), recorded.n))
        tell(played, "end")
        code, out, err = driving.end()
        last_us = int(recorded.t[-1])
        wait_until(lambda: heard.packets[-1].t0_us == last_us + 1)

    assert code == 1  # a live source has no end of its own
    assert f"{recorded.n:,} events and 300 IMU samples of {url} (346x260)" in out
    assert "the stream ended" in err
    assert {one.stream for one in heard.packets} == {"left"}
    assert [one.seq for one in heard.packets] == list(range(len(heard.packets)))
    assert same_events(heard.events, recorded)
    live = windows_of([(one.events, one.t0_us) for one in heard.packets], DV_SENSOR)
    of_file = windows_of([(recorded, t0_us), (Events.empty(), last_us + 1)], DV_SENSOR)
    assert len(live) == len(of_file) == 6
    for one, other in zip(live, of_file, strict=True):
        assert (one.start_us, one.events) == (other.start_us, other.events)
        np.testing.assert_array_equal(one.counts, other.counts)


def test_a_camera_that_overflows_and_is_unplugged_leaves_a_gap_counts_and_an_exit_code(router, tmp_path):
    lens = tmp_path / "evk4.yaml"
    lens.write_text(CALIBRATION.format(width=EVK4.width, height=EVK4.height, f=1000, cx=640, cy=360))
    with client(router) as transport:
        heard = Heard(transport)
        driving = Driving(
            *("-m", "tests.live.fake_camera", 5000, "drive", "camera://", "--connect", router),
            *("--calibration", lens, "--height", "1.2", "--stream", "front"),
        )
        code, out, err = driving.end("go\n")
        wait_until(lambda: heard.events.n == 5000)
        wait_until(lambda: heard.cameras)
    assert code == 1
    assert f"5,000 events of Prophesee EVK4 {SERIAL} (1280x720), 1 gap where events were lost" in out
    assert "the camera stopped: " in err
    assert "events: 5 lost in transmission" in err
    assert "Traceback" not in err
    assert same_events(heard.events, Events.join(camera_events(5000)))
    numbers = [one.seq for one in heard.packets]
    missing = sorted(set(range(numbers[-1])) - set(numbers))
    assert len(missing) == 1
    first_after = next(one for one in heard.packets if one.seq == missing[0] + 1)
    assert first_after.t0_us == int(camera_events(5000)[5].t[0])
    assert (heard.cameras[0].height_m, heard.cameras[0].fx, heard.cameras[0].stream) == (1.2, 1000.0, "front")


def test_seconds_bound_a_live_source_that_gives_nothing(router):
    with client(router) as transport:
        heard = Heard(transport)
        driving = Driving(
            *("-m", "tests.live.fake_camera", 0, "drive", f"camera://evk4?serial={SERIAL}", "--connect", router),
            *("--seconds", "0.3"),
        )
        code, out, err = driving.end()
    assert code == 0, err
    assert "cam0: 0 packets, 0 events of Prophesee EVK4" in out
    assert heard.packets == []


def test_a_signal_ends_a_live_source_in_order(router):
    with client(router) as transport:
        Heard(transport)
        driving = Driving("-m", "tests.live.fake_camera", 0, "drive", "camera://", "--connect", router)
        driving.child.terminate()
        code, out, err = driving.end()
    assert (code, "Traceback" in err) == (0, False)
    assert out.startswith("cam0: 0 packets")


@pytest.mark.parametrize(
    ("words", "why"),
    [
        (("--speed", "2"), "--speed=2.0: a live source has its own pace"),
        (("--loop",), "--loop=True: a live source cannot be played again"),
        (("--topic", "left"), "--topic='left': a live source has one event stream"),
        (("--time-unit", "us"), "--time-unit='us': the times of a live source are in us"),
    ],
)
def test_what_a_live_source_cannot_do_is_refused_by_name(run, words, why):
    code, out, err = run("drive", "dv://127.0.0.1:9", *words)
    assert (code, out) == (2, "")
    assert why in err


def test_axes_for_a_source_without_an_inertial_unit_are_refused(run, ports):
    with dv_writer(ports[0]):
        code, _, err = run("drive", f"dv://127.0.0.1:{ports[0]}", "--imu-axes=-x,y,-z", "--wait", "0")
    assert code == 2
    assert "has no inertial samples" in err


@pytest.mark.parametrize("source", ["camera://", "camera://davis346", "camera://davis240", "dv://127.0.0.1:9"])
def test_a_source_that_is_missing_is_one_sentence_and_an_exit_code(source):
    ran = neurove("drive", source, "--wait", "0")
    assert (ran.returncode, ran.stdout) == (1, "")
    assert ran.stderr.startswith(f"neurove: {source}: ")
    assert ran.stderr.count("\n") == 1


def test_info_of_a_live_source_says_how_to_record_it(run):
    code, _, err = run("info", "dv://127.0.0.1:7777")
    assert code == 2
    assert "`neurove drive` publishes it, and `neurove record` writes what is published to a file" in err


def test_a_demo_of_a_stream_has_estimates(ports):
    url = f"dv://127.0.0.1:{ports[0]}"
    with dv_writer(ports[0]) as played:
        command = [sys.executable, "-m", "neurove_service.cli", "demo", url, "--seconds", "1", "--json"]
        demo = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
        tell(played, "clients 1")
        t0_us = 1_000_000
        while demo.poll() is None:  # the driver discards what arrives before the service subscribes
            tell(played, f"events 20071 2000 {t0_us}")
            t0_us += 20_000
        out, err = demo.communicate(timeout=120)
    assert demo.returncode == 0, err
    summary = json.loads(out)
    assert summary["sensor"] == {"width": 346, "height": 260}
    assert summary["estimates"] > 0
    assert summary["events_sent"] > 0


def cameras(*words):
    """`neurove cameras` with a made-up EVK4 plugged in."""
    command = [sys.executable, "-m", "tests.live.fake_camera", "0", "cameras", *words]
    return subprocess.run(command, capture_output=True, text=True, timeout=120, check=False, stdin=subprocess.DEVNULL)


def test_cameras_lists_the_command_that_drives_each_one():
    ran = cameras()
    assert f"Prophesee EVK4  USB 3.0 SuperSpeed (5.0 Gb/s)  neurove drive 'camera://evk4?serial={SERIAL}'" in ran.stdout
    assert ran.returncode == 0


def test_cameras_prints_json():
    (found,) = json.loads(cameras("--json").stdout)["cameras"]
    assert (found["model"], found["serial"], found["error"]) == ("evk4", SERIAL, None)


def test_the_report_has_versions_and_no_serial_number_host_or_path():
    ran = cameras("--report", "--json")
    report = json.loads(ran.stdout)
    assert report["versions"].keys() >= {"neurove", "neuromorphic-drivers", "dv-processing", "python"}
    assert report["cameras"] == ["Prophesee EVK4, USB 3.0 SuperSpeed (5.0 Gb/s), neuromorphic-drivers, ok"]
    for private in (SERIAL, socket.gethostname(), sys.prefix):
        assert private not in ran.stdout
