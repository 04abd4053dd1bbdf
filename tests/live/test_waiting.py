"""Clients that start before the service, and a service that stops answering while clients watch."""

import json
import signal

import pytest

from neurove_core.io.formats.packet_log.writer import PacketWriter
from neurove_protocol.events import encode_packet
from tests.builders import make_packets
from tests.live.conftest import free_endpoint, running, service

pytestmark = pytest.mark.live


def line_with(stream, words):
    """The next line of a process's output that has these words; its reader waits until there is one."""
    for line in stream:
        if words in line:
            return line
    return pytest.fail(f"the output ended without {words!r}")


def test_driver_and_consumer_that_start_before_the_service_wait_for_it():
    endpoint = free_endpoint()
    with (
        running("watch", "--connect", endpoint, "--json", "--count", "3", "--wait", "180") as watch,
        running("drive", "pattern://", "--connect", endpoint, "--wait", "180") as drive,
    ):
        waits = f"neurove: waiting up to 180 s (--wait) for a service at {endpoint}\n"
        assert watch.child.stderr.readline() == waits
        assert drive.child.stderr.readline() == waits
        with service(endpoint):
            out, _ = watch.child.communicate(timeout=60)
    assert watch.child.returncode == 0
    found = [json.loads(line) for line in out.splitlines()]
    assert len(found) == 3
    assert all(found[-1]["twist"].keys() == {"vx", "vy", "vz", "wx", "wy", "wz"} and one["sigma"] for one in found)


def test_watch_says_since_when_a_stopped_service_is_silent_and_when_it_answers_again(run):
    endpoint = free_endpoint()
    with (
        service(endpoint) as (node, _, _),
        running("drive", "pattern://", "--connect", endpoint, "--stream", "cam1"),
        running("watch", "--connect", endpoint) as watch,
    ):
        line_with(watch.child.stdout, "cam1 ")
        once = run("watch", "--connect", endpoint, "--once")
        assert (once.code, len(once.out.splitlines())) == (0, 1)
        assert once.out.startswith("cam1 ")
        node.child.send_signal(signal.SIGSTOP)
        line_with(watch.child.stderr, "cam1: no estimate since ")
        node.child.send_signal(signal.SIGCONT)
        line_with(watch.child.stderr, "cam1: estimates again")


LENS = """cam0:
  camera_model: pinhole
  intrinsics: [32, 24, 31.5, 23.5]
  distortion_model: none
  distortion_coeffs: []
  resolution: [64, 48]
"""


def test_a_driver_publishes_the_lens_and_the_height_that_the_user_gives(run, tmp_path):
    (tmp_path / "lens.yaml").write_text(LENS)
    with PacketWriter(tmp_path / "log.mcap") as log:
        for packet in make_packets(1500, stream="left"):
            log.write("left", encode_packet(packet), packet.t0_us * 1000)
    endpoint = free_endpoint()
    given = ("--calibration", str(tmp_path / "lens.yaml"), "--height", "0.4")
    with (
        service(endpoint),
        running("drive", str(tmp_path / "log.mcap"), "--connect", endpoint, *given),
        running("drive", "pattern://", "--connect", endpoint, "--stream", "right", "--height", "0.4"),
        running("watch", "--connect", endpoint, "--json") as watch,
    ):
        for name in ("left", "right"):
            flags = json.loads(line_with(watch.child.stdout, f'"stream": "{name}"'))["flags"]
            assert not {"uncalibrated", "unscaled"} & set(flags), name
