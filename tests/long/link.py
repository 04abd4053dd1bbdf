"""Events while a model is pushed over a slow link: `python -m tests.long.link [--mbit 20] [--mib 8]`; needs root.

Two network namespaces have a pair of virtual interfaces between them and a token bucket (tbf) on both. The node runs in
one; a driver, a consumer and `neurove push` run in the other. The run prints the transfer time of events to the node
without a push and during it. The exit code is 1 if the 99th percentile has more than doubled.
"""

import argparse
import contextlib
import json
import os
import shutil
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from neurove_core.config import CanonicalConfig, ModelConfig, NetworkConfig, WindowConfig
from neurove_core.models import bundle
from neurove_protocol import TwistEstimate
from neurove_protocol.events import encode_packet
from neurove_service.clients import ask
from neurove_service.config import ClientConfig
from tests.builders import make_packets
from tests.live.conftest import START_S, Source, client, is_alive, neurove, wait_until

STEP_US, EVENTS = 10_000, 500  # a packet each 10 ms of 3 kB: 2.4 Mbit/s
WARM_S = 5.0
HERE, THERE = "10.213.77.1", "10.213.77.2"
WINDOW = WindowConfig(duration_us=STEP_US, bins=2)


def model(mib: float) -> bundle.Bundle:
    """A model with a size of `mib` MiB that is fast to run."""
    features = max(8, round(mib * (1 << 20) / 4 / 1584))
    canonical, net = CanonicalConfig(width=44, height=33), NetworkConfig(channels=(8, 16), features=features, hidden=8)
    return bundle.untrained(1, ModelConfig(window=WINDOW, canonical=canonical, network=net), "pushed")


@contextlib.contextmanager
def namespaces(mbit: float) -> Iterator[tuple[str, str]]:
    """Names of two network namespaces with a link of `mbit` Mbit/s between them."""
    names = [f"neurove{os.getpid()}{part}" for part in "ab"]
    made = []
    try:
        for name in names:
            _run("ip", "netns", "add", name)
            made.append(name)
        _run("ip", "link", "add", "v0", "netns", names[0], "type", "veth", "peer", "name", "v0", "netns", names[1])
        for name, address in zip(names, (HERE, THERE), strict=True):
            inside = ("ip", "netns", "exec", name)
            _run(*inside, "ip", "address", "add", f"{address}/24", "dev", "v0")
            for device in ("lo", "v0"):
                _run(*inside, "ip", "link", "set", device, "up")
            shape = ("rate", f"{mbit:g}mbit", "burst", "16kb", "latency", "400ms")
            _run(*inside, "tc", "qdisc", "add", "dev", "v0", "root", "tbf", *shape)
        yield names[0], names[1]
    finally:
        for name in made:
            _run("ip", "netns", "delete", name)


def _run(*command: str) -> None:
    subprocess.run(command, check=True, capture_output=True, text=True)


class Driver(threading.Thread):
    """Publishes packets, paced, and records when each was sent."""

    def __init__(self, source: Source) -> None:
        super().__init__()
        self._source, self._ended = source, threading.Event()
        self._packets = make_packets(50, n=EVENTS, step_us=STEP_US)
        self.sent_ns: list[int] = []

    def run(self) -> None:
        began, seq = time.monotonic(), 0
        while not self._ended.wait(max(0.0, began + seq * STEP_US / 1e6 - time.monotonic())):
            packet = self._packets[seq % len(self._packets)]
            t0_us = seq * STEP_US
            events = packet.events._replace(t=packet.events.t + t0_us - packet.t0_us)
            payload = encode_packet(replace(packet, seq=seq, t0_us=t0_us, events=events))
            self.sent_ns.append(time.monotonic_ns())
            self._source.put(payload)
            seq += 1

    def end(self) -> None:
        self._ended.set()
        self.join()


def inside(endpoint: str, file: Path, quiet_s: float) -> dict[str, Any]:
    """Measure in the namespace of the driver and the operator: time from the put of a packet to the node."""
    config = ClientConfig(connect=(endpoint,))
    payloads: list[bytes] = []
    with client(endpoint, START_S) as transport, client(endpoint) as ours:
        wait_until(lambda: is_alive(transport, config), START_S)
        transport.subscribe(config.keys.velocity(), lambda _, payload, __: payloads.append(payload))
        driver = Driver(Source(ours, config, "cam0"))
        driver.start()
        wait_until(lambda: len(payloads) > 100)
        time.sleep(WARM_S)
        quiet = time.monotonic_ns()
        time.sleep(quiet_s)
        began = time.monotonic_ns()
        pushed = neurove("push", str(file), "--node", "n1", "--connect", endpoint, timeout_s=600)
        ended = time.monotonic_ns()
        time.sleep(quiet_s)
        driver.end()
        lost = ask.health(transport, config)[0].streams[0].lost.nonzero()
    spans = {"without": [(quiet, began), (ended, driver.sent_ns[-1])], "with": [(began, ended)]}
    took: dict[str, list[float]] = {name: [] for name in spans}
    for estimate in map(TwistEstimate.decode, payloads):
        sent_ns = driver.sent_ns[estimate.end_us // STEP_US]  # the packet that begins at its end completes a window
        for name, parts in spans.items():
            if any(a <= sent_ns < b for a, b in parts):
                took[name].append((estimate.trace.received_ns - sent_ns) / 1e6)
    shown = (50, 95, 99, 100)
    percentiles = {name: {f"p{p}": round(float(np.percentile(ms, p)), 2) for p in shown} for name, ms in took.items()}
    seconds = (ended - began) / 1e9
    return {
        "events_ms": percentiles,
        "p99_ratio": round(percentiles["with"]["p99"] / percentiles["without"]["p99"], 2),
        "packets": {name: len(ms) for name, ms in took.items()},
        "pushed": pushed.returncode == 0,
        "push_s": round(seconds, 1),
        "push_mbit_s": round(8 * file.stat().st_size / seconds / 1e6, 1),
        "lost": lost,
    }


def measure(mbit: float, mib: float, quiet_s: float) -> dict[str, Any]:
    """Make the namespaces; run the node in one and `inside` in the other."""
    with namespaces(mbit) as (node, remote), tempfile.TemporaryDirectory() as folder:
        models, endpoint = Path(folder) / "models", f"tcp/{HERE}:7447"
        models.mkdir()
        bundle.save(replace(model(0.1), name="small"), models / "small.safetensors")
        bundle.save(model(mib), Path(folder) / "pushed.safetensors")
        serve = ("serve", "--listen", endpoint, "--node", "n1", "--models-dir", str(models), "--model", "small")
        command = [
            "ip",
            "netns",
            "exec",
            node,
            sys.executable,
            "-m",
            "neurove_service.cli",
            *serve,
            "--log-level",
            "warning",
        ]
        with subprocess.Popen(command) as service:
            try:
                again = ("--inside", endpoint, f"{folder}/pushed.safetensors", "--quiet-s", str(quiet_s))
                measured = subprocess.run(
                    ["ip", "netns", "exec", remote, sys.executable, "-m", "tests.long.link", *again],
                    check=True,
                    stdout=subprocess.PIPE,
                    text=True,
                )
            finally:
                service.terminate()
    return {"mbit_s": mbit, **json.loads(measured.stdout.splitlines()[-1])}  # the line after the log


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--mbit", type=float, default=20.0)
    parser.add_argument("--mib", type=float, default=16.0, help="size of the model")
    parser.add_argument("--quiet-s", type=float, default=10.0, help="duration without a push, before and after it")
    parser.add_argument("--inside", nargs=2, metavar=("ENDPOINT", "FILE"), help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.inside:
        print(json.dumps(inside(args.inside[0], Path(args.inside[1]), args.quiet_s)))
        return 0
    if os.geteuid() != 0 or shutil.which("ip") is None or shutil.which("tc") is None:
        print("tests.long.link: needs root, for network namespaces, and ip and tc of iproute2", file=sys.stderr)
        return 2
    report = measure(args.mbit, args.mib, args.quiet_s)
    print(json.dumps(report, indent=2))
    return 0 if report["pushed"] and report["p99_ratio"] <= 2 and not report["lost"] else 1


if __name__ == "__main__":
    sys.exit(main())
