"""Zenoh key expressions: this module alone builds and parses keys.

The `@node` chunk is verbatim in Zenoh: a wildcard never matches it, so a stream cannot shadow a node.
"""

import re
from dataclasses import dataclass

from neurove_protocol.errors import InvalidField

DEFAULT_PREFIX = "neurove/v1"
NAME_RULE = "1 to 64 characters of A-Z a-z 0-9 _ . - and no dot or dash first"
_NAME = re.compile(r"[A-Za-z0-9_][A-Za-z0-9_.-]{0,63}")
_DIGEST = re.compile(r"[0-9a-f]{64}")
_PREFIX = re.compile(r"[A-Za-z0-9_.-]{1,64}(/[A-Za-z0-9_.-]{1,64}){0,7}")


def is_name(name: str) -> bool:
    """Whether the name is valid as one chunk of a key."""
    return _NAME.fullmatch(name) is not None


def check_name(what: str, name: str) -> str:
    """The name, if it is valid as one chunk of a key.

    >>> check_name("stream", "cam0")
    'cam0'
    """
    if not is_name(name):
        raise InvalidField("key", what, name, NAME_RULE)
    return name


@dataclass(frozen=True, slots=True)
class Keys:
    """All keys of one deployment, under its prefix.

    >>> Keys().events("cam0")
    'neurove/v1/cam0/events'
    >>> Keys("site1/neurove").health("*")
    'site1/neurove/@node/*/health'
    >>> Keys().stream_of("neurove/v1/cam0/events")
    'cam0'
    """

    prefix: str = DEFAULT_PREFIX

    def __post_init__(self) -> None:
        if not _PREFIX.fullmatch(self.prefix):
            raise InvalidField("key", "prefix", self.prefix, "up to 8 chunks of A-Z a-z 0-9 _ . - joined by /")

    def _of_stream(self, stream: str, leaf: str) -> str:
        return f"{self.prefix}/{stream if stream == '*' else check_name('stream', stream)}/{leaf}"

    def _of_node(self, node: str, leaf: str) -> str:
        return f"{self.prefix}/@node/{node if node == '*' else check_name('node', node)}/{leaf}"

    def events(self, stream: str = "*") -> str:
        """Event packets of a stream; driver to service."""
        return self._of_stream(stream, "events")

    def camera(self, stream: str = "*") -> str:
        """CameraInfo of a stream; put at start and answered on query by the driver."""
        return self._of_stream(stream, "camera")

    def imu(self, stream: str = "*") -> str:
        """IMU packets of a stream; driver to service."""
        return self._of_stream(stream, "imu")

    def velocity(self, stream: str = "*") -> str:
        """Twist estimates of a stream; service to anyone."""
        return self._of_stream(stream, "velocity")

    def status(self, stream: str = "*") -> str:
        """Verdict and counters of a stream; service to anyone."""
        return self._of_stream(stream, "status")

    def health(self, node: str = "*") -> str:
        """Queryable: the health of a node."""
        return self._of_node(node, "health")

    def models(self, node: str = "*") -> str:
        """Queryable: the models of a node."""
        return self._of_node(node, "models")

    def activate(self, node: str = "*") -> str:
        """Queryable: change the model of a node. Under `model/`, so that an access list can restrict it."""
        return self._of_node(node, "model/activate")

    def rollback(self, node: str = "*") -> str:
        """Queryable: activate the previous model again."""
        return self._of_node(node, "model/rollback")

    def push(self, node: str = "*") -> str:
        """Queryable: offer a bundle to a node."""
        return self._of_node(node, "model/push")

    def chunks(self, digest: str) -> str:
        """Queryable of the client that pushes a bundle: pieces of its bytes. Verbatim, so that no stream can shadow it.

        Raises:
            InvalidField: the digest is not 64 digits 0-9 a-f.
        """
        if not _DIGEST.fullmatch(digest):
            raise InvalidField("key", "digest", digest, "64 digits 0-9 a-f")
        return f"{self.prefix}/@push/{digest}"

    def alive(self, node: str = "*") -> str:
        """Liveliness token of a node."""
        return self._of_node(node, "alive")

    def instance(self, node: str = "*", instance: str = "*") -> str:
        """Liveliness token of one process of a node; two of one node are two nodes of one name."""
        return self._of_node(node, f"instance/{instance if instance == '*' else check_name('instance', instance)}")

    def serves(self, node: str = "*", stream: str = "*") -> str:
        """Liveliness token of a node that serves a stream."""
        return self._of_node(node, f"serves/{stream if stream == '*' else check_name('stream', stream)}")

    def shares(self, node: str = "*", capacity: int | str = "*") -> str:
        """Liveliness token of a node that shares streams, with its capacity."""
        return self._of_node(node, f"shares/{capacity if capacity == '*' else check_name('capacity', str(capacity))}")

    def duty(self, node: str = "*") -> str:
        """Queryable: whether a node answers or follows a stream; between nodes that stand by for each other."""
        return self._of_node(node, "duty/role")

    def state(self, node: str = "*") -> str:
        """Queryable: the state of a stream that a node answers; for the node that follows it."""
        return self._of_node(node, "duty/state")

    def take(self, node: str = "*") -> str:
        """Queryable: ask a node that follows a stream to answer it."""
        return self._of_node(node, "duty/take")

    def drain(self, node: str = "*") -> str:
        """Queryable: hand over all streams of a node, before it is stopped."""
        return self._of_node(node, "drain")

    def node_of(self, key: str) -> str:
        """The node that a concrete key below `@node` belongs to.

        Raises:
            InvalidField: the key is not below `@node` of this prefix, or its node is no valid name.
        """
        head = f"{self.prefix}/@node/"
        name, _, leaf = key.removeprefix(head).partition("/")
        if not key.startswith(head) or not leaf:
            raise InvalidField("key", "key", key, f"{head}<node>/<message>")
        return check_name("node", name)

    def shared_of(self, key: str) -> tuple[str, int]:
        """Node and capacity of a key from `shares`.

        >>> Keys().shared_of("neurove/v1/@node/n1/shares/2")
        ('n1', 2)

        Raises:
            InvalidField: it is another key.
        """
        node = self.node_of(key)
        leaf = key.removeprefix(f"{self.prefix}/@node/{node}/shares/")
        if not re.fullmatch("[0-9]{1,4}", leaf):
            raise InvalidField("key", "key", key, f"{self.prefix}/@node/<node>/shares/<capacity>")
        return node, int(leaf)

    def served_of(self, key: str) -> str:
        """The stream of a key from `serves`.

        >>> Keys().served_of("neurove/v1/@node/n1/serves/cam0")
        'cam0'

        Raises:
            InvalidField: it is another key.
        """
        leaf = key.removeprefix(f"{self.prefix}/@node/{self.node_of(key)}/")
        if not leaf.startswith("serves/"):
            raise InvalidField("key", "key", key, f"{self.prefix}/@node/<node>/serves/<stream>")
        return check_name("stream", leaf.removeprefix("serves/"))

    def stream_of(self, key: str) -> str:
        """The stream that a concrete stream key (events, camera, imu, velocity, status) belongs to.

        Raises:
            InvalidField: the key is not below this prefix, or its stream is no valid name.
        """
        head, _, leaf = key.removeprefix(self.prefix + "/").partition("/")
        if not key.startswith(self.prefix + "/") or "/" in leaf or not leaf:
            raise InvalidField("key", "key", key, f"{self.prefix}/<stream>/<message>")
        return check_name("stream", head)
