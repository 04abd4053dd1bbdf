"""Sharing: which streams a node takes, by pattern, and by a draw among the nodes that are alive."""

import fnmatch
import hashlib
import math
import threading
import time
from collections.abc import Mapping

from neurove_protocol.keys import Keys
from neurove_service import logs
from neurove_service.guard import Guard
from neurove_service.node.fellows import Fellows
from neurove_service.node.followers import Followers
from neurove_service.streams.registry import StreamRegistry
from neurove_service.transport import Transport

log = logs.get(__name__)

_TURN_S = 0.1
_RETRY_S = 0.5  # after a stream could not be given away


def drawn(stream: str, capacities: Mapping[str, int]) -> list[str]:
    """Nodes in the order in which they take a stream: rendezvous hashing, weighted by capacity.

    A node that leaves changes only the streams that it had; one that joins takes its share from all others.

    >>> nodes = {"n1": 1, "n2": 1, "n3": 2}
    >>> drawn("cam0", nodes)
    ['n2', 'n3', 'n1']
    >>> drawn("cam0", {"n1": 1, "n2": 1})
    ['n2', 'n1']
    """

    def score(node: str) -> float:
        digest = hashlib.sha256(f"{stream} {node}".encode()).digest()
        return capacities[node] / -math.log((int.from_bytes(digest[:8], "big") + 1) / (2**64 + 1))

    return sorted(capacities, key=lambda node: (-score(node), node))


class Sharing:
    """Decides which streams this node takes.

    Args:
        node: name of this node.
        patterns: of the names of its streams, such as `left_*`.
        copies: number of nodes that serve each stream; 0: every node serves every stream.
        capacity: of this node, relative to the others.
    """

    def __init__(self, node: str, patterns: tuple[str, ...], copies: int, capacity: int) -> None:
        self._node, self._patterns, self.copies = node, patterns, copies
        self._capacities = {node: capacity}
        self._known: dict[str, bool] = {}  # stream -> whether this node takes it
        self._lock = threading.Lock()

    def join(self, transport: Transport, keys: Keys) -> None:
        """Declare the capacity of this node, and hear those of the others."""
        if self.copies:
            transport.token(keys.shares(self._node, self._capacities[self._node]))
            transport.watch_tokens(keys.shares(), lambda key, present: self.on_token(*keys.shared_of(key), present))

    def on_token(self, node: str, capacity: int, present: bool) -> None:
        """A node has joined or left."""
        if node == self._node:
            return
        with self._lock:
            if present:
                self._capacities[node] = capacity
            else:
                self._capacities.pop(node, None)
            self._known.clear()
        log.info("sharing nodes changed", nodes=len(self._capacities))

    def takes(self, stream: str) -> bool:
        """Whether this node takes a stream."""
        with self._lock:
            known = self._known.get(stream)
            if known is None:
                known = any(fnmatch.fnmatchcase(stream, pattern) for pattern in self._patterns)
                if known and self.copies:
                    known = self._node in drawn(stream, self._capacities)[: self.copies]
                if len(self._known) >= 4096:
                    self._known.clear()
                self._known[stream] = known
            return known


class Moving:
    """Gives away the streams that other nodes take now: first another node follows with equal state, then it answers.

    It also ends the workers of streams that this node follows no more because it cannot keep up.

    Args:
        sharing: which streams this node takes.
        registry: the streams that it serves.
        fellows: the other nodes.
        followers: which streams it follows.
        guard: counts internal errors.
    """

    def __init__(
        self, sharing: Sharing, registry: StreamRegistry, fellows: Fellows, followers: Followers, guard: Guard
    ) -> None:
        self._sharing, self._registry, self._fellows = sharing, registry, fellows
        self._followers, self._guard = followers, guard
        self._next_s: dict[str, float] = {}  # stream -> when to try again to give it away

    def start(self, stop: threading.Event) -> None:
        """Look for such streams on a thread until the event is set."""
        threading.Thread(target=self._run, args=(stop,), name="sharing", daemon=True).start()

    def _run(self, stop: threading.Event) -> None:
        while not stop.wait(_TURN_S):
            with self._guard.at("sharing"):
                self._followers.turn(self._registry.streams())
                self._registry.release()
            for stream in self._registry.streams():
                if not self._sharing.takes(stream.name):
                    with self._guard.at("sharing", stream=stream.name):
                        self._give_away(stream.name)

    def _give_away(self, stream: str) -> None:
        now_s, others = time.monotonic(), len(self._fellows.names(stream))
        if others < self._sharing.copies or now_s < self._next_s.get(stream, 0.0):
            return
        if self._fellows.leaves(stream):
            self._next_s.pop(stream, None)
            self._registry.release()
            log.info("stream given away", stream=stream)
        else:
            self._next_s[stream] = time.monotonic() + _RETRY_S
