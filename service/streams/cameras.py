"""Cameras: what becomes of the CameraInfo messages of one stream: used, prepared for, or refused and counted."""

from collections.abc import Callable

from neurove_core.config import CanonicalConfig
from neurove_core.geometry.tables import TABLES
from neurove_protocol import CameraInfo
from neurove_protocol.camera import MAX_CAMERA_BYTES
from neurove_protocol.errors import InvalidField, NeuroVEError
from neurove_service import logs
from neurove_service.guard import Guard
from neurove_service.streams.preparing import QUICK_PX, Preparing
from neurove_service.streams.stream import Stream

log = logs.get(__name__)


class Cameras:
    """Gives a stream its CameraInfo; the worker of the stream uses it, only `lose` and `stop` may be called elsewhere.

    Args:
        stream: only the worker changes it.
        wake: called when `use_prepared` has something to do.
        guard: counts internal errors.
        quick_px: the table of a sensor with at most so many pixels is built at once.
    """

    def __init__(self, stream: Stream, wake: Callable[[], None], guard: Guard, quick_px: int = QUICK_PX) -> None:
        self._stream, self._quick_px = stream, quick_px
        self._lost = self._told = 0
        self._preparing = Preparing(self._table, wake, guard)

    def lose(self) -> None:
        """Note a message that was not queued; it is counted in the next turn of the worker."""
        self._lost += 1

    def stop(self) -> None:
        """Prepare no further camera."""
        self._preparing.stop()

    def receive(self, get: Callable[[], CameraInfo | None]) -> None:
        """Use a CameraInfo from the next packet on, or as soon as the look-up table of a large sensor is built."""
        try:
            camera, name = get(), self._stream.name
            if camera is not None and camera.stream != name:
                raise InvalidField("camera info", "stream", camera.stream, f"received on the key of stream {name!r}")
        except NeuroVEError as error:
            self._refuse(error.message)
            return
        if camera is None:
            return
        if camera.width * camera.height <= self._quick_px or TABLES.ready(self._canonical, camera.sensor, camera):
            self._stream.set_camera(camera)
        else:
            self._preparing.start(camera)

    def turn(self) -> None:
        """Use what was prepared, and count what was lost."""
        while self._told < self._lost:
            self._told += 1
            self._refuse(f"camera info: at most {MAX_CAMERA_BYTES} bytes, and few at once")
        prepared = self._preparing.take()
        if prepared is not None and prepared.error is not None:
            self._refuse(prepared.error.message)
        elif prepared is not None:
            self._stream.set_camera(prepared.camera)

    @property
    def _canonical(self) -> CanonicalConfig:
        return self._stream.models.roles(self._stream.name).serving.estimator.config.canonical

    def _table(self, camera: CameraInfo) -> object:
        return TABLES.of(self._canonical, camera.sensor, camera)

    def _refuse(self, why: str) -> None:
        self._stream.refused_camera(why)
        total = self._stream.counters.refused_cameras
        if total & (total - 1) == 0:
            log.warning("camera info refused", stream=self._stream.name, why=why, total=total)
