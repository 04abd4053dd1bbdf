"""A long replay at a high rate: `python -m tests.long.replay --rate 10e6 --seconds 60`; not part of `make test`.

`neurove drive --loop` plays an EVT3 file to `neurove serve`; both are real processes with Zenoh on loopback. The run
prints the event rate, the losses, latencies, CPU time, and the resident size of the service in each quarter. The exit
code is 1 if events were lost, or if the resident size grew by more than 5 % after the first quarter.
"""

import argparse
import contextlib
import json
import os
import sys
import tempfile
import time
from itertools import pairwise
from pathlib import Path
from typing import Any, Final

import numpy as np
import torch

from neurove_core.config import CanonicalConfig, ModelConfig
from neurove_core.estimator import Estimator
from neurove_core.models import bundle
from neurove_protocol import Events, Sensor
from neurove_service.clients import ask
from neurove_service.config import ServiceConfig
from neurove_service.streams.ring import Ring, pack
from tests.live.conftest import Heard, client, free_endpoint, running, service, wait_until
from tests.long.swaps import resident_kib

FILE_S: Final = 1.0
STREAM: Final = "cam0"
SAMPLES: Final = 200  # of resident size
SENSORS: Final = {"davis346": Sensor(346, 260), "1280x720": Sensor(1280, 720)}


def draw(rate_hz: float, sensor: Sensor, seconds: float = FILE_S, seed: int = 0) -> Events:
    """Events of a moving bar over noise, with rows and columns as those of a moving camera."""
    rng = np.random.default_rng(seed)
    n = int(rate_hz * seconds)
    t = np.sort(rng.integers(0, int(seconds * 1e6), n))
    along = (t * (sensor.width / 2e5)).astype(np.int64) + rng.integers(0, 40, n)
    x = np.where(rng.random(n) < 0.5, along, rng.integers(0, sensor.width, n)) % sensor.width
    return Events.from_columns(t, x, rng.integers(0, sensor.height, n), rng.integers(0, 2, n))


def write_evt3(events: Events, sensor: Sensor, path: Path) -> None:
    """Write each event as one word, with TIME_HIGH, TIME_LOW and ADDR_Y if they change."""
    t, y = events.t, events.y.astype(np.int64)
    kinds = (0x8000 | t >> 12, 0x6000 | t & 0xFFF, y, 0x2000 | events.p.astype(np.int64) << 11 | events.x)
    words = np.stack(kinds)
    written = np.ones(words.shape, np.bool_)
    for row, value in enumerate((t >> 12, t, y)):
        written[row, 1:] = np.diff(value) != 0
    header = f"% evt 3.0\n% format EVT3;height={sensor.height};width={sensor.width}\n% end\n"
    path.write_bytes(header.encode() + words.T[written.T].astype("<u2").tobytes())


def cpu_s(pid: int) -> float:
    """CPU time of a process so far [s]."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def run(rate_hz: float, seconds: float, sensor: Sensor) -> dict[str, Any]:
    """Play events at a rate for some seconds; return the figures."""
    endpoint = free_endpoint()
    with contextlib.ExitStack() as stack:
        path = Path(stack.enter_context(tempfile.TemporaryDirectory())) / "replay.raw"
        write_evt3(draw(rate_hz, sensor), sensor, path)
        node, transport, config = stack.enter_context(service(endpoint))
        heard = Heard(stack.enter_context(client(endpoint)), config)
        playing = ("--loop", "--seconds", str(seconds), "--stream", STREAM, "--json")
        driver = stack.enter_context(running("drive", str(path), "--connect", endpoint, *playing))
        wait_until(lambda: len(heard.of(STREAM)) > 0, 180)
        began, spent_s, start_s = time.monotonic(), cpu_s(node.child.pid), cpu_s(driver.child.pid)
        driven_s, resident = start_s, []
        while driver.child.poll() is None:
            with contextlib.suppress(OSError, ValueError, IndexError):  # it may end between two samples
                driven_s = cpu_s(driver.child.pid)
            resident.append(resident_kib(node.child.pid))
            time.sleep(seconds / SAMPLES)
        took_s, spent_s = time.monotonic() - began, cpu_s(node.child.pid) - spent_s
        wait_until(lambda: _settled(heard), 30)
        (status,) = (one for one in ask.health(transport, config)[0].streams if one.stream == STREAM)
        sent = json.loads(driver.end()[1])
        estimates = heard.of(STREAM)
    latencies_ms = [one.trace.latency_ms for one in estimates]
    quarters = np.array_split(np.array(resident) / 1024, 4)
    return {
        "asked_mev_s": rate_hz / 1e6,
        "sent_mev_s": round(sent["events"] / took_s / 1e6, 2),
        "events_sent": sent["events"],
        "events_received": status.events_received,
        "packets_sent": sent["packets"],
        "packets_received": status.packets_received,
        "lost": status.lost.nonzero(),
        "estimates": len(estimates),
        "gaps": sum(b.start_us != a.end_us for a, b in pairwise(estimates)),
        "latency_ms": {f"p{q}": round(float(np.percentile(latencies_ms, q)), 1) for q in (50, 99, 100)},
        "cpu_of_a_core": {"service": round(spent_s / took_s, 2), "driver": round((driven_s - start_s) / took_s, 2)},
        "resident_mib": [[round(float(q.min()), 1), round(float(q.max()), 1)] for q in quarters],
        "state_bytes": {name: state_bytes(SENSORS[name], grid) for name, grid in GRIDS.items()},
    }


def _settled(heard: Heard, quiet_s: float = 1.0) -> bool:
    before = len(heard.of(STREAM))
    time.sleep(quiet_s)
    return len(heard.of(STREAM)) == before


GRIDS: Final = {
    "davis346": CanonicalConfig(width=173, height=130),  # half of it
    "1280x720": CanonicalConfig(width=320, height=180),  # a quarter
}


def state_bytes(sensor: Sensor, grid: CanonicalConfig) -> int:
    """Memory of a stream with this sensor when its ring is full: all arrays of its state, and the ring [bytes]."""
    estimator = Estimator(bundle.untrained(0, ModelConfig(canonical=grid)))
    duration_us = estimator.config.window.duration_us
    settings, state = ServiceConfig(), estimator.initial_state(sensor)
    ring = Ring(settings.ring_windows, settings.ring_mib << 20)
    events = draw(10e6, sensor, duration_us / 1e6)
    for number in range(settings.ring_windows + 2):
        shift_us = number * duration_us
        pushed = estimator.to_windows(events._replace(t=events.t + shift_us), state, shift_us)
        _, state = estimator.follow(pushed.windows, state._replace(windows=pushed.state))
        for window in pushed.windows:
            ring.append(pack(window))
    return sum(_arrays(state).values()) + ring.bytes


def _arrays(value: object) -> dict[int, int]:
    """Bytes of all arrays and tensors in nested tuples, each counted once, with the base of a view."""
    if isinstance(value, torch.Tensor):
        return {value.untyped_storage().data_ptr(): value.untyped_storage().nbytes()}
    if isinstance(value, np.ndarray):
        whole = value.base if isinstance(value.base, np.ndarray) else value
        return {whole.ctypes.data: whole.nbytes}
    return {key: size for part in value for key, size in _arrays(part).items()} if isinstance(value, tuple) else {}


def holds(report: dict[str, Any]) -> bool:
    """Whether every sent event is part of an estimate, and the resident size stayed constant."""
    first, last = report["resident_mib"][1], report["resident_mib"][-1]
    all_arrived = report["events_received"] == report["events_sent"] and not report["lost"] and not report["gaps"]
    return bool(all_arrived and last[1] <= 1.05 * first[0])


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rate", type=float, default=10e6, help="events a second")
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--sensor", choices=list(SENSORS), default="1280x720")
    given = parser.parse_args()
    report = run(given.rate, given.seconds, SENSORS[given.sensor])
    print(json.dumps(report, indent=2))
    sys.exit(0 if holds(report) else 1)
