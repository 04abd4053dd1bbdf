"""Commands that change a node, with several nodes, refusals and internal errors, over real sessions."""

import contextlib
import json

import pytest

from neurove_protocol.control import (
    ActivateReply,
    ActivateRequest,
    ModelInfo,
    PeerError,
    ProgressReply,
    PushReply,
    PushRequest,
    StreamStatus,
)
from neurove_protocol.errors import Conflict, NoStore, UnknownModel
from neurove_protocol.keys import Keys
from neurove_service.clients import ask
from neurove_service.config import ClientConfig
from neurove_service.transport import open_transport
from tests.live.conftest import client, free_endpoint, is_alive, wait_until
from tests.protocol.messages import STATUS

pytestmark = pytest.mark.live

OLD, NEW = (
    ModelInfo(name=name, digest=digit * 64, trained=True, provenance="here", parameters=7)
    for name, digit in (("old", "a"), ("new", "b"))
)


class Node:
    """Answers pushes and activations as a node does, with an answer that the test sets."""

    def __init__(self, name, answer):
        self.name, self.answer, self.asked = name, answer, []

    def activate(self, data, report):
        return self._answer(ActivateRequest.decode(data).model, report)

    def push(self, data, report):
        return self._answer(PushRequest.decode(data).name, report)

    def _answer(self, wanted, report):
        self.asked.append(wanted)
        report(ProgressReply(node=self.name, step="verified", text="it runs here").encode())
        return self.answer(self.name).encode()


def done(name):
    return ActivateReply(node=name, active=NEW, previous=OLD, epoch=1)


def already_active(name):
    return ActivateReply(node=name, active=NEW, previous=NEW, epoch=1, changed=False)


def has_it(name):
    return PushReply(node=name, model=NEW, fetched=1234)


def had_it(name):
    return PushReply(node=name, model=NEW, fetched=0)


def refuses(error):
    def answer(_):
        raise error

    return answer


@pytest.fixture
def network():
    """An endpoint of a router, and a function that connects nodes to it."""
    endpoint, keys = free_endpoint(), Keys()
    with contextlib.ExitStack() as stack:
        stack.enter_context(open_transport("router", listen=(endpoint,)))

        def put(**answers):
            nodes = {name: Node(name, answer) for name, answer in answers.items()}
            for node in nodes.values():
                transport = stack.enter_context(client(endpoint))
                transport.answer_streaming(keys.activate(node.name), node.activate)
                transport.answer_streaming(keys.push(node.name), node.push)
                transport.token(keys.alive(node.name))
            with client(endpoint) as asking:
                wait_until(lambda: len(asking.tokens(keys.alive(), 1.0)) == len(nodes))
            return nodes

        yield endpoint, put


def test_one_of_several_nodes_must_be_named_before_anything_changes(network, run):
    endpoint, put = network
    nodes = put(n1=done, n2=done)
    code, out, err = run("activate", "new", "--connect", endpoint)
    assert (code, out) == (2, "")
    assert "several nodes are alive: n1, n2; give --node NAME or --all" in err
    assert [node.asked for node in nodes.values()] == [[], []]
    code, out, _ = run("activate", "new", "--connect", endpoint, "--node", "n2")
    assert (code, out.splitlines()) == (
        0,
        ["n2: verified: it runs here", f"n2: new ({'b' * 12}) is active and replaces old ({'a' * 12})"],
    )
    assert [node.asked for node in nodes.values()] == [[], ["new"]]


def test_after_a_refusal_the_other_nodes_are_changed_and_a_summary_lists_every_node(network, run):
    endpoint, put = network
    nodes = put(n1=done, n2=refuses(UnknownModel("new", ("old",))), n3=already_active)
    code, out, err = run("activate", "new", "--connect", endpoint, "--all")
    assert code == 4
    assert err == "neurove: n2: model='new': not on this node; available: old\n"
    assert out.splitlines()[-4:] == [
        "summary of 3 nodes: 1 changed, 1 unchanged, 1 refused",
        f"  n1  changed: new ({'b' * 12}) is active and replaces old ({'a' * 12})",
        "  n2  refused: model='new': not on this node; available: old",
        f"  n3  unchanged: already has new ({'b' * 12}) as its active model",
    ]
    assert [node.asked for node in nodes.values()] == [["new"]] * 3


def test_the_summary_for_programs_is_the_last_line(network, run):
    endpoint, put = network
    put(n1=done, n2=refuses(UnknownModel("new", ("old",))))
    code, out, _ = run("activate", "new", "--connect", endpoint, "--all", "--json")
    assert code == 4
    summary = json.loads(out.splitlines()[-1])["summary"]
    assert {node: one["result"] for node, one in summary.items()} == {"n1": "changed", "n2": "refused"}


def test_a_push_to_all_says_which_nodes_store_the_bundle_have_it_already_or_refuse_it(network, run, tmp_path):
    endpoint, put = network
    nodes = put(n1=has_it, n2=refuses(NoStore("it has no state_dir")), n3=had_it)
    (tmp_path / "new.safetensors").write_bytes(b"whatever it is")
    code, out, err = run("push", tmp_path / "new.safetensors", "--connect", endpoint, "--all")
    assert code == 4
    assert out.splitlines()[1] == f"n1: new ({'b' * 12}) is stored, 1,234 bytes transferred"
    assert f"n3: already has new ({'b' * 12}), no bytes transferred" in out.splitlines()
    assert err == "neurove: n2: this node stores no pushed models: it has no state_dir\n"
    assert [node.asked for node in nodes.values()] == [["new.safetensors"]] * 3


@pytest.mark.parametrize(
    ("second", "code"), [(Conflict("another client was first"), 3), (UnknownModel("new", ("old",)), 1)]
)
def test_if_all_nodes_refuse_the_exit_code_is_that_of_the_errors(network, run, second, code):
    endpoint, put = network
    put(n1=refuses(Conflict("another client was first")), n2=refuses(second))
    assert run("activate", "new", "--connect", endpoint, "--all")[0] == code


def test_a_conflict_of_one_node_keeps_its_own_exit_code(network, run):
    endpoint, put = network
    put(n1=refuses(Conflict("another client was first")))
    code, _, err = run("activate", "new", "--connect", endpoint, "--all", "--force", "we know")
    assert (code, err) == (3, "neurove: n1: conflict: another client was first\n")


def test_an_internal_error_of_a_node_reaches_its_caller_and_the_node_keeps_answering(network):
    endpoint, put = network
    nodes = put(n1=refuses(ZeroDivisionError("a bug")))
    config = ClientConfig(connect=(endpoint,))
    with client(endpoint) as transport:
        assert is_alive(transport, config)
        with pytest.raises(PeerError, match="n1: internal error: see the log of the node") as caught:
            ask.activate(transport, config, "new", "n1")
        assert caught.value.code == "internal"
        nodes["n1"].answer = done
        assert ask.activate(transport, config, "new", "n1").active == NEW


def test_a_listener_ignores_an_unreadable_message(network):
    endpoint, _ = network
    config, heard, status = ClientConfig(connect=(endpoint,)), [], StreamStatus.model_validate(STATUS)
    with client(endpoint) as transport, client(endpoint) as node:
        ask.listen(transport, config, heard.append, heard.append)
        publisher = node.publisher(config.keys.status("cam0"), "application/msgpack")
        wait_until(lambda: publisher.matching)
        publisher.put(b"no status")
        publisher.put(status.encode())
        wait_until(lambda: heard)
    assert heard == [status]
