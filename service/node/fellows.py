"""Fellows: the nodes that answer the same streams as this one; what they say to each other over the network."""

import threading
import time
from collections import defaultdict
from collections.abc import Callable, Sequence

from neurove_protocol import TwistEstimate
from neurove_protocol.codec import Message, MessageT
from neurove_protocol.duty import (
    DrainReply,
    DrainRequest,
    DutyReply,
    DutyRequest,
    StateReply,
    StateRequest,
    TakeRequest,
)
from neurove_protocol.errors import InvalidField, NeuroVEError
from neurove_protocol.keys import Keys
from neurove_service import logs
from neurove_service.streams.duty import Duty
from neurove_service.streams.pair import Pair
from neurove_service.streams.pulse import Pulse
from neurove_service.streams.tenure import Tenure
from neurove_service.transport import Transport

log = logs.get(__name__)

_STATE_S = 0.5  # for a state, on both sides
_STATES_AT_ONCE = 16  # requests for a state; each waits until its stream has reached the window
_FETCHES_AT_ONCE = 2  # of the states of other nodes; each keeps a worker waiting
_TOKENS_S = 1.0
_TAKE_S = 1.0
_POLL_S = 0.005


class Fellows:
    """Opens the duty of each stream, hears the other nodes, and answers their questions.

    Args:
        transport: an open session.
        keys: of the deployment.
        node: name of this node.
        reluctant: whether other nodes take precedence where no node answers yet.
    """

    def __init__(self, transport: Transport, keys: Keys, node: str, *, reluctant: bool) -> None:
        self._transport, self._keys, self._node, self._reluctant = transport, keys, node, reluctant
        self._pairs: dict[str, Pair] = {}
        self._serving: defaultdict[str, set[str]] = defaultdict(set)  # stream -> the other nodes that serve it
        self._heard_ns: dict[str, int] = {}  # other node -> when anything was heard of it last
        self._fetches, self._pulse = threading.BoundedSemaphore(_FETCHES_AT_ONCE), Pulse()
        self._lock, self._draining = threading.Lock(), False

    def join(self, stop: threading.Event) -> None:
        """Hear the other nodes and answer their questions, until the event is set; before the first packet."""
        self._pulse.start(stop)
        keys, node, transport = self._keys, self._node, self._transport
        transport.watch_tokens(keys.serves(), self._on_token)
        transport.subscribe_timed(keys.velocity(), self._on_estimate, remote=True)
        transport.answer(keys.duty(node), self._reply)
        transport.answer_streaming(keys.state(node), lambda request, _: self._state(request), _STATES_AT_ONCE)
        transport.answer(keys.take(node), self._take)
        transport.answer_streaming(keys.drain(node), lambda request, _: self._drain(request))
        transport.tokens(keys.serves(), _TOKENS_S)  # once these are there, those that are watched are known too

    def open_duty(self, stream: str, wake: Callable[[], None]) -> Duty:
        """The duty of a stream that begins."""
        tenure = Tenure(self._node, stream, self, reluctant=self._reluctant)
        pair = Pair(
            tenure, self, wake, on_close=lambda one: self._forget(stream, one), suspended_ns=self._pulse.longest_ns
        )
        pair.drain(draining=self._draining)
        self._pairs[stream] = pair
        return pair

    def names(self, stream: str) -> Sequence[str]:
        """The other nodes that serve a stream."""
        with self._lock:
            return sorted(self._serving.get(stream, ()))

    def heard_ns(self, node: str) -> int:
        """When an estimate or a reply of another node was heard last (monotonic); 0 if none was [ns]."""
        return self._heard_ns.get(node, 0)

    def duties(self) -> list[DutyReply]:
        """What this node does on each of its streams."""
        return [pair.reply() for pair in list(self._pairs.values())]

    def roles(self, stream: str, timeout_s: float) -> list[DutyReply]:
        """What the other nodes do on a stream, as far as they reply in time."""
        replies = self._ask(self._keys.duty(), DutyRequest(stream=stream), DutyReply, timeout_s)
        others = [one for one in replies if one.node != self._node]
        self._heard_ns |= dict.fromkeys([one.node for one in others], time.monotonic_ns())
        return others

    def state(self, stream: str, node: str, digest: str, after_us: int | None = None) -> StateReply | None:
        """The state of a stream on another node, after a window with this end or a later one; a few at once."""
        if not self._fetches.acquire(blocking=False):
            return None
        try:
            request = StateRequest(stream=stream, digest=digest, after_us=after_us)
            replies = self._ask(self._keys.state(node), request, StateReply, _STATE_S)
        finally:
            self._fetches.release()
        return replies[0] if replies else None

    def take(self, stream: str, node: str, term: int, last_us: int | None, timeout_s: float) -> bool:
        """Ask a node to answer a stream after a window of this node; whether it replies."""
        request = TakeRequest(stream=stream, node=self._node, term=term, start_us=last_us)
        return bool(self._ask(self._keys.take(node), request, DutyReply, timeout_s))

    def drain(self, *, resume: bool = False, patience_s: float = _TAKE_S) -> DrainReply:
        """Hand over every stream that this node answers to a node that follows it; `resume` ends the draining.

        Args:
            resume: whether the node may answer again.
            patience_s: how long to wait for each reply of another node [s].
        """
        self._draining = not resume
        pairs = dict(self._pairs)
        for pair in pairs.values():
            pair.drain(draining=not resume)
        handed, kept = dict[str, str](), dict[str, str]()
        for stream, pair in pairs.items() if not resume else ():
            if pair.reply().role != "answers":
                continue
            node, why = self._hand_over(stream, pair, patience_s)
            if node:
                handed[stream] = node
            else:
                kept[stream] = why
        log.info("drained" if not resume else "draining ended", handed=len(handed), kept=len(kept))
        return DrainReply(node=self._node, handed=handed, kept=kept)

    def retire(self, stream: str) -> bool:
        """Let the worker of a stream that this node follows end; False if this node does not follow it any more."""
        pair = self._pairs.get(stream)
        return pair is not None and pair.retire("follows")

    def leaves(self, stream: str) -> bool:
        """Hand over a stream if this node answers it, and let its worker end; whether another node answers it now."""
        pair = self._pairs.get(stream)
        if pair is None or pair.reply().role != "answers":
            return self.retire(stream)
        node, _ = self._hand_over(stream, pair, _TAKE_S)
        return bool(node) and pair.retire("follows", "listens")

    def _hand_over(self, stream: str, pair: Pair, patience_s: float) -> tuple[str, str]:
        """Hand over one stream; the node that answers it now, or why there is none."""
        others = self.roles(stream, patience_s) if self.names(stream) else []
        ready = sorted(one.node for one in others if one.role == "follows" and one.equal and not one.draining)
        if not ready:
            return "", "no other node follows it with equal state"
        target, resigned = ready[0], pair.resign(patience_s)
        if resigned is None:
            return "", "this node did not stop to answer"
        self.take(stream, target, resigned.term, resigned.start_us, patience_s)
        if not pair.pauses.flows:
            return target, ""
        deadline = time.monotonic() + 5 * patience_s
        while time.monotonic() < deadline:
            now = pair.reply()
            if now.role == "follows" and now.leader:
                return now.leader, ""
            if now.role == "answers":
                break
            threading.Event().wait(_POLL_S)
        return "", f"{target} has not published since the hand-over"

    def _forget(self, stream: str, closed: Pair) -> None:
        if self._pairs.get(stream) is closed:
            del self._pairs[stream]

    def _ask(self, key: str, request: Message, reply: type[MessageT], timeout_s: float) -> list[MessageT]:
        """The replies of the nodes; one that refuses, or whose reply cannot be read, costs itself."""
        try:
            answers = self._transport.ask(key, request.encode(), timeout_s, "urgent" if reply is DutyReply else "usual")
        except NeuroVEError as error:  # a node refused
            log.debug("no answer", key=key, why=error.message)
            return []
        found = list[MessageT]()
        for answer in answers:
            try:
                found.append(reply.decode(answer.payload))
            except NeuroVEError as error:
                log.warning("reply refused", key=answer.key, why=error.message)
        return found

    def _on_estimate(self, key: str, payload: bytes, received_ns: int, _sent_us: int | None) -> None:
        pair = self._pairs.get(self._keys.stream_of(key))
        if pair is not None:
            estimate = TwistEstimate.decode(payload)
            if estimate.node != self._node:
                self._heard_ns[estimate.node or ""] = received_ns
                pair.heard(estimate)

    def _on_token(self, key: str, present: bool) -> None:  # as transport calls it
        node, stream = self._keys.node_of(key), self._keys.served_of(key)
        if node == self._node:
            return
        with self._lock:
            (self._serving[stream].add if present else self._serving[stream].discard)(node)
        pair = self._pairs.get(stream)
        if pair is not None and not present:
            pair.gone(node)

    def _pair(self, what: str, stream: str) -> Pair:
        pair = self._pairs.get(stream)
        if pair is None:
            raise InvalidField(what, "stream", stream, "a stream that this node serves")
        return pair

    def _reply(self, request: bytes) -> bytes:
        wanted = DutyRequest.decode(request)
        pair = self._pairs.get(wanted.stream)
        absent = DutyReply(node=self._node, stream=wanted.stream, role="absent")
        return (pair.reply() if pair is not None else absent).encode()

    def _state(self, request: bytes) -> bytes:
        wanted = StateRequest.decode(request)
        reply = self._pair(wanted.what, wanted.stream).state(wanted.digest, wanted.after_us, _STATE_S)
        if reply is None:
            raise InvalidField(
                wanted.what, "digest", wanted.digest, "a model that has answered a window of this stream"
            )
        return reply.encode()

    def _take(self, request: bytes) -> bytes:
        wanted = TakeRequest.decode(request)
        pair = self._pair(wanted.what, wanted.stream)
        pair.take(wanted.node, wanted.term, wanted.start_us)
        return pair.reply().encode()

    def _drain(self, request: bytes) -> bytes:
        return self.drain(resume=DrainRequest.decode(request).resume).encode()
