"""Model changes under load: `python -m tests.long.swaps --swaps 100 --streams 4`; minutes, not part of `make test`.

A node serves streams of 50 windows/s while its model is changed again and again, now and then by a bundle that is bad.
Prints what was lost or doubled, the longest gap between two estimates with and without changes, what each bad bundle
was refused with, and the resident size over the run. Exit code 1 where a figure of the contract does not hold.
"""

import argparse
import contextlib
import json
import struct
import sys
import tempfile
import threading
import time
from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import safetensors.torch
import torch

from neurove_core import bundle
from neurove_core.bundle import Bundle
from neurove_core.config import CanonicalConfig, ModelConfig, NetworkConfig, WindowConfig
from neurove_core.network import NeuroVE
from protocol import TwistEstimate
from protocol.control import PeerError
from protocol.events import encode_packet
from service import ask
from tests.builders import make_packets
from tests.live.conftest import Heard, Source, client, free_endpoint, service, wait_until

WINDOW_US = 20_000
CONFIG = ModelConfig(
    window=WindowConfig(duration_us=WINDOW_US, bins=5),
    canonical=CanonicalConfig(width=44, height=33),
    network=NetworkConfig(channels=(8, 16), features=32, hidden=32),
)


def make_models(folder: Path) -> list[str]:
    """Two good models and every kind of bad one; returns the names of the bad ones."""
    for seed, name in ((1, "one"), (2, "two")):
        bundle.save(bundle.untrained(seed, CONFIG, name), folder / f"{name}.safetensors")
    good = (folder / "one.safetensors").read_bytes()
    for name, spoil in BAD.items():
        (folder / f"{name}.safetensors").write_bytes(spoil(good))
    with (folder / "too-large.safetensors").open("wb") as file:
        file.truncate(bundle.MAX_BYTES + 1)
    return [*BAD, "too-large"]


def _tensors(change: Callable[[dict[str, torch.Tensor], str], None]) -> Callable[[bytes], bytes]:
    def spoil(good: bytes) -> bytes:
        tensors = safetensors.torch.load(good)
        change(tensors, next(name for name in tensors if name.endswith("weight")))
        (length,) = struct.unpack("<Q", good[:8])
        return safetensors.torch.save(tensors, json.loads(good[8 : 8 + length])["__metadata__"])

    return spoil


def _reshape(tensors: dict[str, torch.Tensor], name: str) -> None:
    tensors[name] = tensors[name].flatten().clone()


def _retype(tensors: dict[str, torch.Tensor], name: str) -> None:
    tensors[name] = tensors[name].double()


def _fill_nan(tensors: dict[str, torch.Tensor], name: str) -> None:
    tensors[name] = tensors[name].fill_(float("nan"))


def _flipped(good: bytes) -> bytes:
    (length,) = struct.unpack("<Q", good[:8])
    place = good.index(b'"F32"', 8, 8 + length) + 1
    return good[:place] + bytes([good[place] ^ 1]) + good[place + 1 :]


def _doubled(good: bytes) -> bytes:
    (length,) = struct.unpack("<Q", good[:8])
    header = good[8 : 8 + length].rstrip()
    header = b'{"__metadata__":{"neurove":"{}"},' + header[1:]
    header += b" " * (-len(header) % 8)
    return struct.pack("<Q", len(header)) + header + good[8 + length :]


def _slow(_: bytes) -> bytes:
    config = CONFIG.model_copy(
        update={
            "canonical": CanonicalConfig(width=1024, height=512),
            "network": NetworkConfig(channels=(64, 64), features=4, hidden=8),
        }
    )
    about = {"name": "too-slow", "trained": False, "provenance": "a test"}
    network = NeuroVE(config).eval()
    return Bundle(**about, config=config, network=network, offset=torch.zeros(6), scale=torch.ones(6)).to_bytes()  # type: ignore[arg-type]


BAD: dict[str, Callable[[bytes], bytes]] = {
    "truncated": lambda good: good[: len(good) // 2],
    "flipped-bit": _flipped,
    "wrong-shape": _tensors(_reshape),
    "wrong-dtype": _tensors(_retype),
    "nan": _tensors(_fill_nan),
    "duplicate-keys": _doubled,
    "too-slow": _slow,
    "foreign": lambda _: b"PNG, or anything else that is no model" * 100,
    "empty": lambda _: b"",
}


class Camera:
    """Publishes one packet per window, paced, until it is told to end."""

    def __init__(self, endpoint: str, config: ask.ClientConfig, stream: str) -> None:
        packets = make_packets(50, stream=stream, n=400, step_us=WINDOW_US)
        self._packets, self._stop = packets, threading.Event()
        self._endpoint, self._config, self._stream = endpoint, config, stream
        self._thread = threading.Thread(target=self._run)
        self._thread.start()

    def _run(self) -> None:
        with client(self._endpoint) as transport:
            source = Source(transport, self._config, self._stream)
            began, seq = time.monotonic(), 0
            while not self._stop.wait(max(0.0, began + seq * WINDOW_US / 1e6 - time.monotonic())):
                packet = self._packets[seq % len(self._packets)]
                by_us = seq * WINDOW_US - packet.t0_us
                events = packet.events._replace(t=packet.events.t + by_us)
                source.put(encode_packet(replace(packet, seq=seq, t0_us=seq * WINDOW_US, events=events)))
                seq += 1

    def end(self) -> None:
        self._stop.set()
        self._thread.join()


def resident_kib(pid: int) -> int:
    """Resident size of a process [KiB]."""
    lines = Path(f"/proc/{pid}/status").read_text().splitlines()
    return next(int(line.split()[1]) for line in lines if line.startswith("VmRSS:"))


def longest_gap_ms(estimates: list[TwistEstimate]) -> float:
    """Longest time between two estimates of one stream that were published one after the other [ms]."""
    times = [one.trace.published_ns for one in estimates]
    return max((b - a for a, b in pairwise(times)), default=0) / 1e6


def run(swaps: int, bad: int, streams: int, quiet_s: float = 5.0, pause_s: float = 0.0) -> dict[str, object]:
    """Change the model so often, so many of the changes by a bad bundle, and tell what came of it."""
    endpoint, names = free_endpoint(), [f"cam{i}" for i in range(streams)]
    with contextlib.ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        kinds = make_models(folder)
        arguments = ("--models-dir", str(folder), "--model", "one", "--queue-s", "30", "--probation-s", "0.5")
        process, transport, config = stack.enter_context(service(endpoint, *arguments))
        heard = Heard(stack.enter_context(client(endpoint)), config)
        cameras = [Camera(endpoint, config, name) for name in names]
        for camera in cameras:
            stack.callback(camera.end)
        wait_until(lambda: all(len(heard.of(name)) > 10 for name in names), 60)
        skip = {name: len(heard.of(name)) for name in names}
        time.sleep(quiet_s)
        calm = {name: len(heard.of(name)) for name in names}
        refused: dict[str, str] = {}
        unrefused, resident, active = [], [resident_kib(process.child.pid)], "one"
        is_bad = set(np.linspace(0, swaps - 1, bad, dtype=int).tolist()) if bad else set()
        for number in range(swaps):
            if number in is_bad:
                kind = kinds[sorted(is_bad).index(number) % len(kinds)]
                try:
                    ask.activate(transport, config, kind, "n1")
                    unrefused.append(kind)
                except PeerError as error:
                    refused[kind] = f"{error.code}: {error.message}"
            else:
                active = "two" if active == "one" else "one"
                ask.activate(transport, config, active, "n1")
            resident.append(resident_kib(process.child.pid))
            print(f"change {number + 1} of {swaps}: {resident[-1] >> 10} MiB", file=sys.stderr)
            time.sleep(pause_s)
        time.sleep(1.0)
        health = ask.health(transport, config)[0]
        wrong = health.model.name != active
        for camera in cameras:
            camera.end()
        of = {name: heard.of(name) for name in names}
    quarter = resident[-max(2, len(resident) // 4) :]
    return {
        "swaps": swaps,
        "epochs": sorted({one.epoch for all_of in of.values() for one in all_of})[-1],
        "estimates": {name: len(one) for name, one in of.items()},
        "lost_or_doubled": sum(b.start_us != a.end_us for one in of.values() for a, b in pairwise(one)),
        "lost": {status.stream: status.lost.nonzero() for status in health.streams},
        "gap_ms_without": round(max(longest_gap_ms(one[skip[name] : calm[name]]) for name, one in of.items()), 1),
        "gap_ms_with": round(max(longest_gap_ms(one[calm[name] :]) for name, one in of.items()), 1),
        "refused": refused,
        "not_refused": unrefused,
        "active_is_wrong": wrong,
        "rollbacks": health.rollbacks,
        "resident_mib": {
            "start": resident[0] >> 10,
            "end": resident[-1] >> 10,
            "most": max(resident) >> 10,
            "last_quarter": [min(quarter) >> 10, max(quarter) >> 10],
        },
    }


def holds(report: dict[str, object]) -> bool:
    """Whether no window was lost or doubled, and every bad bundle was refused."""
    return not (report["lost_or_doubled"] or report["not_refused"] or report["active_is_wrong"])


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--swaps", type=int, default=100)
    parser.add_argument("--bad", type=int, default=20, help="so many of them by a bad bundle")
    parser.add_argument("--streams", type=int, default=4)
    parser.add_argument("--quiet-s", type=float, default=10.0, help="without a change before, to compare with")
    given = parser.parse_args()
    told = run(given.swaps, given.bad, given.streams, given.quiet_s)
    print(json.dumps(told, indent=2))
    sys.exit(0 if holds(told) else 1)
