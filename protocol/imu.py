"""Samples of an inertial measurement unit (IMU), and the packet that carries them: Imu, ImuPacket.

The samples are in the optical frame of the stream's camera, so that a service needs no mounting of the unit.
"""

from dataclasses import dataclass
from typing import Annotated, Any, ClassVar, Final, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from neurove_protocol.codec import Count, Message, Name, unpack, validate
from neurove_protocol.errors import BlobLength, InvalidField, TimeBackwards

SCHEMA = "application/msgpack;neurove.imu.1"
"""Zenoh Encoding of an IMU packet."""

MAX_SAMPLES: Final = 4096
"""Cap of the samples in one packet."""

MAX_IMU_BYTES: Final = MAX_SAMPLES * 56 + 1024
"""Cap of an IMU packet: 56 bytes for each sample, and 1024 for the other fields."""

MAX_ACCEL_M_S2: Final = 1e4
MAX_GYRO_RAD_S: Final = 1e3
"""Bounds of the absolute value of each number: about 1000 g, and 57,000 degrees per second."""

_MAX_US = 1 << 62


class Imu(NamedTuple):
    """Samples of an inertial unit as columns, ordered by time, in SI units."""

    t: NDArray[np.int64]  # (N,) sensor clock [us]
    accel_m_s2: NDArray[np.float64]  # (N, 3) specific force: at rest it points up, with a length of 9.8
    gyro_rad_s: NDArray[np.float64]  # (N, 3)

    @property
    def n(self) -> int:
        """Number of samples."""
        return int(self.t.size)

    def span(self, first: int, stop: int) -> Self:
        """Samples [first, stop), as views."""
        return type(self)(self.t[first:stop], self.accel_m_s2[first:stop], self.gyro_rad_s[first:stop])

    @classmethod
    def empty(cls) -> Self:
        """No samples."""
        return cls(np.empty(0, np.int64), np.empty((0, 3)), np.empty((0, 3)))


@dataclass(frozen=True, slots=True, eq=False)
class ImuPacket:
    """The ordered samples of one stream that a driver sends at once."""

    stream: str
    seq: int  # counts IMU packets of this stream from 0, without gaps
    samples: Imu  # at least one, in the camera's optical frame


class _Wire(Message):
    what: ClassVar[str] = "imu packet"
    max_bytes: ClassVar[int] = MAX_IMU_BYTES

    stream: Name
    seq: Count
    n: Annotated[int, Field(ge=1, le=MAX_SAMPLES)]
    t: bytes
    accel_m_s2: bytes
    gyro_rad_s: bytes


def encode_imu(packet: ImuPacket) -> bytes:
    """The packet's bytes; see README.md of this package for the layout.

    Raises:
        InvalidField, TimeBackwards: the packet is invalid.
    """
    t, accel, gyro = packet.samples
    if accel.shape != (t.size, 3) or gyro.shape != (t.size, 3):
        shapes = f"t {t.shape}, accel {accel.shape}, gyro {gyro.shape}"
        raise InvalidField(_Wire.what, "samples", shapes, "columns of N, (N, 3) and (N, 3) are expected")
    check_imu(packet.samples)
    fields: dict[str, Any] = {"stream": packet.stream, "seq": packet.seq, "n": int(t.size)}
    fields |= {"t": t.astype("<i8").tobytes()}
    fields |= {"accel_m_s2": accel.astype("<f8").tobytes(), "gyro_rad_s": gyro.astype("<f8").tobytes()}
    return validate(_Wire, fields).encode()


def decode_imu(data: bytes) -> ImuPacket:
    """Read and check an IMU packet; the columns are read-only.

    Raises:
        NeuroVEError: Malformed, UnsupportedVersion, InvalidField, BlobLength or TimeBackwards; never any other
            exception.
    """
    wire = validate(_Wire, unpack(data, _Wire.what, MAX_IMU_BYTES))
    for name, width in (("t", 1), ("accel_m_s2", 3), ("gyro_rad_s", 3)):
        blob = getattr(wire, name)
        if len(blob) != wire.n * width * 8:
            raise BlobLength(len(blob), wire.n, width * 8, what=_Wire.what, field=name, items="samples")
    t = np.frombuffer(wire.t, "<i8")
    accel, gyro = (np.frombuffer(blob, "<f8").reshape(-1, 3) for blob in (wire.accel_m_s2, wire.gyro_rad_s))
    samples = Imu(t, accel, gyro)
    check_imu(samples)
    return ImuPacket(wire.stream, wire.seq, samples)


def check_imu(samples: Imu) -> None:
    """Refuse samples whose times run backwards, or whose numbers are not finite or out of bounds.

    Raises:
        InvalidField, TimeBackwards: the first sample that is wrong is named.
    """
    for name, column, bound in (
        ("accel_m_s2", samples.accel_m_s2, MAX_ACCEL_M_S2),
        ("gyro_rad_s", samples.gyro_rad_s, MAX_GYRO_RAD_S),
    ):
        wrong = ~(np.abs(column) <= bound)  # in this form nan counts as wrong
        if wrong.any():
            index = int(np.flatnonzero(wrong.any(axis=1))[0])
            raise InvalidField(_Wire.what, name, column[index].tolist(), f"sample {index}: at most {bound:g} each way")
    outside = (samples.t < -_MAX_US) | (samples.t >= _MAX_US)
    if outside.any():
        index = int(np.flatnonzero(outside)[0])
        raise InvalidField(_Wire.what, "t", int(samples.t[index]), f"sample {index}: -2^62 to 2^62 - 1 us")
    backwards = samples.t[1:] < samples.t[:-1]
    if backwards.any():
        index = int(np.flatnonzero(backwards)[0]) + 1
        raise TimeBackwards(index, int(samples.t[index - 1]), int(samples.t[index]), "sample")
