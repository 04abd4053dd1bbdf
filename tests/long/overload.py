"""Overload: `python -m tests.long.overload --load 3.1 12`; a minute each, not part of `make test`.

A node on one core serves so many streams of 50 windows/s that the core would have to be `load` times as fast. The run
prints the share of windows that were answered with all of their events, that share times the load (1 would be what the
core can serve), the share of the service's processor time that went into these windows (the machine may be shared), and
how old the estimates are.
"""

import argparse
import contextlib
import math
import os
import tempfile
import time
from pathlib import Path

import numpy as np

from neurove_core.config import CanonicalConfig, ModelConfig, NetworkConfig, WindowConfig
from neurove_core.estimator import Estimator
from neurove_core.models import bundle
from neurove_protocol import Flag
from tests.builders import SENSOR, make_events
from tests.live.conftest import client, free_endpoint, service, wait_until
from tests.long.models import WINDOW_US
from tests.long.swaps import EVENTS, Recorded, cameras

CONFIG = ModelConfig(
    window=WindowConfig(duration_us=WINDOW_US, bins=5),
    canonical=CanonicalConfig(width=88, height=66),
    network=NetworkConfig(channels=(64, 128), features=256, hidden=256),
)
CLEAN = {Flag.GAP}


def window_ms(model: bundle.Bundle) -> float:
    """Processor time of one window."""
    estimator = Estimator(model)
    events = make_events(EVENTS * 50, duration_us=50 * WINDOW_US)
    took = []
    for _ in range(3):
        state, began = estimator.initial_state(SENSOR), time.thread_time()
        answered = len(estimator.push(events, state, 50 * WINDOW_US).estimates)
        took.append(1e3 * (time.thread_time() - began) / answered)
    return min(took)


def processor_s(pid: int) -> float:
    """Processor time that a process has used [s]."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def run(load: float, seconds: float) -> str:
    """Serve at this load; return one line of figures."""
    model = bundle.untrained(1, CONFIG, "large")
    cost_ms = window_ms(model)
    streams = math.ceil(load * WINDOW_US / 1e3 / cost_ms)
    names = [f"cam{i}" for i in range(streams)]
    endpoint = free_endpoint()
    with contextlib.ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        bundle.save(model, folder / "large.safetensors")
        settings = ("--models-dir", str(folder), "--model", "large", "--max-streams", "1024")
        process, _, config = stack.enter_context(service(endpoint, *settings))
        for thread in Path(f"/proc/{process.child.pid}/task").iterdir():
            os.sched_setaffinity(int(thread.name), {0})
        os.sched_setaffinity(0, os.sched_getaffinity(0) - {0} or {0})  # the cameras and this listener
        heard = Recorded(stack.enter_context(client(endpoint)), config)
        stack.enter_context(cameras(endpoint, names))
        wait_until(lambda: all(heard.count(name) > 3 for name in names), 120)
        time.sleep(5)
        before, used_s = {name: heard.count(name) for name in names}, processor_s(process.child.pid)
        time.sleep(seconds)
        used_s = processor_s(process.child.pid) - used_s
        found = [one for name in names for one in heard.of(name)[before[name] :]]
    clean = [one for one in found if not CLEAN.intersection(one.flags)]
    share = len(clean) / (streams * seconds * 1e6 / WINDOW_US)
    ages_ms = [one.host.age_ns / 1e6 for one in found if one.host is not None] or [math.inf]
    return (
        f"load {load:g} ({streams} streams, {cost_ms:.1f} ms a window): clean {100 * share:.0f} % of the windows, "
        f"{share * load:.2f} of what one core serves, "
        f"{len(clean) * cost_ms / 1e3 / used_s:.2f} of the service's processor time; "
        f"{len(found) - len(clean)} estimates with a gap; "
        f"age p50 {np.percentile(ages_ms, 50):.0f} ms, p99 {np.percentile(ages_ms, 99):.0f} ms"
    )


def main() -> None:
    """Print a line for each load."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--load", type=float, nargs="+", default=[3.1, 12.0], help="times the core")
    parser.add_argument("--seconds", type=float, default=20.0, help="measured time [s]")
    given = parser.parse_args()
    for load in given.load:
        print(run(load, given.seconds), flush=True)


if __name__ == "__main__":
    main()
