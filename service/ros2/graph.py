"""Names on the network of ROS 2 over Zenoh (rmw_zenoh_cpp): keys, liveliness tokens, QoS, identities, attachments.

A topic is published on the key

    <domain>/<topic>/<package>::msg::dds_::<Type>_/<type hash>
    0/event_camera/events/event_camera_msgs::msg::dds_::EventPacket_/RIHS01_d6fa1762...29844aa

The node, its publishers (MP) and its subscribers (MS) have liveliness tokens, which other nodes list as the graph:

    @ros2_lv/<domain>/<session>/<node>/<node>/NN/<enclave>/<namespace>/<name>
    @ros2_lv/<domain>/<session>/<node>/<entity>/MP/<enclave>/<namespace>/<name>/<topic>/<type>/<type hash>/<QoS>

In tokens `%` replaces the slashes of namespace and topic, and stands alone for an empty name. Every message has an
attachment of 33 bytes: number from 1 (i64), time [unix ns] (i64), the byte 16, and the identity (gid) of its publisher,
the XXH3-128 hash of its token. Source: rmw_zenoh_cpp 0.1.9, 0.2.10 and 0.6.7 (docs/design.md, liveliness_utils.cpp,
qos.cpp).
"""

import re
import struct
from dataclasses import dataclass, field
from typing import Final, Literal, NamedTuple, Self

from neurove_core.extras import MissingExtra
from neurove_core.io.formats.ros.types import HASHES
from neurove_protocol.errors import InvalidField

Distro = Literal["humble", "jazzy", "kilted", "lyrical"]
DISTROS: Final[tuple[Distro, ...]] = ("humble", "jazzy", "kilted", "lyrical")

NO_HASH: Final = "TypeHashNotSupported"
"""What Humble writes instead of a type hash."""

MAX_DOMAIN: Final = 232

_DEFAULT_DEPTH: Final = 42
_NAME: Final = re.compile(r"[A-Za-z_][A-Za-z0-9_]*")
_TOPIC: Final = re.compile(r"(/[A-Za-z_][A-Za-z0-9_]*)+")
_ATTACHMENT: Final = struct.Struct("<qqB16s")
_GID_BYTES: Final = 16


def check_name(field_: str, name: str) -> str:
    """The name, if ROS accepts it as one part of a topic or as the name of a node."""
    if not _NAME.fullmatch(name) or len(name) > 64:
        raise InvalidField("ros2", field_, name, "1 to 64 letters, digits and _, and no digit first, as ROS requires")
    return name


def check_topic(field_: str, topic: str) -> str:
    """The topic or namespace, if it is a full name of ROS, such as /event_camera/events."""
    if not _TOPIC.fullmatch(topic) or len(topic) > 200:
        raise InvalidField("ros2", field_, topic, "a full name such as /event_camera/events: /, letters, digits and _")
    return topic


def check_domain(domain: int) -> int:
    """The number, if ROS accepts it as ROS_DOMAIN_ID."""
    if not 0 <= domain <= MAX_DOMAIN:
        raise InvalidField("ros2", "--domain", domain, f"0 to {MAX_DOMAIN}")
    return domain


class Qos(NamedTuple):
    """Quality of service of a publisher or a subscriber; durations are infinite."""

    reliable: bool = True
    latched: bool = False  # transient local: the newest messages go to late subscribers
    depth: int = 10  # newest messages kept
    keep_all: bool = False

    def chunk(self) -> str:
        """The last chunk of a token.

        >>> Qos().chunk(), Qos(reliable=False, depth=1000).chunk(), Qos(latched=True, depth=1).chunk()
        ('::,10:,:,:,,', '2::,1000:,:,:,,', ':1:,1:,:,:,,')
        """
        reliability, durability = "" if self.reliable else "2", "1" if self.latched else ""
        history = "2" if self.keep_all else ""
        depth = "" if self.depth == _DEFAULT_DEPTH else str(self.depth)
        return f"{reliability}:{durability}:{history},{depth}:,:,:,,"

    @classmethod
    def of_chunk(cls, chunk: str) -> Self:
        """The QoS of a token.

        Raises:
            InvalidField: the chunk has another form.
        """
        parts = chunk.split(":")
        history, _, depth = parts[2].partition(",") if len(parts) == 6 else ("", "", "?")
        known = (
            len(parts) == 6 and parts[0] in ("", "1", "2") and parts[1] in ("", "1", "2") and history in ("", "1", "2")
        )
        if not known or not (depth == "" or (depth.isdecimal() and len(depth) <= 10)):
            raise InvalidField("token", "QoS", chunk, "reliability:durability:history,depth:...: of rmw_zenoh")
        return cls(parts[0] != "2", parts[1] == "1", int(depth or _DEFAULT_DEPTH), history == "2")


DRIVER_QOS: Final = Qos(reliable=False, depth=1000)
"""Of the events of metavision_driver and libcaer_driver, and of our subscribers to events and inertial samples."""

LATCHED_QOS: Final = Qos(latched=True, depth=1)
"""Of our subscribers to a camera_info, which may be latched or not."""

VELOCITY_QOS: Final = Qos(depth=10)
"""Of what we publish."""


class Topic(NamedTuple):
    """A topic and its type."""

    name: str  # /event_camera/events
    type: str  # event_camera_msgs/msg/EventPacket


def dds_type(type_: str) -> str:
    """The type as rmw_zenoh writes it.

    >>> dds_type("sensor_msgs/msg/Imu")
    'sensor_msgs::msg::dds_::Imu_'
    """
    package, kind, name = type_.split("/")
    return f"{package}::{kind}::dds_::{name}_"


def ros_type(dds: str) -> str:
    """The type as ROS writes it; the text itself if it has another form.

    >>> ros_type("sensor_msgs::msg::dds_::Imu_")
    'sensor_msgs/msg/Imu'
    """
    parts = dds.removesuffix("_").split("::")
    return f"{parts[0]}/{parts[1]}/{parts[3]}" if len(parts) == 4 and parts[2] == "dds_" else dds


def type_hash(type_: str, distro: Distro) -> str:
    """The type hash chunk of a type."""
    return NO_HASH if distro == "humble" else HASHES[type_]


def key(domain: int, topic: Topic, distro: Distro) -> str:
    """The key that a topic is published on."""
    return f"{domain}{topic.name}/{dds_type(topic.type)}/{type_hash(topic.type, distro)}"


def any_key(domain: int, topic: str) -> str:
    """Key expression of a topic, of whatever type and distribution."""
    return f"{domain}{topic}/*/*"


def type_of(key_: str) -> str:
    """The type in the key of a message."""
    return ros_type(key_.rsplit("/", 2)[-2])


def _percent(name: str) -> str:
    return name.replace("/", "%") if name not in ("", "/") else "%"


@dataclass
class Node:
    """One node of ours and its tokens.

    Args:
        domain: ROS_DOMAIN_ID.
        session: identity of the Zenoh session.
        namespace: such as /neurove, or / for none.
        name: of the node.
        distro: whose form of type hashes to use.
    """

    domain: int
    session: str
    namespace: str
    name: str
    distro: Distro
    _entities: int = field(default=0, init=False)

    def _token(self, entity: int, kind: str) -> str:
        head = f"@ros2_lv/{self.domain}/{self.session}/0/{entity}/{kind}"
        return f"{head}/%/{_percent(self.namespace)}/{self.name}"

    @property
    def token(self) -> str:
        """Token of the node."""
        return self._token(0, "NN")

    def entity(self, kind: Literal["MP", "MS"], topic: Topic, qos: Qos) -> str:
        """Token of one further publisher (MP) or subscriber (MS)."""
        self._entities += 1
        hash_ = type_hash(topic.type, self.distro)
        return (
            f"{self._token(self._entities, kind)}/{_percent(topic.name)}/{dds_type(topic.type)}/{hash_}/{qos.chunk()}"
        )


class Entity(NamedTuple):
    """What the token of a publisher or subscriber says."""

    domain: int
    session: str
    kind: str  # MP, MS, SS or SC
    node: str  # with its namespace: /rover/front/camera
    topic: str
    type: str
    hash: str
    qos: Qos

    @classmethod
    def of_token(cls, token: str) -> Self:
        """Parse the token of a publisher or subscriber.

        Raises:
            InvalidField: it has another form.
        """
        chunks = token.split("/")
        if len(chunks) < 13 or chunks[0] != "@ros2_lv" or not chunks[1].isdecimal() or len(chunks[1]) > 3:
            raise InvalidField("token", "chunks", token, "13 chunks @ros2_lv/<domain>/... of rmw_zenoh")
        _, domain, session, _, _, kind, _, namespace, name, topic, type_, hash_, qos, *_ = chunks
        node = f"{namespace.replace('%', '/').rstrip('/')}/{name}"
        names = node, topic.replace("%", "/"), ros_type(type_), hash_
        return cls(int(domain), session, kind, *names, Qos.of_chunk(qos))


def gid_of(token: str) -> bytes:
    """Identity of a publisher: 16 bytes.

    Raises:
        MissingExtra: xxhash is not installed.
    """
    try:
        import xxhash
    except ModuleNotFoundError:
        raise MissingExtra("xxhash", "ros2") from None
    high, low = divmod(xxhash.xxh3_128_intdigest(token.encode()), 1 << 64)
    return struct.pack("<QQ", low, high)


class Attachment(NamedTuple):
    """What goes with each message."""

    seq: int  # number of the message of its publisher, from 1
    sent_ns: int  # unix time
    gid: bytes

    def encode(self) -> bytes:
        """Its 33 bytes."""
        return _ATTACHMENT.pack(self.seq, self.sent_ns, _GID_BYTES, self.gid)

    @classmethod
    def decode(cls, data: bytes) -> Self:
        """Parse an attachment.

        Raises:
            InvalidField: it has another form.
        """
        if len(data) != _ATTACHMENT.size or data[16] != _GID_BYTES:
            raise InvalidField("attachment", "bytes", data[:40].hex(), "33 bytes, with 16 at byte 16")
        seq, sent_ns, _, gid = _ATTACHMENT.unpack(data)
        return cls(seq, sent_ns, gid)
