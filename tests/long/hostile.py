"""Streams that do harm: `python -m tests.long.hostile`; two minutes, not part of `make test`.

A node serves one camera of 50 windows/s. In addition it gets, one after the other: malformed packets at full speed,
packets on streams with long names, and sensors of 4096x4096 pixels with a distorted lens. The run prints what the
camera's estimates, the supervisor's pings, the log and the memory of the node show for each.
"""

import argparse
import contextlib
import os
import socket
import tempfile
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import IO

import numpy as np

from neurove_protocol import CameraInfo, Sensor, TwistEstimate
from neurove_protocol.camera import SCHEMA as CAMERA_SCHEMA
from neurove_protocol.events import SCHEMA, encode_packet
from neurove_service.config import ClientConfig
from neurove_service.transport import Transport
from tests.builders import make_packet
from tests.live.conftest import AT_FULL_SPEED, client, free_endpoint, service, wait_until
from tests.long.models import WINDOW_US
from tests.long.overload import processor_s
from tests.long.swaps import Recorded, Resident, ages_ms, cameras, percentiles

LARGE = Sensor(4096, 4096)


class Pings:
    """The supervisor's side: when the node said that it lives."""

    def __init__(self, folder: Path) -> None:
        self.address = str(folder / "notify")
        self.at_s: list[float] = []
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        self._socket.bind(self.address)
        threading.Thread(target=self._run, daemon=True).start()

    def _run(self) -> None:
        while True:
            if b"WATCHDOG=1" in self._socket.recv(4096):
                self.at_s.append(time.monotonic())

    def longest_s(self, since_s: float) -> float:
        """Longest time between two pings since then [s]."""
        return float(np.diff([one for one in self.at_s if one >= since_s - 2] + [time.monotonic()]).max())


def garbage(transport: Transport, config: ClientConfig, _: float) -> str:
    """10,000 malformed packets on one stream."""
    for _number in range(10_000):
        transport.put(config.keys.events("garbage"), b"\x81garbage", SCHEMA)
    return "10,000 malformed packets"


def names(transport: Transport, config: ClientConfig, _: float) -> str:
    """2,000 streams with long names, at once more than the node takes."""
    for number in range(2_000):
        transport.put(f"{config.keys.prefix}/{'x' * 4000}{number}/events", b"garbage", SCHEMA)
    return "2,000 streams with names of 4 kB"


def sensors(transport: Transport, config: ClientConfig, seconds: float) -> str:
    """Three streams of a large sensor with a distorted lens, for some seconds."""
    for number in range(3):
        info = CameraInfo(
            stream=f"large{number}", width=LARGE.width, height=LARGE.height, lens="pinhole",
            fx=2000.0, fy=2000.0, cx=2047.5, cy=2047.5, distortion=(-0.3, 0.1, 0.0, 0.0), height_m=1.0,
        )  # fmt: skip
        transport.put(config.keys.camera(info.stream), info.encode(), CAMERA_SCHEMA)
    end_s, seq = time.monotonic() + seconds, 0
    while time.monotonic() < end_s:
        for number in range(3):
            packet = make_packet(stream=f"large{number}", sensor=LARGE, seq=seq, t0_us=seq * WINDOW_US, n=50)
            transport.put(config.keys.events(packet.stream), encode_packet(packet), SCHEMA)
        seq += 1
        time.sleep(WINDOW_US / 1e6)
    return "3 sensors of 4096x4096"


class LogBytes:
    """Reads what the node writes to its log and counts it."""

    def __init__(self, stream: IO[str]) -> None:
        self.count = 0
        self._stream = stream
        threading.Thread(target=self._run, daemon=True).start()

    def _run(self) -> None:
        while some := os.read(self._stream.fileno(), 1 << 16):
            self.count += len(some)


def unanswered(estimates: list[TwistEstimate]) -> int:
    """Windows between the first and the last of these estimates that have none."""
    return estimates[-1].seq - estimates[0].seq + 1 - len(estimates)


def measure(harm: Callable[[Transport, ClientConfig, float], str], seconds: float) -> str:
    """Serve one camera, do harm, and return one line of figures."""
    endpoint = free_endpoint()
    with contextlib.ExitStack() as stack:
        pings = Pings(Path(stack.enter_context(tempfile.TemporaryDirectory())))
        environment = AT_FULL_SPEED | {"NOTIFY_SOCKET": pings.address}
        process, transport, config = stack.enter_context(service(endpoint, **environment))
        log = LogBytes(process.child.stderr)
        heard = Recorded(stack.enter_context(client(endpoint)), config)
        stack.enter_context(cameras(endpoint, ["cam0"]))
        wait_until(lambda: heard.count("cam0") > 20)
        resident, quiet_from = Resident(process.child.pid), heard.count("cam0")
        time.sleep(5)
        before, began_s, used_s = heard.count("cam0"), time.monotonic(), processor_s(process.child.pid)
        what = harm(transport, config, seconds)
        time.sleep(5)
        took_s, used_s = time.monotonic() - began_s, processor_s(process.child.pid) - used_s
        ping_s, found = pings.longest_s(began_s), heard.of("cam0")
        resident.end()
    quiet, harmed = (percentiles(ages_ms(part)) for part in (found[quiet_from:before], found[before:]))
    return (
        f"{what}: age of the other camera's estimates p50 {quiet['p50']} -> {harmed['p50']} ms, "
        f"p99 {quiet['p99']} -> {harmed['p99']} ms, {unanswered(found[before:])} of its windows unanswered; "
        f"longest time between two pings {ping_s:.1f} s; {used_s / took_s:.2f} cores over {took_s:.0f} s; "
        f"resident at most {resident.most_kib / 1024:.0f} MiB; log {log.count:,} bytes"
    )


def main() -> None:
    """Print a line for each harm."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=20.0, help="time of the large sensors [s]")
    given = parser.parse_args()
    for harm in (garbage, names, sensors):
        print(measure(harm, given.seconds), flush=True)


if __name__ == "__main__":
    main()
