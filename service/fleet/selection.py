"""Which nodes a rollout is about, and in which order it changes them."""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

from neurove_service.fleet.inventory import Expected
from neurove_service.fleet.roster import Roster
from neurove_service.fleet.where import Condition, facts_of, selected


class Selection(NamedTuple):
    """The nodes of a rollout."""

    targets: tuple[str, ...]  # in the order of their change: healthy ones, then others, then those that do not answer
    already: tuple[str, ...]  # they serve the bundle
    skipped: dict[str, str]  # of the targets: why they must not be changed
    unknown: dict[str, str]  # silent nodes without known labels, which may meet the conditions -> what they do


def select(
    roster: Roster,
    expected: Mapping[str, Expected],
    conditions: Sequence[Condition],
    digest: str,
    expect: str | None = None,
) -> Selection:
    """Select nodes.

    Args:
        roster: who answers.
        expected: the inventory.
        conditions: that a node must meet. A silent node meets them by the labels of the inventory.
        digest: of the bundle.
        expect: first digits of the digest of the model that a node must serve to be changed.
    """
    chosen = [one for one in roster.replies.values() if selected(facts_of(one), conditions)]
    already = tuple(one.node for one in chosen if one.model.digest == digest)
    due = sorted((one for one in chosen if one.model.digest != digest), key=lambda one: (not one.ok, one.node))
    skipped = {
        one.node: f"serves {one.model.name} ({one.model.digest[:12]}), not {expect}"
        for one in due
        if expect is not None and not one.model.digest.startswith(expect)
    }
    silent, unknown = [], {}
    for node, why in roster.silent.items():
        known = expected.get(node)
        facts = {"node": node} | dict(known.labels if known else {})
        if selected(facts, conditions):
            silent.append(node)
        elif all(one.name not in facts or one.holds(facts) for one in conditions):
            unknown[node] = why
    return Selection((*(one.node for one in due), *silent), already, skipped, unknown)
