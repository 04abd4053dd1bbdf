"""A dv network stream in a process of its own: `python -m tests.live.dv_writer [--imu] [--compress lz4] PORT...`.

dv-processing's NetworkWriter waits without end if it is released while a reader is connected, so this process never
releases one. It prints `ready`, then does each line that it reads from stdin:

    clients N         wait until N readers are connected
    events SEED N T0  send N events from T0 us on, 10 us apart, in batches of 1,000
    events SEED N T0 PER_MS  the same with PER_MS events in each ms, in batches of 10 ms, all made before the first
    imu N T0          send N samples from T0 us on, 1 ms apart
    end               end without a farewell
"""

import argparse
import os
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np

from neurove_protocol import Events, Sensor

DV_SENSOR = Sensor(346, 260)
BATCH = 1000


def dv_events(seed: int, n: int, t0_us: int, per_ms: int = 100) -> Events:
    """The events that a writer sends."""
    rng = np.random.default_rng(seed)
    x, y, p = (rng.integers(0, bound, n) for bound in (DV_SENSOR.width, DV_SENSOR.height, 2))
    return Events.from_columns(t0_us + 1000 * np.arange(n) // per_ms, x, y, p)


def store_of(events: Events) -> Any:
    """Events as dv-processing has them."""
    import dv_processing as dv

    store = dv.EventStore()
    for t, x, y, p in zip(*(column.tolist() for column in events), strict=True):
        store.push_back(t, x, y, bool(p))
    return store


def sample(i: int, t_us: int) -> Any:
    """Inertial sample number i: 1 g down the y axis of dv, and a turn of i deg/s about its z axis."""
    import dv_processing as dv

    return dv.IMU(t_us, 25.0, 0.0, 1.0, 0.0, 0.0, 0.0, float(i), 0.0, 0.0, 0.0)


@contextmanager
def dv_writer(*ports: int, compress: str = "none", imu: bool = False) -> Iterator[subprocess.Popen[str]]:
    """A writer that is ready; ended with its process."""
    words = [*(["--imu"] if imu else []), "--compress", compress, *map(str, ports)]
    child = subprocess.Popen(
        [sys.executable, "-m", "tests.live.dv_writer", *words],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
        bufsize=1,
    )
    assert child.stdin is not None
    assert child.stdout is not None
    try:
        assert child.stdout.readline() == "ready\n"
        yield child
    finally:
        child.kill()
        child.wait()
        child.stdin.close()
        child.stdout.close()


def tell(child: subprocess.Popen[str], *lines: str) -> None:
    """Give a writer something to do, and wait until it has done it."""
    assert child.stdin is not None
    assert child.stdout is not None
    for line in lines:
        child.stdin.write(f"{line}\n")
        assert child.stdout.readline() == ("" if line == "end" else "done\n")


def ask(child: subprocess.Popen[str], *lines: str) -> None:
    """Give a writer something to do, and do not wait."""
    assert child.stdin is not None
    child.stdin.write("".join(f"{line}\n" for line in lines))


def main() -> None:
    import dv_processing as dv

    parser = argparse.ArgumentParser()
    parser.add_argument("ports", type=int, nargs="+")
    parser.add_argument("--imu", action="store_true")
    parser.add_argument("--compress", default="none")
    args = parser.parse_args()
    kinds = {"none": "NONE", "lz4": "LZ4", "zstd": "ZSTD"}
    streams = [dv.io.Stream.EventStream(0, "events", "Synthetic", (DV_SENSOR.width, DV_SENSOR.height))]
    streams += [dv.io.Stream.IMUStream(0, "imu", "Synthetic")] if args.imu else []
    writers = []
    for port, stream in zip(args.ports, streams, strict=True):
        stream.setCompression(getattr(dv.CompressionType, kinds[args.compress]))
        writers.append(dv.io.NetworkWriter("127.0.0.1", port, stream))
    print("ready", flush=True)
    for line in sys.stdin:
        word, *numbers = line.split()
        given = [int(one) for one in numbers]
        if word == "end":
            os._exit(0)
        elif word == "clients":
            while sum(one.getClientCount() for one in writers) < given[0]:
                threading.Event().wait(0.005)
        elif word == "events":
            events = dv_events(*given)
            batch = 10 * (given[3] if given[3:] else BATCH // 10)
            spans = [events.span(first, min(first + batch, events.n)) for first in range(0, events.n, batch)]
            for store in [store_of(one) for one in spans]:
                writers[0].writeEvents(store)
        elif word == "imu":
            samples = dv.IMUPacket.ImuVector([sample(i, given[1] + 1000 * i) for i in range(given[0])])
            writers[1].writeImu(samples)
        while any(one.getQueuedPacketCount() for one in writers):
            threading.Event().wait(0.002)
        print("done", flush=True)


if __name__ == "__main__":
    main()
