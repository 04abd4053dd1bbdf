"""Journal and ledger: what is written is what is read, whatever a kill left behind."""

import json

import pytest

from neurove_protocol.errors import InvalidField
from neurove_service.fleet.journal import Journal
from neurove_service.fleet.ledger import Ledger, Terms, start_fields
from neurove_service.fleet.roster import Roster
from neurove_service.fleet.selection import Selection
from neurove_service.fleet.summary import summary_of
from tests.service.metrics.test_families import reply

DIGEST = reply().model.digest
TERMS = Terms("/x/new.safetensors", "new", DIGEST, ("1", "100%"), 60.0, 10.0, 0, 30.0)
CHOSEN = Selection(("a", "b", "c", "d"), ("e",), {"d": "serves other"}, {"f": "is silent"})
EVENTS = (
    ("step", {"number": 1}),
    ("change", {"node": "a", "before": "ab" * 32, "rollbacks": 0}),
    ("active", {"node": "a"}),
    ("fine", {"node": "a"}),
    ("step", {"number": 2}),
    ("change", {"node": "b", "before": "ab" * 32, "rollbacks": 0}),
    ("failed", {"node": "b", "why": "not ok"}),
    ("stop", {"why": "1 failed"}),
)


@pytest.fixture
def written(tmp_path):
    path = tmp_path / "j.jsonl"
    with Journal(path, new=True) as journal:
        journal.append("start", start_fields(TERMS, CHOSEN))
        for kind, fields in EVENTS:
            journal.append(kind, fields)
    return path


def test_every_truncation_of_a_journal_is_read_up_to_its_last_whole_line(written):
    content = written.read_bytes()
    whole = [json.loads(line) for line in content.splitlines()]
    for length in range(len(content.splitlines()[0]) + 1, len(content) + 1, 41):
        written.write_bytes(content[:length])
        with Journal(written, new=False) as journal:
            assert journal.events == whole[: content[:length].count(b"\n")]
            Ledger(journal.events)
            journal.append("resume", {"max_failed": 0})
        assert json.loads(written.read_text().splitlines()[-1])["event"] == "resume"


def test_the_ledger_holds_terms_and_states(written):
    with Journal(written, new=False) as journal:
        ledger = Ledger(journal.events)
    assert ledger.terms == TERMS
    assert {node: one.state for node, one in ledger.targets.items()} == {"a": "fine", "b": "failed", "c": "pending"}
    assert [one.node for one in ledger.to_revert()] == ["b"]
    assert (ledger.step, ledger.stopped) == (2, "1 failed")


def test_a_resume_goes_on_only_with_more_failures_allowed(written):
    with Journal(written, new=False) as journal:
        ledger = Ledger(journal.events)
    ledger.apply({"event": "reverted", "node": "b", "why": "serves old"})
    ledger.apply({"event": "resume", "max_failed": 0})
    assert ledger.stopped == "1 failed"
    ledger.apply({"event": "resume", "max_failed": 1})
    assert ledger.stopped == ""
    assert ledger.targets["b"].state == "reverted"  # it failed itself, and is not tried again
    assert ledger.targets["b"].fault == "not ok"


def test_only_a_node_that_answers_now_is_fine(written):
    with Journal(written, new=False) as journal:
        ledger = Ledger(journal.events)
    silent = summary_of(ledger, Roster({}, {"a": "is connected and does not answer"}, 0.0, 0))
    assert (silent.fine, set(silent.unheard), silent.exit_code) == ({}, {"a", "e", "f"}, 1)
    found = summary_of(ledger, Roster({"a": reply("a"), "e": reply("e")}, {}, 0.0, 0))
    assert (set(found.fine), set(found.already), set(found.failed)) == ({"a"}, {"e"}, {"b"})
    assert (set(found.pending), set(found.skipped), set(found.unheard), found.exit_code) == ({"c"}, {"d"}, {"f"}, 4)


def test_one_rollout_at_a_time_has_a_journal(written):
    with (
        Journal(written, new=False),
        pytest.raises(InvalidField, match="another rollout uses this journal"),
        Journal(written, new=False),
    ):
        pass


@pytest.mark.parametrize(
    "content", ["", "[]\n", "{}\n", '{"event": "start", "format": 2}\n', '{"event": 3}\n', "\x00\n"]
)
def test_what_is_no_journal_is_refused(tmp_path, content):
    (tmp_path / "j").write_text(content)
    with pytest.raises(InvalidField, match="--resume"), Journal(tmp_path / "j", new=False) as journal:
        Ledger(journal.events)
