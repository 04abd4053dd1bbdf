"""Rollout: a bundle for many nodes, step by step, each step after the one before has proven itself.

Every event is in the journal before the next action, so a rollout that was killed goes on from its journal. The ledger,
which is a function of these events, is the only state that outlives a process.
"""

import threading
import time
from collections.abc import Callable, Iterable, Mapping
from typing import Any, Final, NamedTuple

from neurove_protocol.control import HealthReply
from neurove_service.config import ClientConfig
from neurove_service.fleet import pairs, plan, roster
from neurove_service.fleet.changing import Changer, Crew
from neurove_service.fleet.journal import Event, Journal
from neurove_service.fleet.ledger import Ledger, Target, Terms
from neurove_service.fleet.roster import Roster
from neurove_service.fleet.soak import Soak
from neurove_service.fleet.summary import Summary, summary_of
from neurove_service.transport import Transport

POLL_S: Final = 1.0
"""Time between two queries of all nodes [s]; a fifth of a shorter soak."""

REPLIES_PER_S: Final = 100
"""A larger fleet is queried less often, so that the answers stay below this rate."""

_RETRY_S: Final = 5.0  # between two attempts to change one node


class Turn(NamedTuple):
    """Where a rollout is."""

    step: int
    changing: int
    soaking: int
    left_s: float  # of the longest soak
    fine: int
    failed: int
    pending: int


def turn_of(ledger: Ledger, soaks: Mapping[str, Soak], changing: int) -> Turn:
    """Where a rollout is.

    Args:
        ledger: of the rollout.
        soaks: by node.
        changing: number of nodes that change now.
    """
    now_s, soaking = time.monotonic(), ledger.of("active")
    left_s = max((soaks[one.node].left_s(now_s) for one in soaking if one.node in soaks), default=0.0)
    counts = len(ledger.of("fine")), len(ledger.failed), len(ledger.of("pending"))
    return Turn(ledger.step, changing, len(soaking), left_s, *counts)


def soak_of(terms: Terms, began_s: float) -> Soak:
    """The soak of a node that became active at a time of the monotonic clock [s]."""
    return Soak(terms.digest, began_s, terms.soak_s, terms.grace_s, terms.patience_s)


class Rollout:
    """One rollout, new or resumed.

    Args:
        transport: an open session.
        config: the deployment's prefix.
        journal: with at least its start.
        changer: changes one node.
        on_event: called with each event after it is in the journal.
        on_turn: called after each query of all nodes.
    """

    def __init__(
        self,
        transport: Transport,
        config: ClientConfig,
        journal: Journal,
        changer: Changer,
        on_event: Callable[[Event], None] = lambda _: None,
        on_turn: Callable[[Turn], None] = lambda _: None,
    ) -> None:
        self._transport, self._config, self._journal = transport, config, journal
        self._on_event, self._on_turn = on_event, on_turn
        self.ledger = Ledger(journal.events)
        self._terms = self.ledger.terms
        self._poll_s = max(min(POLL_S, self._terms.soak_s / 5), 0.05, len(self.ledger.targets) / REPLIES_PER_S)
        self._soaks: dict[str, Soak] = {}
        self._retry_at_s: dict[str, float] = {}
        self._crew = Crew(changer, self._terms.parallel)

    def run(self) -> int:
        """Change every node, or stop; the exit code of the command: 0 all are fine, 4 some, 1 none.

        Raises:
            OSError: the journal cannot be written.
        """
        try:
            for number, size in enumerate(plan.sizes(self._terms.steps, len(self.ledger.targets)), 1):
                if number >= self.ledger.step and (self.ledger.stopped or not self._step(number, size)):
                    break
            if self.ledger.stopped:
                self._revert()
        finally:
            self._crew.close()
        summary = self._summary()
        self._emit("end", exit_code=summary.exit_code, summary=summary._asdict())
        return summary.exit_code

    def _emit(self, event: str, **fields: Any) -> None:
        written = self._journal.append(event, fields)
        self.ledger.apply(written)
        self._on_event(written)

    def _ask(self) -> Roster:
        return roster.ask(self._transport, self._config, (*self.ledger.targets, *self.ledger.already))

    def _step(self, number: int, size: int) -> bool:
        """Change nodes until `size` have been changed, and watch them; whether the next step may begin."""
        if number > self.ledger.step:
            self._emit("step", number=number, size=size, of=len(self.ledger.targets))
        give_up_s = time.monotonic() + self._terms.patience_s
        tried: set[str] = set()
        while True:
            found = self._ask()
            self._take_outcomes()
            self._judge(found, time.monotonic())
            if self._terms.on_failure != "stop":
                self._undo(found, self.ledger.of("failed"))
            if why := self.ledger.too_many:
                return self._end_step(why)
            counted = len(self.ledger.targets) - len(self.ledger.of("pending", "skipped"))
            tried |= self._begin(found, size - counted)
            self._on_turn(turn_of(self.ledger, self._soaks, len(self._crew.running)))
            left = self._interrupted() or (size > counted and self.ledger.of("pending"))
            waits = left and time.monotonic() < give_up_s
            if not (self._crew.running or self.ledger.of("active") or waits):
                return self._proven(number, tried)
            threading.Event().wait(self._poll_s)

    def _end_step(self, why: str) -> bool:
        """Stop, after the changes that run have ended, which a node does in bounded time."""
        while self._crew.running:
            threading.Event().wait(0.05)
            self._take_outcomes()
        self._emit("stop", why=why)
        return False

    def _interrupted(self) -> list[Target]:
        """The nodes whose change was sent by a process that was killed."""
        return [one for one in self.ledger.of("changing") if one.node not in self._crew.running]

    def _begin(self, found: Roster, due: int) -> set[str]:
        """Start the change of `due` nodes that answer now, and of the interrupted ones; their names."""
        for target in self.ledger.of("pending"):
            why = found.silent.get(target.node, target.why)
            if target.why != why:
                self._emit("offline", node=target.node, why=why)
        now_s = time.monotonic()
        heard = [
            one
            for one in self.ledger.of("pending")
            if one.node in found.replies and self._retry_at_s.get(one.node, now_s) <= now_s
        ]
        busy = [one.node for one in self.ledger.of("changing", "active")]
        heard = pairs.apart(heard, found.replies, busy)
        wanted = [one for one in self._interrupted() if one.node in found.replies] + heard[: max(0, due)]
        return {one.node for one in wanted[: self._crew.free] if self._change(one, found.replies[one.node])}

    def _change(self, target: Target, reply: HealthReply) -> bool:
        """Start the change of a node, unless its answer forbids it."""
        digest, expect = reply.model.digest, self._terms.expect
        if target.state == "changing" and digest != self._terms.digest and reply.rollbacks > target.rollbacks:
            self._emit("failed", node=target.node, why=f"rolled back automatically: {reply.change}")
            return False
        if expect is not None and not (digest.startswith(expect) or digest == self._terms.digest):
            self._emit("skipped", node=target.node, why=f"serves {reply.model.name} ({digest[:12]}), not {expect}")
            return False
        if target.state == "pending":
            before = digest if digest != self._terms.digest else ""
            self._emit("change", node=target.node, before=before, rollbacks=reply.rollbacks)
        self._crew.change(target)
        return True

    def _take_outcomes(self) -> None:
        for target, outcome in self._crew.outcomes():
            now_s = time.monotonic()
            if outcome.result == "active":
                self._soaks[target.node] = soak_of(self._terms, now_s)
                self._emit("active", node=target.node, why=outcome.why, soak_s=self._terms.soak_s)
            elif outcome.result == "failed":
                self._emit("failed", node=target.node, why=outcome.why)
            else:
                self._retry_at_s[target.node] = now_s + _RETRY_S
                self._emit("offline", node=target.node, why=outcome.why)

    def _judge(self, found: Roster, now_s: float) -> None:
        """Apply the answers to the nodes that have the bundle; only an answer makes a node fine."""
        others = pairs.partners(found.replies)
        unchanged = {one.node for one in self.ledger.of("pending", "changing")}
        for target in self.ledger.of("active", "fine"):
            was_fine, reply = target.state == "fine", found.replies.get(target.node)
            if target.node not in self._soaks:  # of a resumed rollout: a soak that was interrupted begins again
                self._soaks[target.node] = soak_of(self._terms, now_s - self._terms.soak_s * was_fine)
            soak = self._soaks[target.node]
            if reply is None and was_fine:
                continue
            reply = reply and pairs.excused(reply, others[target.node], unchanged)
            silence = found.silent.get(target.node, roster.NOT_CONNECTED)
            finding = soak.heard(reply, now_s, found.asked_s) if reply is not None else soak.silent(now_s, silence)
            if finding.result == "failed":
                self._emit("failed", node=target.node, why=finding.why)
            elif finding.result == "fine" and not was_fine:
                self._emit("fine", node=target.node)

    def _proven(self, number: int, tried: set[str]) -> bool:
        """Whether the nodes of a step show that the next step may begin; if all of them failed, the rollout stops."""
        changed = [one for one in self.ledger.targets.values() if one.step == number and one.state != "pending"]
        if any(one.state == "fine" for one in changed):
            return True
        if any(one.node in tried for one in changed):
            return self._end_step(f"no node of step {number} is fine")
        return bool(changed)  # they failed before, and the user accepted it; without any node there is no proof

    def _undo(self, found: Roster, targets: Iterable[Target]) -> None:
        """Let those of these nodes that answer serve their model before again."""
        serving = []
        for target in targets:
            reply = found.replies.get(target.node)
            if reply is not None and reply.model.digest != self._terms.digest:
                self._emit("reverted", node=target.node, why=f"serves {reply.model.name} ({reply.model.digest[:12]})")
            elif reply is not None and self._retry_at_s.get(target.node, 0.0) <= time.monotonic():
                serving.append(target)
        for target, outcome in self._crew.revert(serving):
            self._retry_at_s[target.node] = time.monotonic() + _RETRY_S
            self._emit("reverted" if outcome.result == "reverted" else "kept", node=target.node, why=outcome.why)

    def _revert(self) -> None:
        """Undo what `on_failure` asks for; nodes that do not answer are retried."""
        give_up_s = time.monotonic() + self._terms.patience_s
        while left := self.ledger.to_revert():
            self._undo(self._ask(), left)
            if time.monotonic() >= give_up_s:
                for target in self.ledger.to_revert():
                    self._emit("kept", node=target.node, why="did not answer, and may still serve the bundle")
                return
            if self.ledger.to_revert():
                threading.Event().wait(self._poll_s)

    def _summary(self) -> Summary:
        """The result. A node that was fine must answer once more; one that does not is retried."""
        give_up_s = time.monotonic() + self._terms.patience_s
        while True:
            found = self._ask()
            self._judge(found, time.monotonic())
            wanted = [*(one.node for one in self.ledger.of("fine")), *self.ledger.already]
            if all(node in found.replies for node in wanted) or time.monotonic() >= give_up_s:
                return summary_of(self.ledger, found)
            threading.Event().wait(self._poll_s)
