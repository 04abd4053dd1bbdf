import json
import threading

import pytest

from neurove_core.models import bundle
from neurove_protocol.control import CHUNK_SCHEMA, PeerError
from neurove_protocol.errors import NeuroVEError
from neurove_protocol.events import encode_packet
from neurove_service.clients import ask
from neurove_service.clients.push_source import PushSource
from neurove_service.transport import open_transport
from tests.builders import make_packets
from tests.live.conftest import Heard, Source, client, free_endpoint, service, wait_until
from tests.live.killing import CONFIG, Node, slowly

pytestmark = pytest.mark.live


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    folder = tmp_path_factory.mktemp("bundles")
    bundle.save(
        bundle.untrained(1, name="one"), folder / "one.safetensors"
    )  # with the windows and the grid of the default model
    for seed, name in ((2, "two"), (3, "three"), (4, "four")):
        bundle.save(bundle.untrained(seed, CONFIG, name), folder / f"{name}.safetensors")
    (folder / "foreign.safetensors").write_text("hello, I am not a model")
    (folder / "empty.safetensors").touch()
    return folder


@pytest.fixture(scope="module")
def node(tmp_path_factory):
    folder = tmp_path_factory.mktemp("state")
    with service(free_endpoint(), "--models-dir", str(folder)) as (_, transport, config):
        yield transport, config, folder


def steps(text):
    return [json.loads(line)["step"] for line in text.splitlines() if "step" in json.loads(line)]


def test_an_operator_pushes_activates_and_rolls_back_without_a_gap_in_the_estimates(node, files, run):
    _, config, _ = node
    at = ("--connect", config.connect[0])
    stop = threading.Event()
    with client(config.connect[0]) as transport, client(config.connect[0]) as driver:
        heard = Heard(transport, config)
        thread = threading.Thread(target=keep_driving, args=(driver, config, stop))
        thread.start()
        try:
            wait_until(lambda: heard.of("cam0"))
            pushed = run("push", str(files / "one.safetensors"), *at, "--activate", "--json")
            assert (pushed.code, pushed.err) == (0, "")
            reported = steps(pushed.out)
            assert reported[0] == "fetching"
            assert [step for step in reported if step in ("staged", "verified", "active", "done")] == [
                "staged",
                "verified",
                "verified",
                "active",
                "done",
            ]
            digest = json.loads(pushed.out.splitlines()[-1])["active"]["digest"]
            wait_until(lambda: heard.of("cam0")[-1].digest == digest)

            (models,) = json.loads(run("models", *at, "--json").out)
            assert (models["active"]["digest"], models["previous"]["name"]) == (digest, "default")
            late = run("activate", "default", *at, "--expect", "00000000")
            assert (late.code, "n1: conflict: expected 00000000 to be active" in late.err) == (3, True)
            back = run("rollback", *at, "--expect", digest[:8])
            assert (back.code, "n1: rolled_back: to default" in back.out) == (0, True)
            nothing = run("rollback", *at)
            assert (nothing.code, "cannot roll back" in nothing.err) == (1, True)
            wait_until(lambda: heard.of("cam0")[-1].model == "default")
        finally:
            stop.set()
            thread.join()
        estimates = heard.of("cam0")
        assert [one.seq for one in estimates] == list(range(estimates[0].seq, estimates[0].seq + len(estimates)))
        (status,) = [one for one in ask.health(transport, config)[0].streams if one.stream == "cam0"]
        assert status.lost.nonzero() == {}


def test_a_push_that_is_forced_gives_its_reason_to_the_node(node, files, run):
    _, config, _ = node
    at = ("--connect", config.connect[0])
    alone = run("push", str(files / "four.safetensors"), *at, "--force", "trial on the bench")
    assert (alone.code, "give --activate too" in alone.err, alone.err.count("\n")) == (2, True, 1)
    forced = run("push", str(files / "four.safetensors"), *at, "--activate", "--force", "trial on the bench")
    assert (forced.code, "forced (trial on the bench): no difference from default" in forced.out) == (0, True)
    assert run("rollback", *at).code == 0


def keep_driving(transport, config, stop):
    source = Source(transport, config, "cam0")
    for packet in make_packets(20_000, n=20):
        source.put(encode_packet(packet))
        if stop.wait(0.004):
            return


def test_a_node_refuses_a_file_that_is_not_a_model_and_stores_nothing(node, files, run):
    _, config, folder = node
    at = ("--connect", config.connect[0], "--node", "n1")
    foreign = run("push", str(files / "foreign.safetensors"), *at)
    assert (foreign.code, foreign.err.count("\n")) == (1, 1)
    assert "n1: model foreign.safetensors: " in foreign.err
    empty = run("push", str(files / "empty.safetensors"), *at)
    assert "model empty.safetensors: " in empty.err
    assert "No such file" in run("push", "nowhere.safetensors", *at).err
    assert list((folder / "staging").iterdir()) == []


def test_health_and_models_answer_during_a_push_and_an_interrupted_push_resumes(node, files):
    transport, config, _ = node
    with PushSource(files / "two.safetensors") as source:
        gate = Gate(source.chunk, 3)
        with client(config.connect[0]) as pusher:
            pusher.answer(config.keys.chunks(source.digest), gate, CHUNK_SCHEMA)
            threading.Thread(target=ignoring(lambda: ask.push(pusher, config, source.request, "n1"))).start()
            wait_until(lambda: partial(transport, config).get(source.digest, 0) > 0)
            assert ask.health(transport, config)[0].node == "n1"
            gate.shut.set()
        have = partial(transport, config)[source.digest]  # the client has left
        assert 0 < have < source.request.size
        with client(config.connect[0]) as pusher:
            pusher.answer(config.keys.chunks(source.digest), source.chunk, CHUNK_SCHEMA)
            reply = ask.push(pusher, config, source.request, "n1")  # waits for the first push to end, or continues it
            assert reply.fetched < source.request.size
        assert partial(transport, config) == {}
        assert source.digest in {one.digest for one in ask.models(transport, config)[0].staged}


class Gate:
    """Answers some chunks and delays the next one."""

    def __init__(self, chunk, count):
        self._chunk, self._left = chunk, count
        self.shut = threading.Event()

    def __call__(self, request):
        self._left -= 1
        if self._left < 0:
            self.shut.wait(60)
            raise NeuroVEError("gone")
        return self._chunk(request)


def partial(transport, config):
    return ask.models(transport, config)[0].partial


def ignoring(run):
    def quietly():
        try:
            run()
        except Exception:  # noqa: BLE001  # its session is closed while it runs
            return

    return quietly


def test_two_clients_that_push_one_bundle_at_once_both_succeed_and_it_is_transferred_once(node, files):
    _, config, _ = node
    replies = []
    with (
        PushSource(files / "three.safetensors") as source,
        client(config.connect[0]) as first,
        client(config.connect[0]) as second,
    ):
        threads = []
        for transport in (first, second):
            transport.answer(config.keys.chunks(source.digest), slowly(source.chunk), CHUNK_SCHEMA)
            push = lambda transport=transport: replies.append(ask.push(transport, config, source.request, "n1"))  # noqa: E731
            threads.append(threading.Thread(target=push))
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        assert sorted(reply.fetched for reply in replies) == [0, source.request.size]


@pytest.fixture
def pair():
    endpoint = free_endpoint()
    with open_transport("peer", listen=(endpoint,)) as listening, client(endpoint) as asking:
        yield listening, asking


def test_every_reply_arrives_when_it_is_sent_and_queries_beyond_the_bound_are_refused_as_busy(pair):
    listening, asking = pair
    go_on = threading.Event()

    def handle(request, report):
        report(b"began")
        assert go_on.wait(60)
        return request

    listening.answer_streaming("t/work", handle, at_once=2)
    working = [asking.ask_streaming("t/work", name, 30) for name in (b"first", b"second")]
    assert [(next(one).payload) for one in working] == [b"began", b"began"]  # while both are in progress
    with pytest.raises(PeerError, match="at most 2 such requests at once") as refused:
        list(asking.ask_streaming("t/work", b"third", 30))
    assert refused.value.code == "busy"
    go_on.set()
    assert sorted(next(one).payload for one in working) == [b"first", b"second"]
    assert [one.payload for one in asking.ask("t/work", b"plain", 30)] == [b"plain"]  # `ask` does not return progress


def test_a_caller_that_leaves_stops_neither_the_work_nor_the_next_caller(pair):
    listening, asking = pair
    go_on, done = threading.Event(), threading.Event()

    def handle(request, report):
        assert go_on.wait(60)
        report(b"nobody receives this")
        done.set()
        return request

    listening.answer_streaming("t/work", handle, at_once=1)
    assert list(asking.ask_streaming("t/work", b"first", 0.1)) == []  # the timeout is over
    go_on.set()
    assert done.wait(60)
    wait_until(lambda: answers(asking))


def answers(transport):
    try:
        return [one.payload for one in transport.ask("t/work", b"again", 30)] == [b"again"]
    except PeerError:  # busy: the first query is ending
        return False


@pytest.mark.parametrize("at_step", ["fetching", "loaded", "waiting"])
def test_a_node_that_was_killed_during_a_change_restarts_with_a_complete_model(tmp_path, at_step):
    node = Node(tmp_path)
    new, _, before = node.kill_in_a_change(1, at_step=at_step)
    models = node.restarted()
    if at_step == "fetching":
        assert models.active.digest == before
    if at_step == "waiting":  # no stream, so its probation goes on after the restart
        assert (models.active.digest, models.previous.digest) == (new, before)
        with node.started("--model", "untrained") as (_, _, configured):  # it takes precedence over the saved one
            assert configured.active.name == "untrained"
