"""StreamOutput: what a camera driver publishes for one stream: event packets, inertial samples and the CameraInfo."""

import threading
import time

from neurove_protocol import CameraInfo, EventPacket, Events, ImuPacket, Sensor
from neurove_protocol.camera import SCHEMA as CAMERA_SCHEMA
from neurove_protocol.events import SCHEMA as EVENTS_SCHEMA
from neurove_protocol.events import encode_packet
from neurove_protocol.imu import SCHEMA as IMU_SCHEMA
from neurove_protocol.imu import Imu, encode_imu
from neurove_protocol.keys import Keys
from neurove_service.transport import Transport

POLL_S = 0.02


class StreamOutput:
    """Publishes one stream; see the wire contract in protocol/README.md.

    Args:
        stream: name of the stream.
        sensor: the pixel array.
        transport: an open session.
        keys: keys of the deployment.
        lens: of the camera, which is published now and on request; None if it is unknown.
        has_imu: whether inertial samples are published.
    """

    def __init__(
        self,
        stream: str,
        sensor: Sensor,
        transport: Transport,
        keys: Keys,
        lens: CameraInfo | None,
        *,
        has_imu: bool,
    ) -> None:
        self.stream, self._sensor = stream, sensor
        self._publisher = transport.publisher(keys.events(stream), EVENTS_SCHEMA)
        self._imu_publisher = transport.publisher(keys.imu(stream), IMU_SCHEMA) if has_imu else None
        self._imu_seq = 0
        if lens is not None:
            payload = CameraInfo(**(lens.model_dump() | {"stream": stream})).encode()
            transport.answer(keys.camera(stream), lambda _: payload)
            transport.put(keys.camera(stream), payload, CAMERA_SCHEMA)

    @property
    def has_imu(self) -> bool:
        """Whether inertial samples are published."""
        return self._imu_publisher is not None

    @property
    def is_heard(self) -> bool:
        """Whether a service subscribes to the stream."""
        return self._publisher.matching

    def wait_for_listener(self, timeout_s: float, stop: threading.Event) -> bool:
        """Wait until a service subscribes to the stream.

        Returns:
            whether one did before the timeout and the stop event.
        """
        deadline = time.monotonic() + timeout_s
        while not self.is_heard:
            if time.monotonic() >= deadline or stop.wait(POLL_S):
                return False
        return True

    def send(self, seq: int, t0_us: int, events: Events) -> None:
        """Publish an event packet; without events it is a clock tick."""
        packet = EventPacket(self.stream, seq, self._sensor, t0_us, events)
        self._publisher.put(encode_packet(packet), sent_us=time.monotonic_ns() // 1000)

    def send_samples(self, samples: Imu) -> int:
        """Publish inertial samples, if there are any and the stream has them; return their number."""
        if self._imu_publisher is None or not samples.n:
            return 0
        self._imu_publisher.put(encode_imu(ImuPacket(self.stream, self._imu_seq, samples)))
        self._imu_seq += 1
        return samples.n
