"""`neurove rollout` with real nodes: a good bundle, bad ones, a kill -9 in the middle, nodes that are not there."""

import contextlib
import json

import pytest

from neurove_service.config import ClientConfig
from neurove_service.fleet import roster
from tests.live.conftest import Process, wait_until
from tests.live.fellows import Driver, follows
from tests.live.fleet_nodes import Fleet

pytestmark = pytest.mark.live

QUICK = ("--grace", "0.3", "--patience", "600")  # a busy machine may need a second attempt for a change
NODES = ("n0", "n1", "n2", "n3", "n4", "n5")


@pytest.fixture(scope="module")
def fleet(tmp_path_factory):
    """Six nodes; n1 stores no pushed model."""
    with contextlib.ExitStack() as stack:
        fleet = Fleet(tmp_path_factory.mktemp("fleet"), stack)
        for number, name in enumerate(NODES):
            fleet.add(name, stores=name != "n1", site=f"hall-{number % 2}")
        yield fleet


@pytest.fixture
def rollout(run, fleet):
    def call(*arguments):
        return run("rollout", "--connect", fleet.endpoint, "--timeout", "60", *arguments)

    return call


def serving(fleet):
    found = roster.ask(fleet.transport, ClientConfig(connect=(fleet.endpoint,)), timeout_s=60.0)
    return {node: reply.model.name for node, reply in found.replies.items()}


@pytest.fixture
def all_serve_one(fleet, run):
    def done():
        run("activate", "one", "--connect", fleet.endpoint, "--all")
        return serving(fleet) == dict.fromkeys(NODES, "one")

    wait_until(done)


def events_of(path):
    return [json.loads(line) for line in path.read_text().splitlines()]


def test_a_dry_run_shows_the_steps_and_changes_nothing(fleet, rollout, all_serve_one, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    ran = rollout(fleet.bundle("two"), "--dry-run", "--where", "site=hall-0", "--json")
    plan = json.loads(ran.out)
    assert (ran.code, plan["steps"]) == (0, [["n0"], ["n2"], ["n4"]])
    assert "step 3: 4 nodes: n2, n3, n4, n5" in rollout(fleet.bundle("two"), "--dry-run").out
    assert rollout(fleet.bundle("one"), "--dry-run").out.splitlines()[-1].startswith("  serve it already: n0, n1, ")
    assert list(tmp_path.iterdir()) == []
    assert set(serving(fleet).values()) == {"one"}


def test_a_node_that_fails_stops_the_rollout_and_the_rest_of_its_step_is_reverted_then_it_goes_on(
    fleet, rollout, all_serve_one, tmp_path
):
    journal = tmp_path / "j.jsonl"
    new = (fleet.bundle("two"), "--plan", "1,3,100%", "--soak", "0.5", *QUICK, "--journal", journal)
    ran = rollout(*new)
    assert ran.code == 4
    assert serving(fleet) == dict.fromkeys(NODES, "one") | {"n0": "two"}
    end = events_of(journal)[-1]["summary"]
    assert (set(end["fine"]), set(end["failed"]), set(end["reverted"]) | set(end["pending"])) == (
        {"n0"},
        {"n1"},
        {"n2", "n3", "n4", "n5"},
    )
    assert "this node stores no pushed models" in end["failed"]["n1"]
    again = rollout("--resume", journal)
    assert (again.code, "the rollout has stopped: 1 failed" in again.err) == (4, True)
    on = rollout("--resume", journal, "--max-failed", "1", "--json")
    assert on.code == 4
    assert serving(fleet) == dict.fromkeys(NODES, "two") | {"n1": "one"}
    assert [event["node"] for event in events_of(journal) if event["event"] == "failed"] == ["n1"]
    assert json.loads(on.out.splitlines()[-1])["summary"]["failed"] == end["failed"]


def test_a_bundle_that_makes_the_first_node_not_ok_reaches_no_other(fleet, rollout, all_serve_one, tmp_path):
    ran = rollout(fleet.bundle("bad"), "--soak", "30", *QUICK, "--journal", tmp_path / "j", "--max-failed", "3")
    assert ran.code == 1
    assert "n0: failed: not ok for" in ran.out
    assert "stop: no node of step 1 is fine" in ran.out
    changed = [event["node"] for event in events_of(tmp_path / "j") if event["event"] == "change"]
    assert changed == ["n0"]
    assert set(serving(fleet).values()) == {"one"}


def test_a_rollout_that_is_killed_goes_on_from_its_journal(fleet, rollout, all_serve_one, tmp_path):
    journal = tmp_path / "j"
    flags = ("--where", "node=n[0-9]", "--where", "site=hall-0", "--soak", "0.5", *QUICK, "--journal", str(journal))
    command = ("rollout", str(fleet.bundle("two")), "--connect", fleet.endpoint, *flags)
    process = Process(*command)
    wait_until(
        lambda: (journal.exists() and '"change", "node": "n2"' in journal.read_text()) or process.child.poll(), 300.0
    )
    process.child.kill()
    process.end()
    with journal.open("a") as file:
        file.write('{"at": "2026-')  # what a kill in the middle of a line leaves
    ran = rollout("--resume", journal)
    assert ran.code == 0
    events = events_of(journal)
    assert {event["node"] for event in events if event["event"] == "fine"} == {"n0", "n2", "n4"}
    assert [event["event"] for event in events].count("end") == 1
    assert [event["node"] for event in events if event["event"] == "fine"].count("n0") == 1
    assert [node for node, model in serving(fleet).items() if model == "two"] == ["n0", "n2", "n4"]


def test_a_node_that_is_not_there_is_named_and_never_fine(fleet, rollout, all_serve_one, tmp_path):
    nodes = tmp_path / "nodes.txt"
    nodes.write_text("absent site=hall-0\nelsewhere site=mars\n")
    flags = ("--where", "site=hall-0", "--expect-nodes", nodes, "--expect", "00000000")
    code = rollout(fleet.bundle("two"), *flags, "--soak", "0.3", "--patience", "0.5", "--journal", tmp_path / "j").code
    end = events_of(tmp_path / "j")[-1]["summary"]
    assert code == 1
    assert end["pending"] == {"absent": "is expected and not connected"}
    assert set(end["skipped"]) == {"n0", "n2", "n4"}
    assert not end["fine"]


def test_wrong_use_is_explained_and_changes_nothing(fleet, rollout, tmp_path):
    two = fleet.bundle("two")
    assert "give numbers of nodes above 0" in rollout(two, "--plan", "1,ten").err
    assert "each step must be larger" in rollout(two, "--plan", "5,3").err
    assert "no node meets the conditions" in rollout(two, "--where", "site=mars").err
    assert "give the bundle, or --resume" in rollout().err
    assert "is not an event" in rollout("--resume", two).err
    assert "--soak" in rollout("--resume", two, "--soak", "3").err
    (tmp_path / "j").touch()
    assert "the file exists" in rollout(two, "--journal", tmp_path / "j").err
    with pytest.raises(SystemExit):
        rollout(two, "--soak", "ten")


def test_nodes_that_stand_by_for_each_other_are_changed_one_after_the_other(run, tmp_path):
    with contextlib.ExitStack() as stack:
        fleet = Fleet(tmp_path, stack)
        for name in ("left", "right"):
            fleet.add(name, standby="lot")
        driver = Driver(fleet.transport, ["cam0"], step_us=25_000).start()
        stack.callback(driver.stop)
        wait_until(lambda: any(follows(fleet.transport, name, "cam0") for name in ("left", "right")))
        journal = tmp_path / "journal.jsonl"
        ran = run(
            *("rollout", fleet.bundle("two"), "--connect", fleet.endpoint, "--timeout", "60", "--plan", "100%"),
            *("--soak", "1", "--grace", "60", "--patience", "600", "--journal", journal),
        )
        assert ran.code == 0, ran.out
        changes = [(one["event"], one["node"]) for one in events_of(journal) if one["event"] in {"change", "fine"}]
        first = changes[0][1]
        (second,) = {"left", "right"} - {first}
        assert changes == [("change", first), ("fine", first), ("change", second), ("fine", second)]
