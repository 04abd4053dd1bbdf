"""A follower that its node ends, in the instant in which it takes over: it either goes on or never answers.

Two nodes in this process use one router. `a` answers and then hangs; `b` follows it, and cannot keep up or gives the
stream away.
"""

import contextlib
import threading
import time

import pytest

from neurove_protocol import EventPacket
from neurove_protocol.events import PacketLimits, encode_packet
from neurove_service.guard import Guard
from neurove_service.models.change import Rules
from neurove_service.models.slot import ModelSlot
from neurove_service.node.fellows import Fellows
from neurove_service.node.followers import LATE_S, Followers
from neurove_service.node.outlets import open_outlet
from neurove_service.node.sharing import Moving, Sharing
from neurove_service.streams.history import RingSize
from neurove_service.streams.pauses import LONG_PAUSE_NS
from neurove_service.streams.registry import StreamRegistry, StreamSettings
from tests.builders import SENSOR, make_packet
from tests.live.conftest import client, wait_until
from tests.live.fellows import KEYS, Consumer, small_model

pytestmark = pytest.mark.live

STREAM, LATE_STREAM = "cam0", "cam1"
STEP_US, WINDOW_US = 10_000, 100_000  # a follower waits 150 ms for the leader: more than a stall of this machine
PATIENT_WINDOWS = 6
BOUNDS = StreamSettings(4, 60.0, 60.0, 1 << 26, RingSize(), PacketLimits(), max_age_s=60.0)


class Clock:
    """Stands still until `jump`; the turn of the node that reads the new time is the one that ends followers."""

    def __init__(self):
        self._now_s, self._jump_s = time.monotonic(), 0.0
        self.on_jump = lambda: None

    def __call__(self):
        if self._jump_s:
            self._now_s, self._jump_s = self._now_s + self._jump_s, 0.0
            self.on_jump()
        return self._now_s

    def jump(self, seconds):
        self._jump_s = seconds


class Hook:
    """Something that happens once, at a point of the thread that ends followers."""

    def __init__(self):
        self.call, self.called = None, threading.Event()

    def __call__(self):
        call, self.call = self.call, None
        if call is not None:
            call()
            self.called.set()


class HookedFellows(Fellows):
    def __init__(self, *arguments, **named):
        super().__init__(*arguments, **named)
        self.after_look, self.after_leave = Hook(), Hook()

    def duties(self):
        seen = super().duties()
        self.after_look()
        return seen

    def leaves(self, stream):
        left = super().leaves(stream)
        self.after_leave()
        return left


class HookedFollowers(Followers):
    def __init__(self, *arguments):
        super().__init__(*arguments)
        self.turns, self.after_turn = 0, Hook()

    def turn(self, streams):
        ended = super().turn(streams)
        self.turns += 1
        self.after_turn()
        return ended


class Given(Sharing):
    """Takes all streams, and later none."""

    gives_away = False

    def takes(self, stream):
        return not self.gives_away and super().takes(stream)


class Node:
    """The parts of a node that serve streams, without its process."""

    def __init__(self, name, endpoint, slot):
        self.name, self.closed, self.stop = name, [], threading.Event()
        self.transport = client(endpoint)
        self.fellows = HookedFellows(self.transport, KEYS, name, reluctant=False)
        self.sharing = Given(name, ("*",), 0, 1)
        self.clock = Clock()
        self.followers = HookedFollowers(self.sharing.takes, self.fellows, self.clock)
        self.registry = StreamRegistry(
            slot,
            BOUNDS._replace(node=name),
            self._open,
            open_duty=self.fellows.open_duty,
            takes=self.followers.takes,
        )
        self.fellows.join(self.stop)
        Moving(self.sharing, self.registry, self.fellows, self.followers, Guard()).start(self.stop)

    def _open(self, stream):
        outlet = open_outlet(self.transport, KEYS, self.name, stream)

        def close():
            self.closed.append((stream, self.role(stream)))
            outlet.close()

        return outlet._replace(close=close)

    def role(self, stream=STREAM):
        return next((one.role for one in Fellows.duties(self.fellows) if one.stream == stream), "absent")

    def follows(self):
        return any(one.role == "follows" and one.equal for one in Fellows.duties(self.fellows))

    def end(self):
        self.stop.set()
        self.registry.close()
        self.transport.close()


class Camera:
    """Puts packets into the nodes that hear it, in real time, and late ones of another stream into the follower."""

    def __init__(self, leader, follower):
        self._leader, self._follower = leader, follower
        self.leader_hears, self.follower_hears, self.is_late = True, False, False
        self.number, self._stop = 0, threading.Event()
        self._thread = threading.Thread(target=self._run)

    def _run(self):
        while not self._stop.wait(STEP_US / 1e6):
            now_ns = time.monotonic_ns()
            payload = self._packet(STREAM)
            if self.leader_hears:
                self._leader.registry.put_packet(STREAM, payload, now_ns)
            if self.follower_hears:
                self._follower.registry.put_packet(STREAM, payload, now_ns)
            if self.is_late:
                self._follower.registry.put_packet(LATE_STREAM, self._packet(LATE_STREAM), now_ns - 500_000_000)
            self.number += 1

    def _packet(self, stream):
        events = make_packet(100, seed=self.number % 50, stream=stream, duration_us=STEP_US).events
        t0_us = self.number * STEP_US
        moved = type(events).from_columns(events.t + t0_us, events.x, events.y, events.p)
        return encode_packet(EventPacket(stream, self.number, SENSOR, t0_us, moved))

    def wait(self, windows):
        last = self.number + windows * WINDOW_US // STEP_US
        wait_until(lambda: self.number >= last)

    def silence_leader(self):
        """The node that answers hangs, for longer than a follower waits before it takes over."""
        self.leader_hears = False
        self.wait(PATIENT_WINDOWS)

    def stop(self):
        self._stop.set()
        self._thread.join()

    def __enter__(self):
        self._thread.start()
        return self

    def __exit__(self, *_):
        self.stop()


@pytest.fixture
def network(router, tmp_path):
    """A node that answers, one that follows it with equal state, their camera, and a consumer."""
    model = small_model(tmp_path, WINDOW_US)
    slot = ModelSlot(model.stem, tmp_path, Rules(probation_s=0.2))
    with contextlib.ExitStack() as stack:
        stack.callback(slot.close)
        leader, follower = (Node(name, router, slot) for name in "ab")
        for node in (leader, follower):
            stack.callback(node.end)
        consumer = Consumer(stack.enter_context(client(router)))
        camera = stack.enter_context(Camera(leader, follower))
        wait_until(lambda: leader.role() == "answers" and STREAM in consumer.taken)
        camera.follower_hears = True
        wait_until(follower.follows)
        yield leader, follower, camera, consumer


def overload(node, camera):
    """The node is late; at its next turn it ends followers."""
    camera.is_late = True
    wait_until(lambda: any(one.name == LATE_STREAM and one.activity.waited_ns for one in node.registry.streams()))
    turns = node.followers.turns
    wait_until(lambda: node.followers.turns > turns + 1)
    node.clock.jump(2 * LATE_S)


def test_a_follower_that_takes_over_while_its_node_chooses_which_to_end_goes_on(network):
    _, b, camera, _ = network
    served = b.registry.streams()[0]

    def take_over():
        camera.leader_hears = False
        wait_until(lambda: b.role() == "answers")

    b.clock.on_jump = lambda: setattr(b.fellows.after_look, "call", take_over)
    overload(b, camera)
    assert b.fellows.after_look.called.wait(60)
    camera.wait(PATIENT_WINDOWS)
    assert served in b.registry.streams()
    assert b.role() == "answers"
    assert not b.followers.left_out


def test_a_follower_that_its_node_ends_does_not_take_over_before_it_has_ended(network):
    _, b, camera, consumer = network
    b.clock.on_jump = lambda: setattr(b.followers.after_turn, "call", camera.silence_leader)
    overload(b, camera)
    assert b.followers.after_turn.called.wait(60)
    wait_until(lambda: b.closed)
    assert b.closed == [(STREAM, "follows")]
    assert {got.estimate.node for got in consumer.taken[STREAM]} == {"a"}


def test_a_follower_that_its_node_gives_away_does_not_take_over_before_it_has_ended(network):
    _, b, camera, _ = network
    b.fellows.after_leave.call = camera.silence_leader
    b.sharing.gives_away = True
    assert b.fellows.after_leave.called.wait(60)
    wait_until(lambda: b.closed)
    assert b.closed == [(STREAM, "follows")]


def test_a_stream_whose_camera_pauses_is_given_away(network):
    a, b, camera, _ = network
    camera.stop()
    activity = a.registry.streams()[0].activity
    wait_until(lambda: time.monotonic_ns() - activity.last_estimate_ns > 1.1 * LONG_PAUSE_NS)
    a.sharing.gives_away = True
    wait_until(lambda: a.closed)
    assert a.closed == [(STREAM, "listens")]
    assert b.role() != "absent"
