"""Cameras of dv-processing that neuromorphic-drivers lacks: DAVIS240, DVS128, DVXplorer Mini.

Source: dv::io::InputBase of https://gitlab.com/inivation/dv/dv-processing. It does not report losses.
"""

import threading
import time
from collections.abc import Iterator
from typing import Any, Final

import numpy as np

from neurove_core.io.axes import optical_samples
from neurove_core.io.checked import as_recorded
from neurove_core.io.faults import Faults
from neurove_core.live.found import Found
from neurove_core.live.order import ImuOrder, LiveOrder
from neurove_core.live.source import WAIT_S, Batch, LiveEnded, NoCamera, QuietClock
from neurove_protocol.camera import CameraInfo
from neurove_protocol.events import Events, Sensor
from neurove_protocol.imu import Imu

MODELS: Final = {
    "davis240": ("DAVIS", "DAVIS_GEN2"),
    "dvs128": ("DVS128",),
    "dvxplorer-mini": ("DVXPLORER_M",),
}
"""Model in a `camera://` URL: names of dv::io::camera::CameraModel."""

_NAMES: Final = {
    "DAVIS": "davis240",
    "DAVIS_GEN2": "davis240",
    "DVS128": "dvs128",
    "DVXPLORER_M": "dvxplorer-mini",
}
LIBRARY: Final = "dv-processing"

DELAY_S: Final = 0.05
"""Longest delay of the transmission over USB [s], for the time of a stationary scene."""

_POLL_S: Final = 0.001


class DvCamera:
    """An opened input of dv-processing; see `LiveSource`.

    Samples are in the optical frame, see `axes.OPTICAL`: dv gives deg/s and g, and they become rad/s and m/s2.

    Args:
        reader: a dv::io::InputBase.
        delay_s: longest delay of the transmission [s], see `QuietClock`.
    """

    def __init__(self, reader: Any, delay_s: float = DELAY_S) -> None:
        self._reader: Any = reader
        self.name = str(reader.getCameraName())
        width, height = reader.getEventResolution()
        self.sensor = Sensor(int(width), int(height))
        self.streams: tuple[str, ...] = ("events", "imu") if reader.isImuStreamAvailable() else ("events",)
        self.faults = Faults()
        self._order = LiveOrder(self.sensor, self.faults.begin("events"))
        self._imu_order = ImuOrder(self.faults.begin("imu"))
        self._quiet = QuietClock(delay_s)
        self._pause = threading.Event()  # never set

    def camera(self, stream: str) -> CameraInfo | None:
        """None: a camera does not know its lens."""
        return None

    def close(self) -> None:
        """Release the camera."""
        self._reader = None

    def batches(self) -> Iterator[Batch]:
        """What arrives; see `LiveSource`."""
        deadline = time.monotonic() + WAIT_S
        while True:
            running = bool(self._reader.isRunning())  # before the read: what came until the end is read
            store = self._reader.getNextEventBatch()
            inertial = self._reader.getNextImuBatch() if "imu" in self.streams else None
            if store is not None or inertial:
                yield self._batch(store, inertial)
            elif not running:
                raise LiveEnded(self.name, "the camera stopped: it was unplugged, or its transfers failed")
            elif time.monotonic() < deadline:
                self._pause.wait(_POLL_S)
                continue
            else:
                yield Batch(Events.empty(), Imu.empty(), self._order.tick(self._quiet.now_us()))
            deadline = time.monotonic() + WAIT_S

    def _batch(self, store: Any, inertial: Any) -> Batch:
        rows = None if store is None or store.isEmpty() else store.numpy()
        events = Events.empty()
        if rows is not None:
            events = as_recorded(rows["timestamp"], rows["x"], rows["y"], rows["polarity"] > 0)
        taken = self._order.take(events)
        if taken.events.n:
            self._quiet.arrived(int(taken.events.t[-1]))
        samples = self._imu_order.take(_samples_of(inertial or ()))
        return Batch(taken.events, samples, restarted=taken.restarted)


def _samples_of(rows: Any) -> Imu:
    """Inertial samples of dv-processing in the optical frame."""
    if not len(rows):
        return Imu.empty()
    t = np.array([one.timestamp for one in rows], np.int64)
    accel = np.array([(one.accelerometerX, one.accelerometerY, one.accelerometerZ) for one in rows], np.float64)
    gyro = np.array([(one.gyroscopeX, one.gyroscopeY, one.gyroscopeZ) for one in rows], np.float64)
    return optical_samples(t, accel, gyro)


def discover() -> list[Found]:
    """The cameras that the library lists and that this module opens.

    Raises:
        ModuleNotFoundError: the library is not installed.
        RuntimeError: the library cannot list devices.
    """
    import dv_processing

    return [
        Found(
            _NAMES.get(one.cameraModel.name, ""),
            f"iniVation {one.cameraModel.name}",
            one.serialNumber,
            "USB",
            None,
            LIBRARY,
        )
        for one in dv_processing.io.camera.discover()
    ]


def open_camera(url: str, model: str, serial: str | None) -> DvCamera:
    """Open a camera.

    Args:
        url: as the user wrote it.
        model: a name of MODELS.
        serial: its serial number; None for the first of this model.

    Raises:
        NoCamera: it cannot be opened. ModuleNotFoundError: the library is not installed.
    """
    import dv_processing

    try:
        fitting = [one for one in dv_processing.io.camera.discover() if one.cameraModel.name in MODELS[model]]
        chosen = next((one for one in fitting if serial in (None, one.serialNumber)), None)
        if chosen is None:
            raise NoCamera(url, "dv-processing lists no such camera")
        return DvCamera(dv_processing.io.camera.open(chosen))
    except (RuntimeError, IndexError) as error:
        why = next((line for line in str(error).splitlines() if line.startswith("RuntimeError: ")), str(error))
        raise NoCamera(url, why.removeprefix("RuntimeError: ")) from None
