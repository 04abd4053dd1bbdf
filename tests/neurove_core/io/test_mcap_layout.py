"""Tables and images in NeuroVE recordings: valid messages and invalid messages."""

import msgpack
import numpy as np
import pytest

from neurove_core.geometry.motion import Twists
from neurove_core.io import Imu
from neurove_core.io.formats.packet_log.layout import BadColumns, pack_columns, pack_frame, unpack_columns, unpack_frame
from neurove_core.io.recording import Frame

RNG = np.random.default_rng(0)
IMU = Imu(np.arange(3, dtype=np.int64), RNG.normal(size=(3, 3)), RNG.normal(size=(3, 3)))
TABLE, IMAGE = pack_columns("imu", IMU), pack_frame(Frame(7, np.arange(12, dtype=np.uint8).reshape(3, 4)))


def with_field(data, **fields):
    return msgpack.packb({name: value for name, value in (msgpack.unpackb(data) | fields).items() if value is not None})


@pytest.mark.parametrize(
    ("kind", "table"), [("imu", IMU), ("twists", Twists(np.arange(2, dtype=np.int64), RNG.normal(size=(2, 6))))]
)
def test_a_table_is_read_back_bit_for_bit(kind, table):
    back = unpack_columns(kind, pack_columns(kind, table))
    assert type(back) is type(table)
    for a, b in zip(back, table, strict=True):
        np.testing.assert_array_equal(a, b)
        assert a.dtype == b.dtype


@pytest.mark.parametrize("shape", [(3, 4), (3, 4, 3), (0, 4)])
def test_a_grey_or_colour_image_is_read_back(shape):
    image = RNG.integers(0, 256, shape, np.uint8)
    back = unpack_frame(pack_frame(Frame(-5, image)))
    assert back.t_us == -5
    np.testing.assert_array_equal(back.image, image)


@pytest.mark.parametrize(
    ("fields", "why"),
    [
        ({"n": -1}, "n=-1 is not a number of rows"),
        ({"n": True}, "n=True is not a number of rows"),
        ({"n": None}, "n=None is not a number of rows"),
        ({"n": 4}, "column t does not have 4 rows"),
        ({"t": None}, "column t does not have 3 rows"),
        ({"gyro_rad_s": "a text"}, "column gyro_rad_s does not have 3 rows"),
        ({"gyro_rad_s": b"12"}, "column gyro_rad_s does not have 3 rows"),
        ({"v": 2}, "not a map of version 1"),
    ],
)
def test_an_invalid_table_is_rejected_with_the_reason(fields, why):
    with pytest.raises(BadColumns, match=why):
        unpack_columns("imu", with_field(TABLE, **fields))


@pytest.mark.parametrize(
    ("fields", "why"),
    [
        ({"t_us": 1.5}, "not an image"),
        ({"height": None}, "not an image"),
        ({"image": "a text"}, "not an image"),
        ({"channels": 2, "width": 2}, "not an image of 2x3x2"),
        ({"width": 5}, "12 bytes are not an image of 5x3x1"),
        ({"height": -3, "width": -4}, "not an image of -4x-3x1"),
    ],
)
def test_an_invalid_image_is_rejected_with_the_reason(fields, why):
    with pytest.raises(BadColumns, match=why):
        unpack_frame(with_field(IMAGE, **fields))


@pytest.mark.parametrize("unpack", [unpack_frame, lambda data: unpack_columns("imu", data)])
@pytest.mark.parametrize("data", [b"", b"\xc1", b"\x93\x01\x02\x03", TABLE[:-1], b"\x81\x80\x01"])
def test_bytes_that_are_not_a_message_are_rejected(unpack, data):
    with pytest.raises(BadColumns):
        unpack(data)
