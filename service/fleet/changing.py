"""The change of one node in a rollout: push and activate, or the way back."""

import queue
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Final, Literal, NamedTuple

from neurove_protocol.control import PeerError, ProgressReply, PushRequest
from neurove_protocol.errors import Busy, Conflict, NeuroVEError, TransferInterrupted
from neurove_service.clients import ask
from neurove_service.config import ClientConfig
from neurove_service.fleet.ledger import Target, Terms
from neurove_service.transport import Transport

_LATER: Final = (Busy.code, Conflict.code, TransferInterrupted.code)  # the same request may succeed later


class Outcome(NamedTuple):
    """The result of a change.

    `active`: the node serves the bundle. `retry`: nothing changed, and a later attempt may succeed. `failed`: the node
    refused the bundle, rolled it back, or left while it changed. `reverted`: it serves its model before.
    """

    result: Literal["active", "retry", "failed", "reverted"]
    why: str = ""


class Changer:
    """Changes nodes; any thread may use it. While it works, chunks of the bundle must be answered.

    Args:
        transport: an open session.
        config: the deployment's prefix.
        terms: of the rollout.
        request: offers the bundle.
    """

    def __init__(self, transport: Transport, config: ClientConfig, terms: Terms, request: PushRequest) -> None:
        self._transport, self._config, self._terms, self._request = transport, config, terms, request

    def change(self, target: Target) -> Outcome:
        """Push the bundle to a node and activate it; the probation of the node has ended then, or waits for windows."""
        node, terms = target.node, self._terms
        try:
            ask.push(self._transport, self._config, self._request, node)
        except NeuroVEError as error:
            return _refused(node, error, left="retry")  # a push resumes
        steps: list[str] = []
        try:
            ask.activate(
                self._transport,
                self._config,
                terms.digest,
                node,
                expect=terms.expect,
                shadow_s=terms.shadow_s,
                on_progress=_noting(steps),
            )
        except NeuroVEError as error:
            return _refused(node, error, left="failed" if steps else "retry")
        return Outcome("active", steps[-1] if steps else "")

    def revert(self, target: Target) -> Outcome:
        """Let a node serve its model before again; `expect` keeps a change of another client."""
        node, digest = target.node, self._terms.digest
        try:
            reply = ask.rollback(self._transport, self._config, node, expect=digest)
            if target.before and reply.active.digest != target.before:
                reply = ask.activate(
                    self._transport,
                    self._config,
                    target.before,
                    node,
                    expect=reply.active.digest,
                    force="rollout reverted",
                )
        except NeuroVEError as error:
            return Outcome("retry", _text(node, error))
        return Outcome("reverted", f"serves {reply.active.name} ({reply.active.digest[:12]})")


class Crew:
    """Threads that change nodes, at most so many at once.

    Args:
        changer: changes one node.
        parallel: most changes at once.
    """

    def __init__(self, changer: Changer, parallel: int) -> None:
        self._changer, self._parallel = changer, parallel
        self._pool = ThreadPoolExecutor(parallel, thread_name_prefix="rollout")
        self._outcomes: queue.SimpleQueue[tuple[Target, Outcome]] = queue.SimpleQueue()
        self.running: set[str] = set()  # nodes whose change has begun, and whose outcome was not taken

    @property
    def free(self) -> int:
        """How many changes may begin now."""
        return self._parallel - len(self.running)

    def change(self, target: Target) -> None:
        """Begin the change of a node; `outcomes` gives its result."""
        self.running.add(target.node)
        self._pool.submit(self._work, target)

    def outcomes(self) -> Iterator[tuple[Target, Outcome]]:
        """The results that have come."""
        while not self._outcomes.empty():
            target, outcome = self._outcomes.get()
            self.running.discard(target.node)
            yield target, outcome

    def revert(self, targets: Sequence[Target]) -> Iterator[tuple[Target, Outcome]]:
        """Let nodes serve their model before again, and wait for it."""
        return zip(targets, self._pool.map(self._changer.revert, targets), strict=True)

    def close(self) -> None:
        """Begin nothing more; nodes go on with what they do."""
        self._pool.shutdown(wait=False, cancel_futures=True)

    def _work(self, target: Target) -> None:
        try:
            outcome = self._changer.change(target)
        except Exception as error:  # noqa: BLE001  # it must not leave the node without a result
            outcome = Outcome("failed", f"internal error of the client: {error!r}")
        self._outcomes.put((target, outcome))


def _noting(steps: list[str]) -> Callable[[ProgressReply], None]:
    return lambda progress: steps.append(f"{progress.step}: {progress.text}")


def _refused(node: str, error: NeuroVEError, left: Literal["retry", "failed"]) -> Outcome:
    if isinstance(error, PeerError):
        return Outcome("retry" if error.code in _LATER else "failed", _text(node, error))
    return Outcome(left, _text(node, error))


def _text(node: str, error: NeuroVEError) -> str:
    return error.message.removeprefix(f"{node}: ")
