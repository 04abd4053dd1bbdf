"""Bridge: the events of ROS cameras as streams of the service, and its estimates as velocities of ROS.

One process for all cameras, apart from the service's process. Each camera has one thread, one bounded queue and one
state; the threads of the link and of the transport only append to that queue. The thread of the caller publishes
/diagnostics.
"""

import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, Final, NamedTuple

from neurove_core.io.formats.ros import types
from neurove_protocol import TwistEstimate
from neurove_protocol.camera import SCHEMA as CAMERA_SCHEMA
from neurove_protocol.control import StreamStatus
from neurove_protocol.errors import NeuroVEError
from neurove_protocol.events import SCHEMA as EVENTS_SCHEMA
from neurove_protocol.imu import SCHEMA as IMU_SCHEMA
from neurove_protocol.keys import Keys
from neurove_service.guard import Guard
from neurove_service.ros2.diagnostics import Reporter, Seen
from neurove_service.ros2.feed import Feed, Packet
from neurove_service.ros2.graph import DRIVER_QOS, LATCHED_QOS, VELOCITY_QOS, Topic
from neurove_service.ros2.link import Link, OnMessage, Received
from neurove_service.ros2.velocity import Velocity
from neurove_service.transport import OnSample, Transport

QUEUE_BYTES: Final = 32 << 20
"""Most bytes of messages that wait for the thread of a camera; then the oldest is dropped and counted."""

DIAGNOSTICS_TOPIC: Final = "/diagnostics"
_PERIOD_S: Final = 1.0  # of the diagnostics


class CameraTopics(NamedTuple):
    """The topics of one camera; None: not subscribed."""

    stream: str
    events: str
    camera_info: str | None
    imu: str | None

    @classmethod
    def of_driver(cls, stream: str, events: str) -> "CameraTopics":
        """The topics of a driver: camera_info and imu have the namespace of the events."""
        namespace = events.rpartition("/")[0]
        return cls(stream, events, f"{namespace}/camera_info", f"{namespace}/imu")


@dataclass
class _Queue:
    """What waits for the thread of one camera: messages of ROS, and messages of the service with their kind."""

    cap: int = QUEUE_BYTES
    waiting: deque[Received | tuple[str, bytes]] = field(default_factory=deque)
    size: int = 0
    dropped: int = 0
    closed: bool = False
    changed: threading.Condition = field(default_factory=threading.Condition)

    def put(self, item: Received | tuple[str, bytes]) -> None:
        with self.changed:
            self.waiting.append(item)
            self.size += _size(item)
            while self.size > self.cap and len(self.waiting) > 1:
                self.size -= _size(self.waiting.popleft())
                self.dropped += 1
            self.changed.notify()

    def take(self) -> list[Received | tuple[str, bytes]]:
        """Everything that waits, as soon as something does; empty when closed."""
        with self.changed:
            self.changed.wait_for(lambda: self.waiting or self.closed)
            taken, self.size = list(self.waiting), 0
            self.waiting.clear()
            return taken

    def close(self) -> None:
        with self.changed:
            self.closed = True
            self.changed.notify()


def _size(item: Received | tuple[str, bytes]) -> int:
    return len(item.payload if isinstance(item, Received) else item[1])


class Camera:
    """One camera of the bridge: its topics, its stream and its thread.

    Args:
        topics: of the camera.
        feed: its messages to the service.
        velocity: its messages to ROS.
        namespace: of our topics.
        link: to ROS.
        transport: to the service.
        keys: of the deployment.
        guard: counts internal errors.
    """

    def __init__(
        self,
        topics: CameraTopics,
        feed: Feed,
        velocity: Velocity,
        namespace: str,
        link: Link,
        transport: Transport,
        keys: Keys,
        guard: Guard,
    ) -> None:
        self._topics, self._feed, self._velocity, self._guard = topics, feed, velocity, guard
        self._transport, self._camera_key = transport, keys.camera(topics.stream)
        self._lens: bytes | None = None
        self._status: StreamStatus | None = None
        self._status_ns = 0
        self._queue = _Queue()
        stream = topics.stream
        self._to_service = {
            "events": transport.publisher(keys.events(stream), EVENTS_SCHEMA),
            "imu": transport.publisher(keys.imu(stream), IMU_SCHEMA),
        }
        self._send = link.publisher(Topic(f"{namespace}/{stream}/velocity", types.TWIST), VELOCITY_QOS)
        transport.subscribe(keys.velocity(stream), self._from_service("velocity"))
        transport.subscribe(keys.status(stream), self._from_service("status"))
        if topics.camera_info is not None:
            link.subscribe(Topic(topics.camera_info, types.CAMERA), LATCHED_QOS, self._expecting(types.CAMERA))
        if topics.imu is not None:
            link.subscribe(Topic(topics.imu, types.IMU), DRIVER_QOS, self._expecting(types.IMU))
        link.subscribe(Topic(topics.events, types.EVENTS), DRIVER_QOS, self._expecting(types.EVENTS))
        self._thread = threading.Thread(target=self._work, name=f"ros {stream}", daemon=True)
        self._thread.start()

    def _from_service(self, kind: str) -> OnSample:
        return lambda _, payload, __: self._queue.put((kind, payload))

    def _expecting(self, type_: str) -> OnMessage:
        """Queue the messages of a topic; those of another type are only counted."""

        def receive(received: Received) -> None:
            other = f"{received.type[:80]} instead of {type_}"
            self._queue.put(received if received.type == type_ else Received(other, b"", *received[2:]))

        return receive

    def _work(self) -> None:
        while items := self._queue.take():
            self._feed.counts.dropped_messages = self._queue.dropped
            for item in items:
                with self._guard.at("ros camera", stream=self._topics.stream):
                    self._handle(item)

    def _handle(self, item: Received | tuple[str, bytes]) -> None:
        if isinstance(item, Received):
            for packet in self._feed.accept(item):
                self._to_the_service(packet, item.received_ns)
            return
        kind, payload = item
        try:
            if kind == "velocity":
                self._publish(TwistEstimate.decode(payload))
            else:
                self._hear_status(StreamStatus.decode(payload))
        except NeuroVEError as error:
            self._feed.refusal = f"a message of the service: {error}"

    def _to_the_service(self, packet: Packet, received_ns: int) -> None:
        if packet.kind != "camera":
            # the time of receiving: a bag that is played slowly is not late
            self._to_service[packet.kind].put(packet.payload, sent_us=received_ns // 1000)
            return
        first, self._lens = self._lens is None, packet.payload
        if first:
            self._transport.answer(self._camera_key, lambda _: self._lens or b"")
        self._transport.put(self._camera_key, packet.payload, CAMERA_SCHEMA)

    def _hear_status(self, status: StreamStatus) -> None:
        if status.standby is None or status.standby.role == "answers":  # not of a node that follows
            self._status, self._status_ns = status, time.monotonic_ns()

    def _publish(self, estimate: TwistEstimate) -> None:
        if not self._velocity.takes(estimate, time.monotonic_ns()):
            return
        stamp_ns = self._feed.clock.ros_ns(estimate.end_us)
        message = self._velocity.message(estimate, stamp_ns, self._feed.frame_id)
        if message is not None:
            self._send(types.encode(message))

    @property
    def seen(self) -> Seen:
        """For the diagnostics."""
        topics = self._topics
        return Seen(topics.stream, topics.events, self._feed, self._velocity, self._status, self._status_ns)

    def close(self) -> None:
        """End the thread."""
        self._queue.close()
        self._thread.join(timeout=5)


class Bridge:
    """All cameras of the process and /diagnostics.

    Args:
        link: to ROS; the bridge closes it.
        transport: to the service; the caller closes it.
        keys: of the deployment.
        cameras: topics, feed and velocity of each camera.
        namespace: of our topics.
        hardware_id: of the diagnostics.
        guard: counts internal errors.
    """

    def __init__(
        self,
        link: Link,
        transport: Transport,
        keys: Keys,
        cameras: list[tuple[CameraTopics, Feed, Velocity]],
        namespace: str,
        hardware_id: str,
        guard: Guard,
    ) -> None:
        self._link, self._guard, self._reporter = link, guard, Reporter(hardware_id)
        self._diagnose = link.publisher(Topic(DIAGNOSTICS_TOPIC, types.DIAGNOSTICS), VELOCITY_QOS)
        self._cameras = [Camera(*one, namespace, link, transport, keys, guard) for one in cameras]

    def run(self, stop: threading.Event, on_ready: Callable[[], object] = lambda: None) -> dict[str, Any]:
        """Bridge until the stop event.

        Args:
            stop: ends the bridge.
            on_ready: called once everything is declared.

        Returns:
            the counts of each stream.
        """
        on_ready()
        try:
            while not stop.wait(_PERIOD_S):
                with self._guard.at("ros diagnostics"):
                    self._report()
        finally:
            for camera in self._cameras:
                camera.close()
            self._link.close()
        return {camera.seen.stream: _counts(camera.seen) for camera in self._cameras}

    def _report(self) -> None:
        seen = [camera.seen for camera in self._cameras]
        message = self._reporter.message(seen, self._link.fault, time.monotonic_ns(), time.time_ns())
        self._diagnose(types.encode(message))


def _counts(seen: Seen) -> dict[str, Any]:
    sent = {f"velocity_{name}": getattr(seen.velocity, name) for name in ("sent", "withheld", "unstamped")}
    return seen.feed.as_json() | sent | {"doubtful": dict(seen.velocity.doubted)}
