"""Conditions of `--where`."""

import pytest

from neurove_protocol.errors import InvalidField
from neurove_service.fleet.where import Condition, facts_of, selected
from tests.service.metrics.test_families import reply

FACTS = {"node": "rover-1", "site": "hall-2", "model": "default", "digest": "87af15e1" + "0" * 56, "verdict": "ok"}


@pytest.mark.parametrize(
    ("conditions", "holds"),
    [
        ([], True),
        (["site=hall-2"], True),
        (["site=hall-*", "node=rover-?"], True),
        (["site=hall-2", "node=rover-2"], False),
        (["robot=spot"], False),  # a node without the label is not selected
        (["robot=*"], False),
        (["digest=87af15e1"], True),
        (["digest=87af"], False),  # too short to be the beginning of a digest
        (["model=DEFAULT"], False),
    ],
)
def test_a_node_is_selected_if_every_condition_holds(conditions, holds):
    assert selected(FACTS, [Condition.parse(text) for text in conditions]) is holds


@pytest.mark.parametrize("text", ["", "site", "=x", "site=", "a/b=c", "seen=now"])
def test_a_wrong_condition_names_what_is_known(text):
    with pytest.raises(InvalidField, match=r"--where=.*: give NAME=VALUE; NAME is a label or one of node, verdict"):
        Condition.parse(text)


def test_a_label_of_a_peer_cannot_replace_a_fact():
    facts = facts_of(reply("n1", labels={"node": "other", "site": "hall-2"}))
    assert (facts["node"], facts["site"]) == ("n1", "hall-2")
