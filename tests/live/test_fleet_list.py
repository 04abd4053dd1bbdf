"""`neurove fleet list` with nodes that answer, are silent, refuse, answer nonsense, or are expected and absent."""

import contextlib
import json

import pytest

from neurove_protocol.errors import Busy
from neurove_protocol.keys import Keys
from neurove_service.transport import open_transport
from tests.live.conftest import client, free_endpoint, wait_until
from tests.service.metrics.test_families import reply

pytestmark = pytest.mark.live


def refuse(_request):
    raise Busy(4)


@pytest.fixture(scope="module")
def endpoint():
    """A router with five nodes; `mute` has a token and no queryable."""
    where, keys = free_endpoint(), Keys()
    answers = {
        "good": lambda _: reply("good", labels={"site": "hall-1"}).encode(),
        "bad": lambda _: reply("bad", ok=False, why="cam0 is stalled", labels={"site": "hall-2"}).encode(),
        "refuses": refuse,
        "nonsense": lambda _: b"nonsense",
    }
    with contextlib.ExitStack() as stack:
        stack.enter_context(open_transport("router", listen=(where,)))
        for name in (*answers, "mute"):
            node = stack.enter_context(client(where))
            if name in answers:
                node.answer(keys.health(name), answers[name])
            node.token(keys.alive(name))
        asking = stack.enter_context(client(where))
        wait_until(lambda: len(asking.tokens(keys.alive(), 1.0)) == 5)
        yield where


def rows_of(run, endpoint, *flags):
    ran = run("fleet", "list", "--connect", endpoint, "--timeout", "60", "--json", *flags)
    return ran.code, {row["node"]: row for row in json.loads(ran.out)}


def test_every_node_has_a_row_and_a_silent_one_a_reason(run, endpoint):
    code, rows = rows_of(run, endpoint)
    assert code == 1
    assert {node for node, row in rows.items() if row["answered"]} == {"good", "bad"}
    assert rows["good"]["ok"]
    assert rows["good"]["labels"] == {"site": "hall-1"}
    assert rows["bad"]["why"] == "cam0 is stalled"
    assert rows["refuses"]["why"].startswith("answers with an error: ")
    assert rows["mute"]["why"] == "is connected and does not answer"
    assert rows["nonsense"]["why"].startswith("sends a health reply that cannot be read: ")


def test_conditions_select_nodes_and_keep_silent_ones_that_may_meet_them(run, endpoint):
    assert rows_of(run, endpoint, "--where", "site=hall-1", "--where", "node=good")[0] == 0
    code, rows = rows_of(run, endpoint, "--where", "site=hall-2")
    assert (code, set(rows)) == (1, {"bad", "refuses", "nonsense", "mute"})  # the labels of the last three are unknown


def test_an_inventory_names_absent_nodes_and_learns_those_that_answer(run, endpoint, tmp_path):
    file = tmp_path / "nodes.txt"
    file.write_text("absent site=hall-1 seen=2026-01-02T03:04:05Z\nmute site=hall-9\n")
    code, rows = rows_of(run, endpoint, "--expect-nodes", file, "--update", "--where", "site=hall-1")
    assert (code, set(rows)) == (1, {"good", "absent", "refuses", "nonsense"})  # `mute` is known to be elsewhere
    assert rows["absent"]["why"] == "is expected and not connected"
    assert rows["absent"]["last_seen"] == "2026-01-02T03:04:05+00:00"
    assert [line.split()[0] for line in file.read_text().splitlines()] == ["absent", "mute", "bad", "good"]


def test_the_table_has_one_line_a_node_also_in_a_pipe(run, endpoint):
    ran = run("fleet", "list", "--connect", endpoint, "--timeout", "60")
    lines = [line.split() for line in ran.out.splitlines()]
    assert lines[0] == ["node", "labels", "version", "model", "digest", "release", "verdict", "last", "seen", "why"]
    assert [line[0] for line in lines[1:6]] == ["bad", "good", "mute", "nonsense", "refuses"]
    assert [line[6] for line in lines[1:6]] == ["not-ok", "ok", "silent", "silent", "silent"]
    assert ran.out.splitlines()[6] == "5 nodes: 1 ok, 1 not ok, 3 do not answer"
    assert "node mute is connected and does not answer" in ran.err


def test_wrong_flags_are_explained_before_anything_is_asked(run, endpoint, tmp_path):
    assert "give NAME=VALUE" in run("fleet", "list", "--connect", endpoint, "--where", "site").err
    assert "--expect-nodes: give that too" in run("fleet", "list", "--connect", endpoint, "--update").err
    assert run("fleet", "list", "--connect", endpoint, "--expect-nodes", tmp_path / "no.txt").code == 2
