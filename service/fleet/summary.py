"""The result of a rollout: the nodes by what is known of them at its end."""

from typing import NamedTuple

from neurove_protocol.errors import EXIT_FAILURE, EXIT_PARTIAL
from neurove_service.fleet.ledger import Ledger, Target
from neurove_service.fleet.roster import NOT_CONNECTED, Roster


class Summary(NamedTuple):
    """The nodes by result, each with a sentence."""

    fine: dict[str, str]  # heard at the end of their soak, and at the end of the rollout
    already: dict[str, str]  # served the bundle before
    failed: dict[str, str]
    reverted: dict[str, str]  # they did not fail themselves, and serve their model before again
    pending: dict[str, str]  # not changed
    unheard: dict[str, str]  # nothing is known of them now
    skipped: dict[str, str]

    @property
    def exit_code(self) -> int:
        """0: every node is fine; 4: some are; 1: none is."""
        good = len(self.fine) + len(self.already)
        bad = sum(map(len, self)) - good
        return 0 if not bad else EXIT_PARTIAL if good else EXIT_FAILURE


def summary_of(ledger: Ledger, found: Roster) -> Summary:
    """The nodes of a rollout by result; a node without an answer now is neither fine nor unchanged.

    Args:
        ledger: of the rollout.
        found: who answers now.
    """
    summary = Summary({}, {}, {}, {}, {}, dict(ledger.unknown), dict(ledger.skipped))
    for one in ledger.targets.values():
        kind, why = _of_target(one, found)
        getattr(summary, kind)[one.node] = why
    for node in ledger.already:
        reply = found.replies.get(node)
        if reply is None:
            summary.unheard[node] = found.silent.get(node, NOT_CONNECTED)
        elif reply.model.digest != ledger.terms.digest:
            summary.failed[node] = f"serves {reply.model.name} ({reply.model.digest[:12]}) now"
        else:
            summary.already[node] = "served the bundle before" if reply.ok else f"served it before; not ok: {reply.why}"
    return summary


def _of_target(one: Target, found: Roster) -> tuple[str, str]:
    if one.state == "fine":
        reply = found.replies.get(one.node)
        if reply is not None:
            return "fine", reply.change or "serves the bundle"
        return "unheard", f"was fine, and {found.silent.get(one.node, NOT_CONNECTED)}"
    if one.failed:
        return "failed", one.why if one.state == "failed" else f"{one.fault}; now it {one.why}"
    if one.state in ("changing", "active"):
        return "unheard", one.why or "its soak did not end"
    return one.state, one.why or "was not changed"
