"""Model changes under load: `python -m tests.long.swaps --swaps 100 --streams 4`; minutes, not part of `make test`.

A node serves streams of 50 windows/s while its model is changed again and again, sometimes to a bad bundle. The run
prints the windows that were lost or answered twice, the estimates that only this listener missed, the longest gap
between two estimates with and without changes, the reason for each refusal, and the resident size. The exit code is 1
if a figure of the contract does not hold.
"""

import argparse
import contextlib
import gc
import json
import signal
import sys
import tempfile
import threading
import time
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from neurove_protocol import TwistEstimate
from neurove_protocol.control import PeerError
from neurove_service.clients import ask
from neurove_service.config import ClientConfig
from neurove_service.transport import Transport
from tests.live.conftest import Process, client, free_endpoint, service, wait_until
from tests.long.models import GOOD, REASONS, WINDOW_US, Made

EVENTS = 400
"""Events per packet; one packet per window."""


MAX_P99_MS = 100.0
"""Bound of the 99th percentile of an estimate's age during changes [ms]."""

PAUSE_S = 0.2
"""Pause between two changes [s]."""


class Gap(NamedTuple):
    """A time between two estimates of a stream."""

    ms: float
    late_ms: float  # the part between the arrival of the packet and its estimate
    stream: str
    at_ns: int


class Marks:
    """Log of the running steps with their times."""

    def __init__(self) -> None:
        self._marks: list[tuple[int, str]] = []

    def set(self, what: str) -> None:
        self._marks.append((time.monotonic_ns(), what))

    def at(self, ns: int) -> str:
        return next((what for when, what in reversed(self._marks) if when <= ns), "before")


class Recorded:
    """Estimates as they arrived, decoded after the run, so that the listener does not slow the service down."""

    def __init__(self, transport: Transport, config: ClientConfig) -> None:
        self._payloads: dict[str, list[bytes]] = {}
        transport.subscribe(config.keys.velocity(), self._append)
        self._stream_of = config.keys.stream_of

    def _append(self, key: str, payload: bytes, _: int) -> None:
        self._payloads.setdefault(self._stream_of(key), []).append(payload)

    def count(self, stream: str) -> int:
        return len(self._payloads.get(stream, ()))

    def of(self, stream: str) -> list[TwistEstimate]:
        return [TwistEstimate.decode(payload) for payload in self._payloads[stream]]


def resident_kib(pid: int) -> int:
    """Resident size of a process."""
    lines = Path(f"/proc/{pid}/status").read_text().splitlines()
    return next(int(line.split()[1]) for line in lines if line.startswith("VmRSS:"))


class Resident:
    """Samples the resident size of a process, also between the changes."""

    def __init__(self, pid: int, period_s: float = 0.1) -> None:
        self._pid, self._period_s = pid, period_s
        self.most_kib = self.kib()
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def kib(self) -> int:
        return resident_kib(self._pid)

    def _run(self) -> None:
        while not self._stop.wait(self._period_s):
            self.most_kib = max(self.most_kib, self.kib())

    def end(self) -> None:
        self._stop.set()
        self._thread.join()


def gaps(estimates: list[TwistEstimate]) -> list[Gap]:
    """The times between consecutive estimates of one stream."""
    found = []
    for before, after in pairwise(one.trace for one in estimates):
        apart = after.published_ns - before.published_ns
        late = after.published_ns - max(after.received_ns, before.published_ns)
        found.append(Gap(apart / 1e6, late / 1e6, "", before.published_ns))
    return found


def ages_ms(estimates: list[TwistEstimate]) -> Any:
    """How much later each estimate is published than the quickest one, by the time of its window [ms].

    It includes what the driver, the link and the queue of the node add, because cameras send in the pace of windows.
    """
    late = np.array([one.trace.published_ns / 1e6 - one.end_us / 1e3 for one in estimates])
    return late - late.min()


def percentiles(ages: Any) -> dict[str, float]:
    """Median, 99th percentile and largest value."""
    return {"p50": round(float(np.median(ages)), 1), "p99": round(float(np.percentile(ages, 99)), 1)} | {
        "most": round(float(ages.max()), 1)
    }


def follows(before: TwistEstimate, after: TwistEstimate) -> bool:
    """Whether every window between two estimates was answered once; an estimate that the listener missed has a seq."""
    return after.seq > before.seq and after.start_us - before.end_us == (after.seq - before.seq - 1) * WINDOW_US


@contextlib.contextmanager
def cameras(endpoint: str, names: list[str]) -> Any:
    process = Process(endpoint, str(WINDOW_US), str(EVENTS), *names, module="tests.long.cameras")
    try:
        yield
    finally:
        process.end(signal.SIGTERM)


def run(swaps: int, bad: int, streams: int, quiet_s: float = 5.0) -> dict[str, Any]:
    """Change the model `swaps` times, `bad` of them to a bad bundle; return the figures."""
    endpoint, names = free_endpoint(), [f"cam{i}" for i in range(streams)]
    marks = Marks()
    with contextlib.ExitStack() as stack:
        made = Made(Path(stack.enter_context(tempfile.TemporaryDirectory())))
        arguments = ("--models-dir", str(made.folder), "--model", "one", "--trusted-keys", str(made.trusted))
        process, transport, config = stack.enter_context(service(endpoint, *arguments, "--queue-s", "30"))
        heard = Recorded(stack.enter_context(client(endpoint)), config)
        flow = stack.enter_context(contextlib.ExitStack())
        flow.enter_context(cameras(endpoint, names))
        wait_until(lambda: all(heard.count(name) > 100 for name in names), 60)
        skip = {name: heard.count(name) for name in names}
        time.sleep(quiet_s)
        calm = {name: heard.count(name) for name in names}
        memory = Resident(process.child.pid)
        refused: dict[str, tuple[str, str]] = {}
        unrefused, resident, active = [], [memory.kib()], GOOD[0]
        is_bad = set(np.linspace(1, swaps - 1, bad, dtype=int).tolist()) if bad else set()
        with contextlib.suppress(KeyboardInterrupt):  # after Ctrl-C the figures so far are reported
            for number in range(swaps):
                is_next_bad = number in is_bad
                if is_next_bad:
                    model = made.bad[sorted(is_bad).index(number) % len(made.bad)]
                else:
                    model = active = GOOD[active == GOOD[0]]
                marks.set(f"{model}: asked")
                try:
                    ask.activate(
                        transport, config, model, "n1", on_progress=lambda step, m=model: marks.set(f"{m}: {step.step}")
                    )
                    unrefused += [model] * is_next_bad
                except PeerError as error:
                    refused[model] = error.code, error.message
                marks.set(f"{model}: answered")
                time.sleep(PAUSE_S)  # the answer precedes the release of the memory
                resident.append(memory.kib())
                print(f"change {number + 1} of {swaps}, {model}: {resident[-1] >> 10} MiB", file=sys.stderr)
        time.sleep(1.0)
        memory.end()
        health = ask.health(transport, config)[0]
        flow.close()
        of = {name: heard.of(name) for name in names}
    found = [gap._replace(stream=name) for name, one in of.items() for gap in gaps(one[calm[name] :])]
    longest = sorted(found, reverse=True)[:8]
    without = max(gap.ms for name, one in of.items() for gap in gaps(one[skip[name] : calm[name]]))
    ages = {name: ages_ms(one[skip[name] :]) for name, one in of.items()}
    model_kib = made.model_bytes >> 10
    quarter = resident[-max(2, len(resident) // 4) :]
    return {
        "swaps": len(resident) - 1,
        "epochs": sorted({one.epoch for all_of in of.values() for one in all_of})[-1],
        "estimates": {name: len(one) for name, one in of.items()},
        "lost_or_doubled": sum(not follows(a, b) for one in of.values() for a, b in pairwise(one)),
        "not_received": sum(b.seq - a.seq - 1 for one in of.values() for a, b in pairwise(one) if follows(a, b)),
        "lost": {status.stream: status.lost.nonzero() for status in health.streams},
        "age_ms_without": percentiles(np.concatenate([ages[n][: calm[n] - skip[n]] for n in names])),
        "age_ms_with": percentiles(np.concatenate([ages[n][calm[n] - skip[n] :] for n in names])),
        "gap_ms_without": round(without, 1),
        "gap_ms_with": round(longest[0].ms, 1),
        "longest_gaps": [f"{gap.ms:.1f} ms ({gap.late_ms:.1f} here) at {marks.at(gap.at_ns)}" for gap in longest],
        "refused": {model: f"{code}: {why}" for model, (code, why) in refused.items()},
        "not_refused": unrefused,
        "wrong_reason": [
            model for model, (code, why) in refused.items() if code != REASONS[model][0] or REASONS[model][1] not in why
        ],
        "active_is_wrong": health.model.name != active,
        "rollbacks": health.rollbacks,
        "model_mib": round(model_kib / 1024, 1),
        "resident_mib": {
            "start": resident[0] >> 10,
            "end": resident[-1] >> 10,
            "most": memory.most_kib >> 10,
            "last_quarter": [min(quarter) >> 10, max(quarter) >> 10],
            "last_eighths": [round(float(np.median(half)) / 1024, 1) for half in np.array_split(quarter, 2)],
            "grown_by_models": round((float(np.median(quarter)) - resident[0]) / model_kib, 2),
        },
    }


def broken(report: dict[str, Any]) -> list[str]:
    """The parts of the contract that do not hold."""
    memory = report["resident_mib"]
    flat = abs(memory["last_eighths"][1] - memory["last_eighths"][0]) <= 0.5 * report["model_mib"]
    holds = {
        "no window lost or answered twice": not report["lost_or_doubled"] and not any(report["lost"].values()),
        "every bad bundle refused with its own reason": not report["not_refused"] and not report["wrong_reason"],
        "the active model is the one of the last change": not report["active_is_wrong"] and not report["rollbacks"],
        "99 % of the estimates within 100 ms": report["age_ms_with"]["p99"] <= MAX_P99_MS,
        "a gap at most one window longer": report["gap_ms_with"] <= report["gap_ms_without"] + WINDOW_US / 1e3,
        "at most 1.5 models more": memory["grown_by_models"] <= 1.5,
        "flat over the last quarter": flat,
    }
    return [what for what, one in holds.items() if not one]


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--swaps", type=int, default=100)
    parser.add_argument("--bad", type=int, default=20, help="number of changes to a bad bundle")
    parser.add_argument("--streams", type=int, default=4)
    parser.add_argument("--quiet-s", type=float, default=100.0, help="duration without a change at the start [s]")
    given = parser.parse_args()
    gc.disable()  # all payloads are kept: repeated collections over them would delay the listener
    result = run(given.swaps, given.bad, given.streams, given.quiet_s)
    print(json.dumps(result, indent=2))
    for what in broken(result):
        print(f"does not hold: {what}")
    sys.exit(1 if broken(result) else 0)
