"""Which nodes of a rollout wait for each other because they stand by for each other."""

import pytest

from neurove_protocol.control import StandbyStatus
from neurove_service.fleet import pairs
from neurove_service.fleet.ledger import Target
from neurove_service.node.condition import Condition
from tests.service.metrics.test_families import reply, status

FOLLOWS = StandbyStatus(role="follows", leader="a", term=1, equal=True)
COLD = "; ".join(Condition(other_models={"cam0": "old", "cam1": "old"}).reasons())


def serving(*streams, standby=FOLLOWS, **fields):
    """The health of a node with these streams."""
    return reply(streams=[status(name, standby=standby) for name in streams], **fields)


@pytest.fixture
def replies():
    return {
        "a": serving("cam0"),
        "b": serving("cam0", "cam1"),
        "c": serving("cam1"),
        "d": serving("cam2"),
        "e": serving("cam2", standby=None),  # without standby it publishes whatever others do
    }


def names(targets):
    return [one.node for one in targets]


def test_nodes_with_a_stream_in_common_are_partners(replies):
    assert pairs.partners(replies) == {"a": {"b"}, "b": {"a", "c"}, "c": {"b"}, "d": set(), "e": set()}


def test_of_partners_one_is_changed_at_a_time(replies):
    wanted = [Target(node) for node in "abcde"]
    assert names(pairs.apart(wanted, replies, ())) == ["a", "c", "d", "e"]
    assert names(pairs.apart([wanted[1], wanted[3]], replies, ["a", "c"])) == ["d"]
    assert names(pairs.apart(wanted[1:2], replies, ["d"])) == ["b"]


def test_a_node_that_lacks_only_a_partner_with_its_model_is_excused_until_that_one_has_changed():
    cold = serving("cam0", ok=False, why=COLD)
    assert pairs.excused(cold, {"b"}, {"b"}).ok
    assert not pairs.excused(cold, {"b"}, {"c"}).ok
    assert not pairs.excused(cold.model_copy(update={"why": f"{COLD}; cam0 is lossy"}), {"b"}, {"b"}).ok
