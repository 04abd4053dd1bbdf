import hashlib
import threading

import pytest

from neurove_core.models import bundle
from neurove_protocol.control import (
    ActivateReply,
    ActivateRequest,
    HealthReply,
    HealthRequest,
    Losses,
    ModelsReply,
    ModelsRequest,
    ProgressReply,
    PushReply,
    PushRequest,
    RollbackRequest,
)
from neurove_protocol.errors import (
    Downgrade,
    InvalidField,
    Malformed,
    NeuroVEError,
    NoStore,
    NothingBefore,
    UnknownModel,
    Untrained,
)
from neurove_service.models.active_file import Active, ActiveFile
from neurove_service.models.change import Rules
from neurove_service.models.signatures import Signed
from neurove_service.models.slot import ModelSlot
from neurove_service.models.store import ModelStore
from neurove_service.node.condition import Condition
from neurove_service.node.handlers import Handlers
from neurove_service.node.health import stream_status
from neurove_service.streams.intake import Arrival
from neurove_service.streams.stream import Stream
from tests.builders import make_packets
from tests.service.conftest import SMALL

SECOND_NS = 1_000_000_000


@pytest.fixture
def clock():
    return [10 * SECOND_NS]


@pytest.fixture
def stream(slot, clock):
    return Stream("cam0", slot, lambda: clock[0])


@pytest.fixture
def handlers(slot, stream, clock):
    return Handlers("edge", slot, lambda: [stream_status("edge", stream, clock[0])])


def feed(stream, clock, packets):
    for packet in packets:  # of a source whose own clock does not run
        for estimate in stream.accept(packet, Arrival(clock[0], clock[0], clock[0] // 1000)):
            stream.activity.published(estimate)


def ask_health(handlers):
    return HealthReply.decode(handlers.health(HealthRequest().encode()))


def test_a_stream_that_loses_nothing_is_ok(handlers, stream, clock):
    feed(stream, clock, make_packets(50))
    health = ask_health(handlers)
    assert (health.ok, health.streams[0].verdict, health.streams[0].estimates) == (True, "ok", 3)
    assert health.streams[0].latency_ms.p50 == 0
    assert health.model.trained is True


def test_a_recent_loss_makes_a_node_not_ok_and_an_old_one_does_not(handlers, stream, clock):
    packets = make_packets(50)
    feed(stream, clock, packets[:20] + packets[21:])
    health = ask_health(handlers)
    assert (health.ok, health.streams[0].verdict) == (False, "lossy")
    assert "gap_packets 1" in health.why
    clock[0] += 6 * SECOND_NS
    feed(stream, clock, make_packets(50, first_seq=50, start_us=200_000))
    assert ask_health(handlers).ok
    assert ask_health(handlers).streams[0].lost == Losses(gap_packets=1)


def test_a_stream_with_packets_but_without_estimates_is_stalled(handlers, stream, clock):
    clock[0] += 3 * SECOND_NS
    stream.refused(clock[0])
    clock[0] += SECOND_NS // 2
    stream.refused(clock[0])
    assert ask_health(handlers).streams[0].verdict == "lossy"  # packets have arrived for only half a second
    for _ in range(6):
        clock[0] += SECOND_NS // 2
        stream.refused(clock[0])
    health = ask_health(handlers)
    assert (health.ok, health.streams[0].verdict) == (False, "stalled")


def test_a_stream_without_packets_is_idle_and_the_node_stays_ok(handlers, stream, clock):
    feed(stream, clock, make_packets(50))
    clock[0] += 2 * SECOND_NS
    health = ask_health(handlers)
    assert (health.ok, health.streams[0].verdict) == (True, "idle")


def test_health_reports_the_newest_model_change_and_whether_the_node_is_ready(slot, handlers):
    assert (ask_health(handlers).change, ask_health(handlers).rollbacks, ask_health(handlers).ready) == ("", 0, True)
    _, serving = slot.activate("two")
    assert ask_health(handlers).change.startswith("two is active, judged by its own limits only: one has no proven")
    slot.fault(serving, "planted")
    health = ask_health(handlers)
    assert (health.change, health.rollbacks) == ("two was rolled back automatically: planted", 1)
    assert (health.model.name, health.epoch) == ("one", 2)
    with pytest.raises(UnknownModel):
        slot.activate("three")
    assert ask_health(handlers).change.startswith("three was refused: ")
    assert not HealthReply.decode(
        Handlers("edge", slot, list, ready=lambda: False).health(HealthRequest().encode())
    ).ready


def test_models_lists_active_previous_and_available_models(handlers):
    first = ModelsReply.decode(handlers.models(ModelsRequest().encode()))
    assert (first.active.name, first.previous, first.epoch) == ("one", None, 0)
    changed = ActivateReply.decode(handlers.activate(ActivateRequest(model="two").encode()))
    assert (changed.active.name, changed.previous.name, changed.epoch) == ("two", "one", 1)
    then = ModelsReply.decode(handlers.models(ModelsRequest().encode()))
    assert (then.active.name, then.previous.name) == ("two", "one")
    assert {info.name for info in then.available} == {"default", "untrained", "one", "two"}


def test_an_invalid_request_is_refused(handlers):
    with pytest.raises(Malformed):
        handlers.health(b"")
    with pytest.raises(InvalidField, match="model=.*"):
        handlers.activate(HealthRequest().encode())
    with pytest.raises(UnknownModel):
        handlers.activate(ActivateRequest(model="three").encode())


RUNS = threading.Event()


def trusts_a_flag(_, signature):
    return Signed("trusted", allow_downgrade=True) if signature == b"flag" else Signed("unsigned")


class Replies:
    """Progress replies that a caller gets."""

    def __init__(self):
        self.replies = []

    def __call__(self, payload):
        self.replies.append(ProgressReply.decode(payload))

    @property
    def steps(self):
        return [reply.step for reply in self.replies]


@pytest.fixture
def progress():
    return Replies()


@pytest.fixture
def storing(models_dir, tmp_path):
    """Makes handlers of a node that stores pushed models and trusts the signature `flag`."""

    def make(highest_release=0):
        store = ModelStore(tmp_path, models_dir, verify=trusts_a_flag)
        active_file = ActiveFile(None)
        active_file.keep(Active(digest="0" * 64, previous=None, configured="one", highest_release=highest_release))
        slot = ModelSlot("one", models_dir, Rules(probation_s=0.2), pushed=store.files)
        return Handlers("edge", slot, list, Condition, store, active_file)

    return make


def push_of(name, signature=None):
    data = bundle.untrained(8, SMALL, name).to_bytes()
    request = PushRequest(digest=hashlib.sha256(data).hexdigest(), size=len(data), name=name, signature=signature)
    return request.encode(), lambda _, chunk: data[chunk.offset : chunk.offset + chunk.length]


def test_a_pushed_model_is_staged_until_it_serves(storing, progress):
    handlers = storing()
    request, pull = push_of("eight")
    reply = PushReply.decode(handlers.push(request, progress, pull, RUNS))
    assert (reply.model.name, reply.fetched > 0) == ("eight", True)
    assert progress.steps == ["fetching", "staged", "verified"]
    models = ModelsReply.decode(handlers.models(ModelsRequest().encode()))
    assert [info.name for info in models.staged] == ["eight"]
    assert models.staged[0] in models.available
    changed = ActivateReply.decode(handlers.activate(ActivateRequest(model=reply.model.digest[:8]).encode(), progress))
    assert (changed.active.name, changed.previous.name) == ("eight", "one")
    assert ModelsReply.decode(handlers.models(ModelsRequest().encode())).staged == ()
    back = ActivateReply.decode(handlers.rollback(RollbackRequest(expect=reply.model.digest[:8]).encode(), progress))
    assert (back.active.name, back.epoch) == ("one", 2)
    assert progress.replies[-1].step == "rolled_back"
    assert {reply.node for reply in progress.replies} == {"edge"}


def test_an_older_release_is_neither_stored_nor_activated_unless_a_trusted_signature_allows_it(
    storing, progress, tmp_path
):
    handlers = storing(highest_release=7)
    request, pull = push_of("eight")
    with pytest.raises(Downgrade, match="release=0: release 7 was accepted before"):
        handlers.push(request, progress, pull, RUNS)
    assert progress.steps[-1] == "refused"
    assert [path for path in tmp_path.rglob("*") if path.is_file()] == []
    with pytest.raises(Downgrade):
        handlers.activate(ActivateRequest(model="two").encode(), progress)
    request, pull = push_of("eight", b"flag")
    assert PushReply.decode(handlers.push(request, progress, pull, RUNS)).model.signature == "trusted"
    changed = ActivateReply.decode(handlers.activate(ActivateRequest(model="eight").encode()))
    assert (changed.active.name, changed.active.signature) == ("eight", "trusted")
    assert ActivateReply.decode(handlers.rollback(RollbackRequest().encode())).active.name == "one"


def test_after_a_signed_release_the_built_in_model_may_serve_and_an_untrained_one_may_not(storing):
    handlers = storing(highest_release=7)
    with pytest.raises(Downgrade, match="model untrained"):
        handlers.activate(ActivateRequest(model="untrained").encode())
    assert ActivateReply.decode(handlers.activate(ActivateRequest(model="default").encode())).active.name == "default"


def test_a_node_for_trained_models_stores_no_untrained_one(models_dir, tmp_path, progress):
    store = ModelStore(tmp_path, models_dir)
    slot = ModelSlot("one", models_dir, pushed=store.files, trained_only=True)
    handlers = Handlers("edge", slot, list, lambda: 0, store)
    request, pull = push_of("eight")
    with pytest.raises(Untrained, match="model eight: it is untrained"):
        handlers.push(request, progress, pull, RUNS)
    assert [path for path in tmp_path.rglob("*") if path.is_file()] == []


def test_health_is_not_ok_while_an_untrained_model_answers(slot, handlers):
    assert ask_health(handlers).ok
    slot.activate("untrained")
    health = ask_health(handlers)
    assert (health.ok, health.why) == (False, "model untrained is untrained: its estimates have no meaning")
    slot.rollback()
    assert ask_health(handlers).ok


def test_activating_the_active_model_is_answered_as_unchanged(handlers):
    handlers.activate(ActivateRequest(model="two").encode())
    again = ActivateReply.decode(handlers.activate(ActivateRequest(model="two").encode()))
    assert (again.changed, again.active, again.epoch) == (False, again.previous, 1)
    assert ModelsReply.decode(handlers.models(ModelsRequest().encode())).previous.name == "one"


def test_a_refusal_is_the_last_reported_step(handlers, progress):
    with pytest.raises(UnknownModel):
        handlers.activate(ActivateRequest(model="three").encode(), progress)
    with pytest.raises(NothingBefore):
        handlers.rollback(RollbackRequest().encode(), progress)
    request, pull = push_of("eight")
    with pytest.raises(NoStore):
        handlers.push(request, progress, pull, RUNS)
    assert progress.steps == ["refused"] * 3
    assert "model='three'" in progress.replies[0].text


def test_a_model_whose_signature_is_refused_is_listed_as_untrusted(models_dir):
    def refuses(_, __):
        raise NeuroVEError("untrusted")

    slot = ModelSlot("one", models_dir)
    handlers = Handlers("edge", slot, list, Condition, ModelStore(None, models_dir, verify=refuses))
    models = ModelsReply.decode(handlers.models(ModelsRequest().encode()))
    states = {info.name: info.signature for info in models.available}
    assert states == {"default": "unsigned", "untrained": "unsigned", "one": "untrusted", "two": "untrusted"}
    with pytest.raises(NeuroVEError, match="untrusted"):
        handlers.activate(ActivateRequest(model="two").encode())
