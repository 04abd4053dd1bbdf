"""Namesakes: other nodes of this node's name on the network, found by their liveliness tokens."""

import threading
import uuid

from neurove_protocol.errors import NeuroVEError
from neurove_protocol.keys import Keys
from neurove_service import logs
from neurove_service.transport import Transport

log = logs.get(__name__)

_ASK_S = 1.0
_RETRY_S = 0.5
_LEAVE_S = 12.0  # a node that lost its power is known to have left after Zenoh's lease of 10 s


class NodeNameTaken(NeuroVEError):
    """Another node of this name is on the network."""

    code = "node_name_taken"

    def __init__(self, node: str) -> None:
        super().__init__(
            f"node={node}: another node of this name is on the network; give each node its own name, "
            "or set allow_same_name",
            field="node",
            value=node,
        )


class Namesakes:
    """Declares this node's instance, and knows the others.

    Args:
        transport: an open session.
        keys: of the deployment.
        node: the name.
    """

    def __init__(self, transport: Transport, keys: Keys, node: str) -> None:
        self._transport, self._keys, self._node = transport, keys, node
        self._own = keys.instance(node, uuid.uuid4().hex)
        self._others: set[str] = set()
        self._lock = threading.Lock()

    @property
    def count(self) -> int:
        """Number of other nodes of this name."""
        return len(self._others)

    def join(self, stop: threading.Event, *, allowed: bool, leave_s: float = _LEAVE_S) -> None:
        """Declare this node's instance.

        Args:
            stop: ends the wait for another node to leave.
            allowed: whether another node may have this name.
            leave_s: how long to wait for another node to leave [s]; it may be this node before its restart.

        Raises:
            NodeNameTaken: another node has this name and stays.
        """
        pattern, waited_s = self._keys.instance(self._node), 0.0
        while not allowed and not stop.is_set() and self._transport.tokens(pattern, _ASK_S):
            if waited_s >= leave_s:
                raise NodeNameTaken(self._node)
            if not waited_s:
                log.warning("another node of this name is on the network; waiting for it to leave", node=self._node)
            stop.wait(_RETRY_S)
            waited_s += _RETRY_S
        self._transport.token(self._own)
        self._transport.watch_tokens(pattern, self._on_token)

    def _on_token(self, key: str, present: bool) -> None:  # as transport calls it
        if key == self._own:
            return
        with self._lock:
            (self._others.add if present else self._others.discard)(key)
        text = "another node of this name has come" if present else "another node of this name has left"
        log.warning(text, node=self._node, others=self.count)
