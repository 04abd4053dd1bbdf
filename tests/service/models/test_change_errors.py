"""A bug in a model change: it is counted by place, the caller gets an error, and the streams keep their model."""

import threading

import pytest

from neurove_core.models import bundle
from neurove_protocol.control import ActivateRequest
from neurove_protocol.errors import InternalError, RolledBack
from neurove_service.guard import Guard
from neurove_service.models.change import Rules
from neurove_service.models.slot import ModelSlot
from neurove_service.models.store import ModelStore
from neurove_service.node.handlers import Handlers
from neurove_service.streams.stream import Stream
from tests.builders import make_packets
from tests.bundles import proven
from tests.service.conftest import SMALL, arrived


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("models")
    for seed, name in ((1, "one"), (2, "two")):
        bundle.save(proven(bundle.untrained(seed, SMALL, name)), folder / f"{name}.safetensors")
    return folder


@pytest.fixture
def node(folder):
    """Makes the slot of a node with a running stream, its request handlers, and its guard."""
    made = []

    def make(**arguments):
        guard = Guard()
        slot = ModelSlot("one", folder, Rules(probation_s=0.05, prime_s=0.05), guard=guard, **arguments)
        made.append(slot)
        stream = Stream("cam0", slot)
        for packet in make_packets(100):
            stream.accept(packet, arrived())
        return slot, Handlers("n1", slot, list, store=ModelStore(None)), guard, stream

    yield make
    for slot in made:
        slot.close()


ACTIVATE = ActivateRequest(model="two", expect=None, shadow_s=0.0, canary=(), force=None).encode()


def raises(*_):
    raise RuntimeError("planted")


def still_serves(stream, model):
    return {one.model for packet in make_packets(150)[100:] for one in stream.accept(packet, arrived())} == {model}


def test_a_bug_before_the_switch_refuses_the_change(node):
    memory = [lambda: None]  # the newest one answers
    slot, handlers, guard, stream = node(free_bytes=lambda: memory[-1]())
    memory.append(raises)
    steps = []
    with pytest.raises(InternalError):
        handlers.activate(ACTIVATE, steps.append)
    assert guard.counts == {"model change": 1}
    assert b"refused" in steps[-1]
    assert (slot.plan.phase, slot.last_change) == ("steady", f"two was refused: {InternalError().message}")
    assert still_serves(stream, "one")


class Unreadable:
    """A stream whose figures cannot be read while a model is on probation."""

    name, flowing = "cam1", False  # without packets, so that a change does not wait for it

    def __init__(self, slot, stream):
        self._slot, self._stream = slot, stream

    @property
    def lanes(self):
        if self._slot.plan.phase == "probation":
            raise RuntimeError("planted")
        return self._stream.lanes


def test_a_bug_in_the_probation_rolls_the_model_back_and_the_caller_gets_an_answer(node):
    slot, handlers, guard, stream = node()
    broken = Unreadable(slot, stream)
    slot.join(broken)
    with pytest.raises(RolledBack, match="its probation ended by an internal error"):
        handlers.activate(ACTIVATE)
    assert guard.counts == {"probation": 1}
    assert (slot.rollbacks, slot.plan.phase) == (1, "steady")
    assert still_serves(stream, "one")


def test_a_model_that_cannot_be_saved_serves_and_the_caller_gets_an_answer(node):
    slot, handlers, guard, stream = node(on_changed=raises)
    answered = []
    thread = threading.Thread(target=lambda: answered.append(handlers.activate(ACTIVATE)))
    thread.start()
    for packet in make_packets(4_000, n=50, step_us=25_000)[200:]:
        stream.accept(packet, arrived())
        while stream.lanes.has_backlog:
            stream.lanes.run_standby()
        if guard.counts:
            break
        thread.join(0.002)
    thread.join()
    assert guard.counts == {"saving the active model": 1}
    assert (slot.active.estimator.bundle.name, slot.plan.phase) == ("two", "steady")
    slot.rollback()
    assert guard.counts == {"saving the active model": 2}
    assert slot.active.estimator.bundle.name == "one"


def test_a_change_whose_probation_cannot_start_is_rolled_back(node, monkeypatch):
    slot, handlers, guard, stream = node()
    start = threading.Thread.start

    def no_thread(thread):
        if thread.name == "probation":
            raise RuntimeError("can't start new thread")
        start(thread)

    monkeypatch.setattr(threading.Thread, "start", no_thread)
    with pytest.raises(InternalError):
        handlers.activate(ACTIVATE)
    assert guard.counts == {"model change": 1}
    assert slot.plan.phase == "steady"
    assert still_serves(stream, "one")
