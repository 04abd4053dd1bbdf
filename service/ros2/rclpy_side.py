"""The half of the rclpy link that runs in the Python of ROS: `python3 rclpy_side.py`; CDR through pipes.

It needs rclpy and nothing of NeuroVE, and runs with Python 3.10 of Humble too. Standard input and output carry frames:
one byte for the kind, two for the channel, four for the length (little endian), then the content.

| kind | direction | content |
| --- | --- | --- |
| N | in | JSON: `name`, `namespace`, `domain` of the node; the first frame |
| P, S | in | JSON: `topic`, `type`, `reliable`, `latched`, `depth` of a publisher or subscriber on this channel |
| D | in, out | a message in CDR, to publish or received |
| R | out | the node, or the channel, is ready |
| E | out | text: why it is not |

The end of the input ends the process.
"""

import contextlib
import importlib
import json
import os
import struct
import sys
import threading
from collections.abc import Callable
from typing import Any

HEAD = struct.Struct("<cHI")


class Pipes:
    """The frames of both directions."""

    def __init__(self) -> None:
        self._in = os.fdopen(os.dup(0), "rb")
        self._out = os.fdopen(os.dup(1), "wb")
        os.dup2(2, 1)  # what ROS prints goes to standard error
        self._lock = threading.Lock()

    def send(self, kind: bytes, channel: int, content: bytes = b"") -> None:
        """Write a frame."""
        with self._lock:
            self._out.write(HEAD.pack(kind, channel, len(content)))
            self._out.write(content)
            self._out.flush()

    def receive(self) -> tuple[bytes, int, bytes] | None:
        """The next frame; None at the end of the input."""
        head = self._in.read(HEAD.size)
        if len(head) < HEAD.size:
            return None
        kind, channel, length = HEAD.unpack(head)
        return kind, channel, self._in.read(length)


def type_of(name: str) -> Any:
    """The class of a type such as sensor_msgs/msg/Imu."""
    package, kind, message = name.split("/")
    return getattr(importlib.import_module(package + "." + kind), message)


def declare(
    node: Any, pipes: Pipes, publishers: dict[int, Any], kind: bytes, channel: int, about: dict[str, Any]
) -> None:
    """Declare a publisher or a subscriber."""
    from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy

    def qos(latched: bool) -> Any:
        return QoSProfile(
            depth=about["depth"],
            reliability=ReliabilityPolicy.RELIABLE if about["reliable"] else ReliabilityPolicy.BEST_EFFORT,
            durability=DurabilityPolicy.TRANSIENT_LOCAL if latched else DurabilityPolicy.VOLATILE,
        )

    type_ = type_of(about["type"])
    if kind == b"P":
        publishers[channel] = node.create_publisher(type_, about["topic"], qos(about["latched"]))
        return
    # a subscriber of latched messages gets nothing from a publisher whose messages are not latched: both are needed
    for latched in (False, True) if about["latched"] else (False,):
        node.create_subscription(
            type_, about["topic"], lambda data: pipes.send(b"D", channel, data), qos(latched), raw=True
        )


def serve(node: Any, pipes: Pipes, stop: Callable[[], Any]) -> None:
    """Obey the frames until the input ends."""
    publishers: dict[int, Any] = {}
    while True:
        frame = pipes.receive()
        if frame is None:
            break
        kind, channel, content = frame
        try:
            if kind == b"D":
                publishers[channel].publish(content)
            else:
                declare(node, pipes, publishers, kind, channel, json.loads(content))
                pipes.send(b"R", channel)
        except Exception as error:  # noqa: BLE001  # of any message package and middleware; the other side reports it
            pipes.send(b"E", channel, repr(error).encode())
    stop()


def main() -> None:
    """Make the node and carry its messages."""
    pipes = Pipes()
    frame = pipes.receive()
    if frame is None:
        return
    about = json.loads(frame[2])
    try:
        import rclpy
        from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor

        rclpy.init(args=[], domain_id=about["domain"])
        node = rclpy.create_node(about["name"], namespace=about["namespace"])
    except Exception as error:  # noqa: BLE001  # as above
        pipes.send(b"E", 0, repr(error).encode())
        return
    pipes.send(b"R", 0)
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    threading.Thread(target=serve, args=(node, pipes, lambda: rclpy.try_shutdown()), daemon=True).start()
    with contextlib.suppress(ExternalShutdownException, KeyboardInterrupt, BrokenPipeError):
        executor.spin()


if __name__ == "__main__":
    main()
    sys.stderr.flush()
    os._exit(0)  # the threads of the middleware may not end
