"""Viewer: streams as topics of Foxglove: Odometry with covariance, event image, camera calibration, log.

A program that speaks its protocol (subprotocol `foxglove.sdk.v1`) connects to the websocket and subscribes. Events of a
camera are received only while a client watches its image.
"""

import threading
import time
from collections.abc import Callable
from typing import Final

import foxglove
import numpy as np
from foxglove.channels import CameraCalibrationChannel, LogChannel, OdometryChannel, RawImageChannel
from foxglove.messages import (
    CameraCalibration,
    KeyValuePair,
    Log,
    LogLevel,
    Odometry,
    RawImage,
    Timestamp,
    Vector3,
)
from numpy.typing import NDArray

from neurove_protocol import CameraInfo, Events, Sensor, TwistEstimate
from neurove_protocol.control import StreamStatus
from neurove_protocol.errors import NeuroVEError
from neurove_protocol.events import decode_packet
from neurove_service import logs
from neurove_service.clients import ask
from neurove_service.config import ClientConfig
from neurove_service.transport import Transport

log = logs.get(__name__)

MAX_STREAMS: Final = 64
"""Streams with topics; further ones are not shown."""

IMAGE_S: Final = 0.1
"""Events of this time make one image [s]."""

_BACKGROUND, _ON, _OFF = 255, (0, 90, 181), (220, 50, 32)  # colours that colour-blind people tell apart
_BACKLOG: Final = 64  # messages for each client: a slow one loses the oldest
_CALIBRATION_S: Final = 2.0  # repeated, because a client that subscribes later receives no older message
_CAMERA_ANSWER_S: Final = 0.5
_LEVELS: Final = {
    "ok": LogLevel.Info,
    "idle": LogLevel.Info,
    "uncertain": LogLevel.Warning,
    "lossy": LogLevel.Warning,
    "unstable": LogLevel.Error,
    "stalled": LogLevel.Error,
}


class Viewer:
    """Publishes every stream of a deployment to the clients of one websocket server.

    Args:
        transport: an open session.
        config: the deployment's prefix.
        host: address to listen on.
        port: 0 for a free one.

    Raises:
        RuntimeError, OSError: the address cannot be used.
    """

    def __init__(self, transport: Transport, config: ClientConfig, host: str, port: int) -> None:
        self._transport, self._config = transport, config
        self._context = foxglove.Context()
        self._streams: dict[str, _Topics] = {}
        self._verdicts: dict[tuple[str, str], str] = {}
        self._models: dict[str | None, str] = {}
        self._lock = threading.Lock()
        self._log = LogChannel("/log", context=self._context)
        self._server = foxglove.start_server(
            name="NeuroVE", host=host, port=port, context=self._context, message_backlog_size=_BACKLOG
        )
        self.port = self._server.port
        ask.listen(transport, config, self.on_estimate, self.on_status)
        transport.subscribe(config.keys.camera(), self._on_camera)

    def run(self, stop: threading.Event) -> None:
        """Keep subscriptions and calibrations up to date until the event is set."""
        next_s = 0.0
        while not stop.wait(IMAGE_S):
            with self._lock:
                streams = list(self._streams.values())
            due = time.monotonic() >= next_s
            if due:
                next_s = time.monotonic() + _CALIBRATION_S
            for one in streams:
                one.turn(self._transport, self._config, calibration=due)

    def close(self) -> None:
        """End the server."""
        self._server.stop()

    def on_estimate(self, estimate: TwistEstimate) -> None:
        """Publish an estimate."""
        if self._models.get(estimate.node) != estimate.digest:
            if self._models.get(estimate.node) is not None:
                self._say(LogLevel.Info, f"model {estimate.model} answers now", estimate.node or "")
            if len(self._models) < MAX_STREAMS:
                self._models[estimate.node] = estimate.digest
        topics = self._topics(estimate.stream)
        if topics is not None:
            topics.odometry.log(odometry(estimate), log_time=_stamp_ns(estimate))

    def on_status(self, status: StreamStatus) -> None:
        """Log a change of a verdict."""
        key = status.node, status.stream
        if self._verdicts.get(key) != status.verdict and (key in self._verdicts or len(self._verdicts) < MAX_STREAMS):
            self._verdicts[key] = status.verdict
            level = _LEVELS.get(status.verdict, LogLevel.Warning)
            self._say(level, f"{status.stream} is {status.verdict}: {status.why}", status.node)

    def _say(self, level: LogLevel, message: str, node: str) -> None:
        self._log.log(Log(timestamp=_timestamp(time.time_ns()), level=level, message=message, name=node))

    def _on_camera(self, _key: str, payload: bytes, _received_ns: int) -> None:
        try:
            camera = CameraInfo.decode(payload)
        except NeuroVEError as error:
            log.warning("message refused", why=error.message)
            return
        topics = self._topics(camera.stream)
        if topics is not None:
            topics.camera = camera

    def _topics(self, stream: str) -> "_Topics | None":
        with self._lock:
            if stream not in self._streams and len(self._streams) < MAX_STREAMS:
                self._streams[stream] = _Topics(stream, self._context)
            return self._streams.get(stream)


class _Topics:
    """The topics of one stream."""

    def __init__(self, stream: str, context: foxglove.Context) -> None:
        self._stream, self._frame = stream, f"{stream}/camera_optical"
        self.odometry = OdometryChannel(f"/{stream}/odometry", context=context)
        self._calibration = CameraCalibrationChannel(f"/{stream}/calibration", context=context)
        self._image = RawImageChannel(f"/{stream}/events", context=context)
        self.camera: CameraInfo | None = None
        self._asked = False
        self._unsubscribe: Callable[[], None] | None = None
        self._pending: list[Events] = []
        self._sensor: Sensor | None = None
        self._lock = threading.Lock()

    def turn(self, transport: Transport, config: ClientConfig, *, calibration: bool) -> None:
        """Publish what is due; receive events while a client watches the image."""
        self._follow(transport, config)
        with self._lock:
            events, self._pending = self._pending, []
            sensor = self._sensor
        now_ns = time.time_ns()
        if sensor is not None and self._image.has_sinks():
            self._image.log(raw_image(picture(events, sensor), self._frame, now_ns))
        if not (calibration and self._calibration.has_sinks()):
            return
        if self.camera is None and not self._asked:
            self._asked = True
            self.camera = _ask_camera(transport, config, self._stream)
        if self.camera is not None:
            self._calibration.log(camera_calibration(self.camera, self._frame, now_ns))

    def _follow(self, transport: Transport, config: ClientConfig) -> None:
        if self._image.has_sinks():
            if self._unsubscribe is None:
                self._unsubscribe = transport.subscribe(config.keys.events(self._stream), self._on_packet)
        elif self._unsubscribe is not None:
            self._unsubscribe()
            self._unsubscribe = None

    def _on_packet(self, _key: str, payload: bytes, _received_ns: int) -> None:
        try:
            packet = decode_packet(payload)
        except NeuroVEError:  # the node counts it
            return
        with self._lock:
            if packet.sensor != self._sensor:
                self._sensor, self._pending = packet.sensor, []
            self._pending.append(packet.events)


def _ask_camera(transport: Transport, config: ClientConfig, stream: str) -> CameraInfo | None:
    try:
        answers = transport.ask(config.keys.camera(stream), b"", _CAMERA_ANSWER_S)
        return CameraInfo.decode(answers[0].payload) if answers else None
    except NeuroVEError as error:
        log.warning("no camera info", stream=stream, why=error.message)
        return None


def odometry(estimate: TwistEstimate) -> Odometry:
    """The newest twist of an estimate with its covariance; it has no pose.

    Velocities are those of the camera in its optical frame [m/s, rad/s]. Layout and axes of the covariance are those of
    the estimate. It is zero, as the schema asks, if the model has no calibrated uncertainty. Flags, model and number of
    events are in the metadata.
    """
    twist = estimate.twist
    frame = f"{estimate.stream}/{estimate.frame_id}"
    about = {
        "flags": " ".join(estimate.flags),
        "model": estimate.model,
        "source": estimate.source,
        "events": str(estimate.events),
        "covariance": "calibrated" if estimate.covariance is not None else "unknown",
    }
    return Odometry(
        timestamp=_timestamp(_stamp_ns(estimate)),
        frame_id=frame,
        body_frame_id=frame,
        linear_velocity=Vector3(x=twist.vx, y=twist.vy, z=twist.vz),
        angular_velocity=Vector3(x=twist.wx, y=twist.wy, z=twist.wz),
        pose_covariance=[0.0] * 36,
        velocity_covariance=list(estimate.covariance) if estimate.covariance is not None else [0.0] * 36,
        metadata=[KeyValuePair(key=key, value=value) for key, value in about.items()],
    )


def camera_calibration(camera: CameraInfo, frame: str, now_ns: int) -> CameraCalibration:
    """The lens as Foxglove's calibration: plumb_bob for a pinhole, kannala_brandt for an equidistant lens."""
    terms = 5 if camera.lens == "pinhole" else 4
    return CameraCalibration(
        timestamp=_timestamp(now_ns),
        frame_id=frame,
        width=camera.width,
        height=camera.height,
        distortion_model="plumb_bob" if camera.lens == "pinhole" else "kannala_brandt",
        D=[*camera.distortion, *[0.0] * (terms - len(camera.distortion))],
        K=[camera.fx, 0.0, camera.cx, 0.0, camera.fy, camera.cy, 0.0, 0.0, 1.0],
        R=[1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0],
        P=[camera.fx, 0.0, camera.cx, 0.0, 0.0, camera.fy, camera.cy, 0.0, 0.0, 0.0, 1.0, 0.0],
    )


def picture(chunks: list[Events], sensor: Sensor) -> NDArray[np.uint8]:
    """Events as an image (height, width, 3) of RGB values: ON blue, OFF red, the newest event of a pixel counts."""
    image = np.full((sensor.height, sensor.width, 3), _BACKGROUND, np.uint8)
    colours = np.array([_OFF, _ON], np.uint8)
    for events in chunks:
        image[events.y, events.x] = colours[events.p]
    return image


def raw_image(image: NDArray[np.uint8], frame: str, now_ns: int) -> RawImage:
    """An image (height, width, 3) of RGB values as a message."""
    height, width, _ = image.shape
    return RawImage(
        timestamp=_timestamp(now_ns),
        frame_id=frame,
        width=width,
        height=height,
        encoding="rgb8",
        step=3 * width,
        data=image.tobytes(),
    )


def _stamp_ns(estimate: TwistEstimate) -> int:
    """End of the window on the node's wall clock, or now without it [ns since 1970-01-01 UTC]."""
    return max(0, estimate.host.end_ns) if estimate.host is not None else time.time_ns()


def _timestamp(at_ns: int) -> Timestamp:
    return Timestamp(sec=at_ns // 1_000_000_000, nsec=at_ns % 1_000_000_000)
