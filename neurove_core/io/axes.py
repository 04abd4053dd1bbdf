"""Axes of inertial units: to the optical frame from those of libcaer and DV, and from those that a user names."""

from collections.abc import Iterator
from typing import Final

import numpy as np
from numpy.typing import NDArray

from neurove_core.geometry.motion import Poses, Twists
from neurove_core.io.faults import Faults
from neurove_core.io.recording import Frame, Recording, Triggers
from neurove_protocol.camera import CameraInfo
from neurove_protocol.errors import InvalidField
from neurove_protocol.events import Events, Sensor
from neurove_protocol.imu import Imu

G_M_S2: Final = 9.80665
"""Standard gravity, the unit of accelerations in these formats."""

OPTICAL: Final = np.array([-1.0, 1.0, -1.0])
"""Factor of each axis (3,), for the accelerometer and the gyroscope alike.

libcaer and DV align the unit with the camera: x right, y up, z forward. An acceleration has the sign of gravity, and a
turn is positive counter-clockwise along the axis, against the right-hand rule. Both give this factor. Sources:
docs.inivation.com/hardware/hardware-advanced-usage/imu.html; the ROS driver rpg_dvs_ros applies the same signs. In
`davis346.aedat4` of DV, whose images look down on a street, the specific force along the optical axis is then negative.
"""


def optical_samples(t: NDArray[np.int64], accel_g: NDArray[np.float64], gyro_deg_s: NDArray[np.float64]) -> Imu:
    """Samples of libcaer or DV as SI units in the camera's optical frame.

    Args:
        t: (N,) sensor clock [us].
        accel_g: (N, 3) acceleration [g].
        gyro_deg_s: (N, 3) angular velocity [deg/s].
    """
    return Imu(t, accel_g * (OPTICAL * G_M_S2), np.radians(gyro_deg_s) * OPTICAL)


def parse_axes(text: str) -> NDArray[np.float64]:
    """Rotation (3, 3) from the axes of a unit to the optical frame, from the axes of the unit along x, y, z of it.

    >>> parse_axes("-x,y,-z").diagonal().tolist()
    [-1.0, 1.0, -1.0]

    Raises:
        InvalidField: the text names no rotation.
    """
    rotation = np.zeros((3, 3))
    names = [part.strip() for part in text.split(",")]
    for row, name in enumerate(names):
        sign, axis = (-1.0, name[1:]) if name.startswith("-") else (1.0, name.removeprefix("+"))
        if len(names) != 3 or axis not in ("x", "y", "z"):
            raise InvalidField("imu", "axes", text, "three axes of the unit, such as -x,y,-z, are expected")
        rotation[row, "xyz".index(axis)] = sign
    if round(float(np.linalg.det(rotation))) != 1:
        raise InvalidField("imu", "axes", text, "they are no rotation: an axis is missing, or one sign is wrong")
    return rotation


def with_axes(recording: Recording, axes: str | None) -> Recording:
    """The recording with its inertial samples rotated; the recording itself without axes.

    Args:
        recording: gives samples in the axes of its unit.
        axes: see `parse_axes`.

    Raises:
        InvalidField: the axes are no rotation, or the recording has no inertial samples.
    """
    rotation = rotation_of(axes, recording.name, recording.streams)
    return recording if rotation is None else _Rotated(recording, rotation)


def rotation_of(axes: str | None, name: str, streams: tuple[str, ...]) -> NDArray[np.float64] | None:
    """Rotation (3, 3) of the inertial samples of a source; None without axes.

    Args:
        axes: see `parse_axes`.
        name: of the source.
        streams: the kinds of data that it has.

    Raises:
        InvalidField: the axes are no rotation, or the source has no inertial samples.
    """
    if axes is None:
        return None
    rotation = parse_axes(axes)
    if "imu" not in streams:
        raise InvalidField("imu", "axes", axes, f"{name} has no inertial samples")
    return rotation


class _Rotated:
    """A recording whose inertial samples are rotated; see `Recording`."""

    def __init__(self, recording: Recording, rotation: NDArray[np.float64]) -> None:
        self._recording, self._rotation = recording, rotation

    @property
    def name(self) -> str:
        return self._recording.name

    @property
    def sensor(self) -> Sensor:
        return self._recording.sensor

    @property
    def endless(self) -> bool:
        return self._recording.endless

    @property
    def streams(self) -> tuple[str, ...]:
        return self._recording.streams

    @property
    def faults(self) -> Faults:
        return self._recording.faults

    def camera(self, stream: str) -> CameraInfo | None:
        return self._recording.camera(stream)

    def chunks(self) -> Iterator[Events]:
        return self._recording.chunks()

    def since(self, t_us: int) -> Iterator[Events]:
        return self._recording.since(t_us)

    def imu(self) -> Iterator[Imu]:
        for batch in self._recording.imu():
            yield Imu(batch.t, batch.accel_m_s2 @ self._rotation.T, batch.gyro_rad_s @ self._rotation.T)

    def triggers(self) -> Iterator[Triggers]:
        return self._recording.triggers()

    def frames(self) -> Iterator[Frame]:
        return self._recording.frames()

    def poses(self) -> Poses | None:
        return self._recording.poses()

    def twists(self) -> Twists | None:
        return self._recording.twists()
