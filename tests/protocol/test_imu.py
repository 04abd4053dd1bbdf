"""The IMU packet: its columns survive the wire, and what breaks a rule is refused by field, value and bound."""

import struct

import numpy as np
import pytest
from hypothesis import given

from neurove_protocol import Imu, ImuPacket, NeuroVEError
from neurove_protocol.errors import BlobLength, InvalidField, TimeBackwards
from neurove_protocol.imu import MAX_IMU_BYTES, MAX_SAMPLES, decode_imu, encode_imu
from tests.protocol.messages import IMU_PACKET, assert_same_imu, bounded, imu_packets, pack


def refusal(**changed: object) -> NeuroVEError:
    with pytest.raises(NeuroVEError) as caught:
        decode_imu(pack(IMU_PACKET.fields() | changed))
    return caught.value


@bounded
@given(packet=imu_packets())
def test_any_packet_survives_the_round_trip_bit_for_bit(packet: ImuPacket) -> None:
    assert_same_imu(decode_imu(encode_imu(packet)), packet)


def test_a_packet_of_the_largest_size_fits_its_cap() -> None:
    samples = Imu(np.arange(MAX_SAMPLES) + (1 << 61), *(np.full((MAX_SAMPLES, 3), value) for value in (-1e4, 1e3)))
    data = encode_imu(ImuPacket("s" * 64, (1 << 63) - 1, samples))
    assert len(data) <= MAX_IMU_BYTES
    assert_same_imu(decode_imu(data), ImuPacket("s" * 64, (1 << 63) - 1, samples))


@pytest.mark.parametrize(("name", "width"), [("t", 1), ("accel_m_s2", 3), ("gyro_rad_s", 3)])
def test_a_column_of_another_length_is_refused_by_its_name(name: str, width: int) -> None:
    for size in (0, 2 * 8 * width - 1, 2 * 8 * width + 8):
        error = refusal(**{name: bytes(size)})
        assert isinstance(error, BlobLength)
        assert error.details == {"field": name, "value": size, "bound": 2 * 8 * width}
        assert f"imu packet: {name} is {size} bytes, n=2 samples" in error.message


def test_times_that_run_backwards_are_refused_and_equal_times_are_not() -> None:
    error = refusal(t=struct.pack("<2q", 5, 4))
    assert isinstance(error, TimeBackwards)
    assert error.message == "sample 1 at t=4 us comes after t=5 us: time runs backwards"
    assert decode_imu(pack(IMU_PACKET.fields() | {"t": struct.pack("<2q", 5, 5)})).samples.t.tolist() == [5, 5]


def test_a_writer_refuses_what_a_reader_would_refuse() -> None:
    samples = decode_imu(IMU_PACKET.bytes()).samples
    for wrong in (
        Imu.empty(),
        samples._replace(t=samples.t[::-1]),
        samples._replace(gyro_rad_s=np.full((2, 3), np.nan)),
        samples._replace(gyro_rad_s=samples.gyro_rad_s[:1]),
        Imu(*(np.repeat(column, MAX_SAMPLES, axis=0) for column in samples)),
    ):
        with pytest.raises((InvalidField, TimeBackwards)):
            encode_imu(ImuPacket("cam0", 0, wrong))
