"""Cameras of the library neuromorphic-drivers: Prophesee EVK3 and EVK4, CenturyArks, DAVIS346, DVXplorer, Lucid Triton.

Source: the interface of neuromorphic-drivers 0.18 (https://github.com/neuromorphicsystems/neuromorphic-drivers).
"""

from collections.abc import Iterator
from itertools import pairwise
from typing import Any, Final, Protocol

import numpy as np

from neurove_core.io.axes import OPTICAL
from neurove_core.io.checked import as_recorded
from neurove_core.io.faults import Faults, Reason
from neurove_core.live.found import Found
from neurove_core.live.order import ImuOrder, LiveOrder
from neurove_core.live.source import WAIT_S, Batch, LiveEnded, NoCamera, QuietClock
from neurove_protocol.camera import CameraInfo
from neurove_protocol.events import Events, Sensor
from neurove_protocol.imu import Imu

MODELS: Final = {
    "evk3": ("Prophesee EVK3 HD", "prophesee_evk3_hd"),
    "evk4": ("Prophesee EVK4", "prophesee_evk4"),
    "davis346": ("iniVation DAVIS 346", "inivation_davis346"),
    "dvxplorer": ("iniVation DVXplorer", "inivation_dvxplorer"),
    "silkyevcam": ("CenturyArks VGA", "centuryarks_vga"),
    "triton": ("Lucid Triton", "lucid_triton"),
}
"""Model in a `camera://` URL: name and module of the library."""

LIBRARY: Final = "neuromorphic-drivers"

DELAY_S: Final = 0.05
"""Longest delay of the transmission over USB [s], for the time of a stationary scene."""

MAX_BEHIND_S: Final = 0.5
"""If what is read is older, the events that wait in the USB queue are discarded and counted."""

_GYRO: Final = ("gyroscope_x", "gyroscope_y", "gyroscope_z")
_ACCEL: Final = ("accelerometer_x", "accelerometer_y", "accelerometer_z")


class Device(Protocol):
    """The part of an opened device of the library that is used here."""

    def __next__(self) -> tuple[Any, Any]:
        """Status, and what has arrived until a timeout; it waits at most WAIT_S."""

    def name(self) -> Any:
        """Model, with its name as `value`."""

    def serial(self) -> str:
        """Serial number."""

    def properties(self) -> Any:
        """Of them `width` and `height` [px]."""

    def backlog(self) -> int:
        """USB packets that wait."""

    def clear_backlog(self, until: int) -> None:
        """Discard USB packets until less than this many wait."""

    def close(self) -> None:
        """Release the camera."""


class NeuromorphicCamera:
    """An opened camera; see `LiveSource`.

    Samples are in the optical frame. The library gives the numbers of the unit as libcaer does, with the same flips, in
    m/s2 and rad/s along x right, y up, z out of the lens, so `axes.OPTICAL` holds for them too.

    Args:
        device: opened with the timeout WAIT_S.
        delay_s: longest delay of the transmission [s], see `QuietClock`.
    """

    def __init__(self, device: Device, delay_s: float = DELAY_S) -> None:
        self._device = device
        model = str(device.name().value)
        self.name = f"{model} {device.serial()}"
        properties = device.properties()
        self.sensor = Sensor(int(properties.width), int(properties.height))
        self.streams: tuple[str, ...] = ("events", "imu") if model.startswith("iniVation") else ("events",)
        self.faults = Faults()
        self._tally = self.faults.begin("events")
        self._order = LiveOrder(self.sensor, self._tally)
        self._imu_order = ImuOrder(self.faults.begin("imu"))
        self._quiet = QuietClock(delay_s)
        self._lost = False
        self._dropped = 0  # USB packets that the library counts as dropped

    def camera(self, stream: str) -> CameraInfo | None:
        """None: a camera does not know its lens."""
        return None

    def close(self) -> None:
        """Release the camera."""
        self._device.close()

    def batches(self) -> Iterator[Batch]:
        """What arrives; see `LiveSource`. Where USB packets were dropped, the next events follow a gap."""
        while True:
            try:
                status, packet = next(self._device)
                yield from self._batch(status, packet)
                self._discard_backlog(status)
            except RuntimeError as error:  # the library has no other class
                raise LiveEnded(self.name, f"the camera stopped: {error}") from None

    def _batch(self, status: Any, packet: Any) -> Iterator[Batch]:
        """One packet of the library, in parts at the places of a loss."""
        events, overflows = _events_of(packet)
        samples = self._imu_order.take(_samples_of(packet))
        if status.ring is not None and status.ring.current_t:
            self._quiet.arrived(int(status.ring.current_t))
        now_us = int(status.ring.current_t) if status.ring is not None else self._quiet.now_us()
        for part, (first, stop) in enumerate(pairwise([0, *overflows, events.n])):
            if part:
                self._count_dropped(status)
            taken = self._order.take(events.span(first, stop))
            if taken.events.n or (samples.n and not part):
                yield Batch(taken.events, samples, None, self._lost and bool(taken.events.n), taken.restarted)
                samples = Imu.empty()
                self._lost = self._lost and not taken.events.n
        if not events.n:
            yield Batch(Events.empty(), Imu.empty(), self._order.tick(now_us))

    def _count_dropped(self, status: Any) -> None:
        """Count a place at which the USB queue was full."""
        dropped = int(status.ring.dropped_packets) if status.ring is not None else 0
        why = "the queue of this machine was full: USB packets dropped"
        self._tally.add(Reason.LOST, f"t={self._order.last_us} us", why, max(1, dropped - self._dropped))
        self._dropped, self._lost = max(dropped, self._dropped), True

    def _discard_backlog(self, status: Any) -> None:
        """Discard what waits if this machine is too slow: old events are of no use to a robot."""
        behind_s = status.delay() if status.ring is not None else None
        waiting = self._device.backlog() if behind_s is not None and behind_s > MAX_BEHIND_S else 0
        if waiting:
            self._device.clear_backlog(1)
            why = f"this machine was {behind_s:.1f} s behind: USB packets discarded"
            self._tally.add(Reason.LOST, f"t={self._order.last_us} us", why, waiting)
            self._lost = True


def _events_of(packet: Any) -> tuple[Events, list[int]]:
    """Events of a packet as they were recorded, and the index of the first event after each loss."""
    rows = None if packet is None else packet.polarity_events
    found = None if packet is None else packet.polarity_events_overflow_indices
    events = (
        Events.empty() if rows is None else as_recorded(rows["t"].astype(np.int64), rows["x"], rows["y"], rows["on"])
    )
    return events, [] if found is None else [min(int(one), events.n) for one in found]


def _samples_of(packet: Any) -> Imu:
    """Inertial samples of a packet in the optical frame."""
    rows = getattr(packet, "imu_events", None)
    if rows is None or not len(rows):
        return Imu.empty()
    accel, gyro = (np.stack([rows[name] for name in names], -1).astype(np.float64) for names in (_ACCEL, _GYRO))
    return Imu(rows["t"].astype(np.int64), accel * OPTICAL, gyro * OPTICAL)


def discover() -> list[Found]:
    """The cameras that the library lists.

    Raises:
        ModuleNotFoundError: the library is not installed.
        RuntimeError: the library cannot list devices, as on a machine without a USB bus.
    """
    import neuromorphic_drivers

    names = {name: model for model, (name, _) in MODELS.items()}
    return [
        Found(names.get(one.name.value, ""), one.name.value, one.serial, one.connection.value, one.error, LIBRARY)
        for one in neuromorphic_drivers.list_devices()
    ]


def open_camera(url: str, model: str | None, serial: str | None) -> NeuromorphicCamera:
    """Open a camera.

    Args:
        url: as the user wrote it.
        model: a name of MODELS; None for the first camera.
        serial: its serial number; None for the first of this model.

    Raises:
        NoCamera: it cannot be opened. ModuleNotFoundError: the library is not installed.
    """
    import neuromorphic_drivers

    configuration = getattr(neuromorphic_drivers, MODELS[model][1]).Configuration() if model is not None else None
    try:
        device = neuromorphic_drivers.open(configuration, serial=serial, iterator_timeout=WAIT_S)
        return NeuromorphicCamera(device)
    except RuntimeError as error:
        raise NoCamera(url, str(error)) from None
