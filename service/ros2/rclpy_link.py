"""ROS 2 through rclpy, with any middleware: where ROS is installed. A process of ROS's own Python carries the messages.

rclpy is tied to one version of Python and, from PyPI, executes Python again at its start; so it is not imported here.
"""

import contextlib
import json
import queue
import shutil
import struct
import subprocess
import threading
import time
from pathlib import Path
from typing import Any, Final

from neurove_protocol.errors import EXIT_FAILURE, NeuroVEError
from neurove_service.ros2.graph import Qos, Topic
from neurove_service.ros2.link import OnMessage, Received, Send

SIDE: Final = Path(__file__).with_name("rclpy_side.py")
"""The program of the other process."""

_HEAD: Final = struct.Struct("<cHI")
_START_S: Final = 60.0  # of Python, rclpy and the middleware
_MAX_FRAME: Final = 64 << 20


class NoRos(NeuroVEError):
    """The Python of ROS does not start, or it lacks rclpy or a type."""

    code = "no_ros"
    exit_code = EXIT_FAILURE


def check_program(python: str) -> None:
    """Refuse a Python that is not there.

    Raises:
        NoRos: there is no such program.
    """
    if shutil.which(python) is None:
        raise NoRos(f"--ros-python={python!r}: no such program")


class RclpyLink:
    """One node of rclpy.

    Args:
        python: interpreter that can import rclpy.
        domain: ROS_DOMAIN_ID.
        namespace: of the node.
        name: of the node.
        stop: is set when the process of ROS ends by itself.

    Raises:
        NoRos: the node does not start.
    """

    def __init__(self, python: str, domain: int, namespace: str, name: str, stop: threading.Event) -> None:
        check_program(python)
        self._python, self._stop, self._fault, self._closing = python, stop, "", False
        self._answers: queue.Queue[tuple[bytes, bytes]] = queue.Queue()
        self._subscribers: dict[int, tuple[Topic, OnMessage]] = {}
        self._channels, self._lock = 0, threading.Lock()
        self._child = subprocess.Popen(
            [python, str(SIDE)], stdin=subprocess.PIPE, stdout=subprocess.PIPE, start_new_session=True
        )
        self._reader = threading.Thread(target=self._read, name="rclpy", daemon=True)
        self._reader.start()
        try:
            self._declare(b"N", 0, {"name": name, "namespace": namespace, "domain": domain})
        except NoRos:
            self.close()
            raise

    def subscribe(self, topic: Topic, qos: Qos, on_message: OnMessage) -> None:
        """See `Link`. The middleware itself keeps out publishers of another type.

        Raises:
            NoRos: the type is not installed.
        """
        channel = self._channel()
        self._subscribers[channel] = topic, on_message
        self._declare(b"S", channel, _about(topic, qos))

    def publisher(self, topic: Topic, qos: Qos) -> Send:
        """See `Link`.

        Raises:
            NoRos: the type is not installed.
        """
        channel = self._channel()
        self._declare(b"P", channel, _about(topic, qos))
        return lambda payload: self._write(b"D", channel, payload)

    @property
    def fault(self) -> str:
        """See `Link`."""
        return self._fault

    def close(self) -> None:
        """See `Link`."""
        self._closing = True
        with contextlib.suppress(OSError):
            if self._child.stdin:
                self._child.stdin.close()
        try:
            self._child.wait(timeout=5)
        except subprocess.TimeoutExpired:
            self._child.kill()
            self._child.wait()
        self._reader.join(timeout=5)
        if self._child.stdout:
            self._child.stdout.close()

    def _channel(self) -> int:
        self._channels += 1
        return self._channels

    def _declare(self, kind: bytes, channel: int, about: dict[str, Any]) -> None:
        """Send a declaration and wait until it holds."""
        self._write(kind, channel, json.dumps(about).encode())
        try:
            answer, content = self._answers.get(timeout=_START_S)
        except queue.Empty:
            raise NoRos(f"{self._python}: rclpy does not answer within {_START_S:.0f} s") from None
        if answer == b"R":
            return
        text = content.decode(errors="replace")
        what = about.get("type", "rclpy")
        hint = "source the setup.bash of ROS first, or give --ros-python the interpreter that has it"
        raise NoRos(f"{self._python}: {what} cannot be used: {text}; {hint}")

    def _write(self, kind: bytes, channel: int, content: bytes) -> None:
        """Send a frame; nothing happens if the other process has ended, which `fault` reports."""
        out = self._child.stdin
        with self._lock, contextlib.suppress(OSError, ValueError):
            if out is not None:
                out.write(_HEAD.pack(kind, channel, len(content)) + content)
                out.flush()

    def _read(self) -> None:
        """Pass on what the other process sends, until it ends."""
        source = self._child.stdout
        while source is not None and len(head := source.read(_HEAD.size)) == _HEAD.size:
            kind, channel, length = _HEAD.unpack(head)
            if length > _MAX_FRAME:
                break
            content = source.read(length)
            if kind != b"D":
                self._answers.put((kind, content))
                continue
            topic, on_message = self._subscribers[channel]
            on_message(Received(topic.type, content, time.monotonic_ns(), time.time_ns()))
        self._answers.put((b"E", b"its process ended"))
        if not self._closing:
            self._fault = "the process of rclpy ended"
            self._stop.set()


def _about(topic: Topic, qos: Qos) -> dict[str, Any]:
    return {
        "topic": topic.name,
        "type": topic.type,
        "reliable": qos.reliable,
        "latched": qos.latched,
        "depth": qos.depth,
    }
