"""Link: the way to the topics of ROS 2, whatever carries them."""

from collections.abc import Callable
from typing import NamedTuple, Protocol

from neurove_service.ros2.graph import Qos, Topic


class Received(NamedTuple):
    """One message of a topic."""

    type: str  # such as sensor_msgs/msg/Imu
    payload: bytes  # CDR
    received_ns: int  # monotonic clock
    unix_ns: int  # the same moment as unix time
    publisher: bytes | None = None  # its identity, where the link knows it


OnMessage = Callable[[Received], None]
"""Runs on a thread of the link: it must only append and return."""

Send = Callable[[bytes], None]
"""Publishes a message in CDR."""


class Link(Protocol):
    """Publishes and subscribes topics in CDR."""

    def subscribe(self, topic: Topic, qos: Qos, on_message: OnMessage) -> None:
        """Receive every message of a topic, also those of another type."""

    def publisher(self, topic: Topic, qos: Qos) -> Send:
        """Declare a publisher."""

    @property
    def fault(self) -> str:
        """Why the link does not work now; empty if it does."""

    def close(self) -> None:
        """Leave the network."""
