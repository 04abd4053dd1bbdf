"""Nodes that stand by for each other on one router, a driver that never waits, and what a consumer sees."""

import contextlib
import itertools
import signal
import threading
import time
from pathlib import Path
from typing import NamedTuple

from neurove_core.config import CanonicalConfig, ModelConfig, NetworkConfig, WindowConfig
from neurove_core.estimator import Estimator
from neurove_core.models import bundle
from neurove_protocol import EventPacket, Twist, TwistEstimate
from neurove_protocol.duty import DrainReply, DrainRequest, DutyReply, DutyRequest, Newest
from neurove_protocol.events import encode_packet
from neurove_protocol.keys import Keys
from tests.builders import SENSOR, make_packet
from tests.live.conftest import Process, client, wait_until

START_S = 240
STEP_US = 4000
KEYS = Keys()


def small_model(folder: Path, window_us: int = 20_000, seed: int = 3) -> Path:
    """A bundle that takes little processor time; its state lasts for many windows."""
    config = ModelConfig(
        window=WindowConfig(duration_us=window_us, bins=2),
        canonical=CanonicalConfig(width=24, height=16),
        network=NetworkConfig(channels=(4, 4), features=32, hidden=32),
        settle_windows=4,
        low_activity_events=10,
    )
    path = folder / f"model{seed}.safetensors"
    bundle.save(bundle.untrained(seed, config, f"model{seed}"), path)
    return path


class Driver:
    """Publishes packets of one or several streams in real time on a thread; the packets of a stream are drawn once."""

    def __init__(self, transport, streams, events=100, distinct=500, step_us=STEP_US):
        self.step_us = step_us
        self.sent = 0  # packets of each stream
        self.sent_ns = []  # when, by number
        self._stop, self._running, self._waits = threading.Event(), threading.Event(), False
        self._running.set()
        self._streams = {name: seed for seed, name in enumerate(streams)}
        self._bodies = {
            name: [
                make_packet(events, seed=1000 * seed + i, stream=name, duration_us=step_us).events
                for i in range(distinct)
            ]
            for name, seed in self._streams.items()
        }
        self._publishers = {name: transport.publisher(KEYS.events(name), "application/msgpack") for name in streams}
        self._thread = threading.Thread(target=self._run, daemon=True)

    def packet(self, stream, number):
        """The packet of a stream with this number."""
        bodies = self._bodies[stream]
        events = bodies[number % len(bodies)]
        t0_us = number * self.step_us
        moved = type(events).from_columns(events.t + t0_us, events.x, events.y, events.p)
        return EventPacket(stream, number, SENSOR, t0_us, moved)

    def is_answered(self, estimate):
        """Whether this is the last window that the packets so far complete."""
        duration_us = estimate.end_us - estimate.start_us
        return estimate.end_us > (self.sent - 1) * self.step_us - duration_us

    def start(self):
        self._thread.start()
        return self

    def pause(self):
        """Send nothing until `go_on`; the time of the sensor stops too."""
        self._running.clear()
        wait_until(lambda: self._waits)

    def go_on(self):
        self._running.set()

    def stop(self):
        self._stop.set()
        self._running.set()
        self._thread.join(START_S)

    def _run(self):
        began_ns = time.monotonic_ns()
        while not self._stop.is_set():
            if not self._running.is_set():
                self._waits = True
                self._running.wait()
                self._waits, began_ns = False, time.monotonic_ns() - self.sent * self.step_us * 1000
            due_ns = began_ns + self.sent * self.step_us * 1000
            wait_ns = due_ns - time.monotonic_ns()
            if wait_ns < 0:  # no burst after a pause of this process: by contract, a link may drop packets of a burst
                began_ns -= wait_ns
            self._stop.wait(max(0, wait_ns) / 1e9)
            for name, publisher in self._publishers.items():
                publisher.put(encode_packet(self.packet(name, self.sent)))
            self.sent_ns.append(time.monotonic_ns())
            self.sent += 1

    def reference(self, stream, model):
        """The estimates of one node that never stopped, by start of the window."""
        estimator = Estimator(bundle.load(model))
        state, found = estimator.initial_state(SENSOR), {}
        for number in range(self.sent):
            packet = self.packet(stream, number)
            result = estimator.push(packet.events, state, packet.t0_us)
            state = result.state
            found.update({one.start_us: one for one in result.estimates})
        return found


class Got(NamedTuple):
    """An estimate that a consumer took."""

    at_ns: int
    estimate: TwistEstimate


class Consumer:
    """Takes estimates by the rule of the contract, and keeps what the rule drops."""

    def __init__(self, transport):
        self.taken, self.dropped = {}, {}
        self._rules = {}
        transport.subscribe(KEYS.velocity(), self._on_sample)

    def _on_sample(self, key, payload, received_ns):
        estimate = TwistEstimate.decode(payload)
        name = KEYS.stream_of(key)
        rule = self._rules.setdefault(name, Newest())
        taken = rule.takes(estimate.term, estimate.start_us, received_ns)
        (self.taken if taken else self.dropped).setdefault(name, []).append(Got(received_ns, estimate))

    def forget(self):
        """Keep only what arrives from now on."""
        for name in list(self.taken):
            del self.taken[name][:-1]  # in place: the session's thread appends meanwhile
        self.dropped.clear()

    def newest(self, stream):
        return self.taken[stream][-1].estimate

    def leader(self, stream):
        return self.newest(stream).node


class Fellow:
    """A node that is started, killed, stopped and drained; its logs are appended to a file in `logs`, if given."""

    def __init__(self, name, endpoint, model, *more, logs=None):
        self.name = name
        self._log = None if logs is None else Path(logs, f"{name}.log")
        self._arguments = (
            *("serve", "--mode", "client", "--connect", endpoint, "--node", name, "--model", str(model)),
            *("--standby", "lot", "--log-level", "info", "--max-age-s", "60", "--queue-s", "60", *more),
        )
        self.process = None

    def start(self):
        if self._log is None:
            self.process = Process(*self._arguments)
        else:
            with self._log.open("a") as log:
                self.process = Process(*self._arguments, stderr=log)
        return self

    def kill(self):
        """Power loss."""
        self.process.child.kill()
        self.process.child.communicate()

    def hang(self):
        self.process.child.send_signal(signal.SIGSTOP)

    def wake(self):
        self.process.child.send_signal(signal.SIGCONT)

    def end(self):
        """Stop in order; return the log."""
        return self.process.end()[2]


def duty(transport, node, stream):
    """What a node does on a stream; None if it does not answer."""
    replies = transport.ask(KEYS.duty(node), DutyRequest(stream=stream).encode(), 5.0)
    return DutyReply.decode(replies[0].payload) if replies else None


def follows(transport, node, stream):
    """Whether a node follows a stream with equal state."""
    reply = duty(transport, node, stream)
    return reply is not None and reply.role == "follows" and reply.equal


def drain(transport, node, *, resume=False):
    """Hand over the streams of a node."""
    (reply,) = transport.ask(KEYS.drain(node), DrainRequest(resume=resume).encode(), 60.0)
    return DrainReply.decode(reply.payload)


@contextlib.contextmanager
def fellows(names, endpoint, model, *more, logs=None, links=None):
    """Nodes that are alive, by name; all are ended. With `links` each node has a link of its own to the router."""
    ends = {name: links[name].endpoint if links else endpoint for name in names}
    nodes = {name: Fellow(name, end, model, *more, logs=logs).start() for name, end in ends.items()}
    try:
        with client(endpoint) as transport:
            wait_until(lambda: len(transport.tokens(KEYS.alive(), 1.0)) == len(names), START_S)
            yield nodes
    finally:
        for node in nodes.values():
            if node.process.child.poll() is None:
                node.wake()
                node.end()


def check(consumer, driver, stream, model):
    """Every window from the first to the last, in order, once, and bit for bit that of a node that never stopped."""
    taken = [got.estimate for got in consumer.taken[stream]]
    starts = [one.start_us for one in taken]
    step = taken[0].end_us - taken[0].start_us
    assert starts == list(range(starts[0], starts[0] + step * len(starts), step)), gaps(starts, step)
    assert [one.seq for one in taken] == list(range(taken[0].seq, taken[0].seq + len(taken)))
    wrong = compared(consumer, driver, stream, model, step).unequal
    assert not wrong, (len(wrong), wrong[0].seq, wrong[0].node, wrong[0].flags)


class Compared(NamedTuple):
    """What a consumer took of a stream, against a node that never stopped."""

    taken: list  # in the order of arrival
    doubled: int
    broken: list  # pairs of starts between which windows are missing, doubled or out of order
    unequal: list  # estimates with other numbers

    def __str__(self):
        counts = f"{self.doubled} doubled, {len(self.broken)} gaps, {len(self.unequal)} not equal"
        return f"{len(self.taken)} windows, {counts}"

    @property
    def bad(self):
        return self.doubled + len(self.broken) + len(self.unequal)


def compared(consumer, driver, stream, model, window_us):
    """The windows of a stream, compared bit for bit with those of a node that never stopped."""
    taken = consumer.taken[stream]
    starts, wanted = [one.estimate.start_us for one in taken], driver.reference(stream, model)
    unequal = [one.estimate for one in taken if one.estimate.twists != _twists(wanted[one.estimate.start_us])]
    return Compared(taken, len(starts) - len(set(starts)), gaps(starts, window_us), unequal)


def windows_late(one, driver, window_us):
    """How long after its last packet an estimate arrived, in windows."""
    return (one.at_ns - driver.sent_ns[one.estimate.end_us // driver.step_us]) / 1e3 / window_us


def _twists(estimate):
    return tuple(Twist(*row) for row in estimate.twists.tolist())


def gaps(starts, step):
    """Where windows are missing, doubled or out of order."""
    return [(a, b) for a, b in itertools.pairwise(starts) if b != a + step]
