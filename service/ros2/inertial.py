"""Inertial: sensor_msgs/Imu of one camera -> inertial packets on its sensor clock, in its optical frame."""

from typing import Final

import numpy as np
from numpy.typing import NDArray

from neurove_core.io.axes import OPTICAL
from neurove_core.io.formats.ros.types import ImuMessage
from neurove_protocol.imu import MAX_ACCEL_M_S2, MAX_GYRO_RAD_S, Imu, ImuPacket, encode_imu
from neurove_service.ros2.clock import RosClock

AXES_UNKNOWN: Final = "the axes of the inertial unit are unknown: give --imu-axes"

_WAITING: Final = 64  # samples that wait for events at most
_ALIGNED: Final = ("libcaer", "libcaer_cmp")  # encodings of drivers whose inertial unit has known axes


class Inertial:
    """Samples that wait for the next events, whose clock they need.

    Args:
        stream: name of the stream.
        axes: rotation (3, 3) from the axes of the unit to the optical frame; None: known for libcaer only.
    """

    def __init__(self, stream: str, axes: NDArray[np.float64] | None = None) -> None:
        self.sent = self.ignored = 0  # samples
        self.refusal = ""  # why the newest samples were ignored
        self._stream, self._axes = stream, axes
        self._seq = 0
        self._last_us: int | None = None
        self._waiting: list[ImuMessage] = []

    def push(self, message: ImuMessage) -> bool:
        """Add a sample; return whether so many wait that they must go without further events."""
        self._waiting.append(message)
        return len(self._waiting) >= _WAITING

    def forget(self) -> None:
        """The sensor has a new clock."""
        self.ignored += len(self._waiting)
        self._waiting.clear()
        self._last_us = None

    def packet(self, clock: RosClock, encoding: str) -> bytes | None:
        """One packet of the samples that wait; None if there is none that the service can use.

        Args:
            clock: of the events.
            encoding: of the events.
        """
        rows = sorted(self._waiting, key=lambda one: one.header.stamp_ns)
        self._waiting.clear()
        axes = np.diag(OPTICAL) if self._axes is None and encoding in _ALIGNED else self._axes
        if not rows:
            return None
        if axes is None or clock.sensor_us(0) is None:
            self.refusal = AXES_UNKNOWN if axes is None else self.refusal
            self.ignored += len(rows)
            return None
        t = np.array([clock.sensor_us(one.header.stamp_ns) for one in rows], np.int64)
        accel = np.array([one.linear_acceleration for one in rows]) @ axes.T
        gyro = np.array([one.angular_velocity for one in rows]) @ axes.T
        kept = (np.abs(accel) <= MAX_ACCEL_M_S2).all(axis=1) & (np.abs(gyro) <= MAX_GYRO_RAD_S).all(axis=1)
        if self._last_us is not None:
            kept &= t >= self._last_us
        self.ignored += int(np.count_nonzero(~kept))
        if not kept.any():
            return None
        samples = Imu(t[kept], accel[kept], gyro[kept])
        payload = encode_imu(ImuPacket(self._stream, self._seq, samples))
        self._last_us, self._seq, self.sent = int(samples.t[-1]), self._seq + 1, self.sent + samples.n
        return payload
