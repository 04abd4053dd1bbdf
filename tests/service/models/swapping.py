"""Slots, streams and helpers for the tests of model changes."""

import threading

import pytest

from neurove_service.models.change import Rules
from neurove_service.models.slot import ModelSlot
from neurove_service.streams.comparison import TrialLimits
from tests.service.conftest import arrived

WINDOW_US = 50_000
LAX = TrialLimits(divergence=1e9, rate_ratio=1e9, latency_share=1e9)


class Slots:
    """Makes slots with the models of the folder, and closes them."""

    def __init__(self, folder):
        self.folder, self.made = folder, []

    def __call__(self, model="one", *, probation_s=60.0, probation=LAX, shadow=LAX, **arguments):
        rules = Rules(probation_s=probation_s, probation=probation, shadow=shadow)
        self.made.append(ModelSlot(model, self.folder, rules, **arguments))
        return self.made[-1]


def feed(stream, packets):
    estimates = []
    for packet in packets:
        estimates += stream.accept(packet, arrived())
        while packet.seq % 40 and stream.lanes.has_backlog:  # now and then the standby model lags
            stream.lanes.run_standby()
    return estimates


def motion(estimates):
    """The motion of the camera and the flags, without the model."""
    return [(one.start_us, one.end_us, one.twists, one.flags, one.events) for one in estimates]


class Live:
    """A stream that gets packets on a thread of its own during a change."""

    def __init__(self, stream, packets, pace_s=0.002):
        self.stream, self.packets, self.pace_s = stream, iter(packets), pace_s
        self.estimates, self._stop = [], threading.Event()
        self._thread = threading.Thread(target=self._run)

    def _run(self):
        for packet in self.packets:
            self.estimates += feed(self.stream, [packet])
            if self._stop.wait(self.pace_s):
                return

    def __enter__(self):
        self._thread.start()
        return self

    def __exit__(self, *_):
        self._stop.set()
        self._thread.join()


def wait_until(condition, timeout_s=60.0):
    for _ in range(int(timeout_s / 0.01)):
        if condition():
            return
        threading.Event().wait(0.01)
    pytest.fail(f"did not become true within {timeout_s} s")


def steps(progress):
    return [one.step for one in progress]
