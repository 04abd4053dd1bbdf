import pytest

from protocol.control import (
    ActivateReply,
    ActivateRequest,
    HealthReply,
    HealthRequest,
    Losses,
    ModelsReply,
    ModelsRequest,
)
from protocol.errors import InvalidField, Malformed, UnknownModel
from service.handlers import Handlers
from service.health import stream_status
from service.stream import Arrival, Stream
from tests.builders import make_packets

SECOND_NS = 1_000_000_000


@pytest.fixture
def clock():
    return [10 * SECOND_NS]


@pytest.fixture
def stream(slot, clock):
    return Stream("cam0", slot, lambda: clock[0])


@pytest.fixture
def handlers(slot, stream, clock):
    return Handlers("edge", slot, lambda: [stream_status("edge", stream, clock[0])], lambda: 0)


def feed(stream, clock, packets):
    for packet in packets:
        for estimate in stream.accept(packet, Arrival(clock[0], clock[0])):
            stream.published(estimate)


def ask_health(handlers):
    return HealthReply.decode(handlers.health(HealthRequest().encode()))


def test_a_stream_that_loses_nothing_is_ok(handlers, stream, clock):
    feed(stream, clock, make_packets(50))
    health = ask_health(handlers)
    assert (health.ok, health.streams[0].verdict, health.streams[0].estimates) == (True, "ok", 3)
    assert health.streams[0].latency_ms.p50 == 0
    assert health.model.trained is False


def test_a_fresh_loss_makes_a_node_not_ok_and_an_old_one_does_not(handlers, stream, clock):
    packets = make_packets(50)
    feed(stream, clock, packets[:20] + packets[21:])
    health = ask_health(handlers)
    assert (health.ok, health.streams[0].verdict) == (False, "lossy")
    assert "gap_packets 1" in health.why
    clock[0] += 6 * SECOND_NS
    feed(stream, clock, make_packets(50, first_seq=50, start_us=200_000))
    assert ask_health(handlers).ok
    assert ask_health(handlers).streams[0].lost == Losses(gap_packets=1)


def test_packets_without_estimates_are_a_stall(handlers, stream, clock):
    clock[0] += 3 * SECOND_NS
    stream.refused(clock[0])
    clock[0] += SECOND_NS // 2
    stream.refused(clock[0])
    assert ask_health(handlers).streams[0].verdict == "lossy"  # it began to flow only half a second ago
    for _ in range(6):
        clock[0] += SECOND_NS // 2
        stream.refused(clock[0])
    health = ask_health(handlers)
    assert (health.ok, health.streams[0].verdict) == (False, "stalled")


def test_a_silent_camera_is_idle_which_is_no_fault_of_the_node(handlers, stream, clock):
    feed(stream, clock, make_packets(50))
    clock[0] += 2 * SECOND_NS
    health = ask_health(handlers)
    assert (health.ok, health.streams[0].verdict) == (True, "idle")


def test_health_tells_how_the_newest_change_of_model_went_and_whether_the_node_is_ready(slot, handlers):
    assert (ask_health(handlers).change, ask_health(handlers).rollbacks, ask_health(handlers).ready) == ("", 0, True)
    _, serving = slot.activate("two")
    assert ask_health(handlers).change == "two is active"
    slot.fault(serving, "planted")
    told = ask_health(handlers)
    assert (told.change, told.rollbacks) == ("two was rolled back by itself: planted", 1)
    assert (told.model.name, told.epoch) == ("one", 2)
    with pytest.raises(UnknownModel):
        slot.activate("three")
    assert ask_health(handlers).change.startswith("three was refused: ")
    assert not HealthReply.decode(
        Handlers("edge", slot, list, lambda: 0, lambda: False).health(HealthRequest().encode())
    ).ready


def test_models_tell_active_previous_and_available(handlers):
    first = ModelsReply.decode(handlers.models(ModelsRequest().encode()))
    assert (first.active.name, first.previous, first.epoch) == ("one", None, 0)
    changed = ActivateReply.decode(handlers.activate(ActivateRequest(model="two").encode()))
    assert (changed.active.name, changed.previous.name, changed.epoch) == ("two", "one", 1)
    then = ModelsReply.decode(handlers.models(ModelsRequest().encode()))
    assert (then.active.name, then.previous.name) == ("two", "one")
    assert {info.name for info in then.available} == {"default", "untrained", "one", "two"}


def test_a_request_that_is_not_one_is_refused(handlers):
    with pytest.raises(Malformed):
        handlers.health(b"")
    with pytest.raises(InvalidField, match="model=.*"):
        handlers.activate(HealthRequest().encode())
    with pytest.raises(UnknownModel):
        handlers.activate(ActivateRequest(model="three").encode())
