"""Pairs: nodes that stand by for each other, as their health says; a rollout changes one of them at a time."""

from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence, Set
from typing import Final

from neurove_protocol.control import HealthReply
from neurove_service.fleet.ledger import Target

NOT_WARM: Final = "the standby of stream "
"""So begins what the health of a node says while the other node of a stream has another model."""


def partners(replies: Mapping[str, HealthReply]) -> dict[str, set[str]]:
    """The other nodes that serve a stream of a node with standby, for each node that answered."""
    serving = defaultdict[str, set[str]](set)
    for node, reply in replies.items():
        for status in reply.streams:
            if status.standby is not None:
                serving[status.stream].add(node)
    return {
        node: set[str]().union(*(nodes for nodes in serving.values() if node in nodes)) - {node} for node in replies
    }


def apart(wanted: Sequence[Target], replies: Mapping[str, HealthReply], busy: Iterable[str]) -> list[Target]:
    """Those nodes of `wanted`, in order, whose partners neither change nor are watched, nor are among them.

    Args:
        wanted: nodes that may change now.
        replies: of all nodes that answer.
        busy: nodes that change or are in their soak.
    """
    other, taken, found = partners(replies), set(busy), list[Target]()
    for target in wanted:
        if taken.isdisjoint(other.get(target.node, ())):
            taken.add(target.node)
            found.append(target)
    return found


def excused(reply: HealthReply, others: Set[str], unchanged: Set[str]) -> HealthReply:
    """The answer of a node, as ok where it lacks only a warm standby and its partner is still to change.

    Args:
        reply: the answer.
        others: the partners of the node.
        unchanged: the nodes whose turn comes later.
    """
    if reply.ok or others.isdisjoint(unchanged):
        return reply
    alone = all(part.startswith(NOT_WARM) for part in reply.why.split("; "))
    return reply.model_copy(update={"ok": True}) if alone else reply
