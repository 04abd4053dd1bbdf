"""Layout of NeuroVE recordings: MCAP files with the profile `neurove`. Every MCAP tool can list and split them.

A stream has up to eight channels with the name `<stream>/<kind>` and the message encoding `msgpack`:

| kind | schema | content of a message |
| --- | --- | --- |
| events | neurove.events.1 | an EventPacket, the published bytes |
| camera | neurove.camera.1 | a CameraInfo, the published bytes |
| imu | neurove.imu.1 | an ImuPacket, the published bytes; older files have its columns without stream and number |
| triggers | neurove.triggers.1 | edges: `t`, `channel`, `level` |
| poses | neurove.poses.1 | `t`, `position_m`, `orientation` |
| twists | neurove.twists.1 | `t`, `twist` |
| frames | neurove.frames.1 | one image: `t_us`, `height`, `width`, `channels`, `image` (bytes, row-major) |
| velocity | neurove.velocity.1 | a TwistEstimate; files of `neurove estimate` have this channel alone |

Columns have the names and units of the types in `neurove_core.io.recording` and `neurove_core.geometry.motion`. A table
is a msgpack map of `v` (1), `n` (number of rows) and the columns. A column is bytes: little-endian numbers, row-major.

The log time of a live recording is the receive time [unix ns]. The log time of a converted recording is the sensor time
[ns]. The metadata record `neurove` describes the content and the source of the recording.
"""

from collections.abc import Mapping
from typing import Any, Final, NamedTuple

import msgpack
import numpy as np

from neurove_core.geometry.motion import Poses, Twists
from neurove_core.io.recording import Frame, Triggers
from neurove_protocol import camera, events, imu, velocity
from neurove_protocol.imu import Imu

PROFILE: Final = "neurove"
VERSION: Final = 1
ROWS: Final = 4096
"""Maximum number of rows in one message."""


class Column(NamedTuple):
    """Storage of one column."""

    name: str
    dtype: str
    width: int  # numbers per row


_T = Column("t", "<i8", 1)
COLUMNS: Final[dict[str, tuple[Column, ...]]] = {
    "imu": (_T, Column("accel_m_s2", "<f8", 3), Column("gyro_rad_s", "<f8", 3)),
    "triggers": (_T, Column("channel", "u1", 1), Column("level", "u1", 1)),
    "poses": (_T, Column("position_m", "<f8", 3), Column("orientation", "<f8", 4)),
    "twists": (_T, Column("twist", "<f8", 6)),
}
TYPES: Final[dict[str, type[Imu] | type[Triggers] | type[Poses] | type[Twists]]] = {
    "imu": Imu,
    "triggers": Triggers,
    "poses": Poses,
    "twists": Twists,
}


class BadColumns(Exception):
    """A message does not hold a valid table or image."""


def schema_of(kind: str) -> tuple[str, str]:
    """Return schema name and message encoding of a kind; those of the wire for `events`, `camera` and `velocity`.

    >>> schema_of("events")
    ('neurove.events.1', 'msgpack')
    """
    schemas = {"events": events.SCHEMA, "camera": camera.SCHEMA, "imu": imu.SCHEMA, "velocity": velocity.SCHEMA}
    wire = schemas.get(kind, f"application/msgpack;neurove.{kind}.{VERSION}")
    encoding, _, name = wire.partition(";")
    return name, encoding.removeprefix("application/")


def pack_columns(kind: str, table: Imu | Triggers | Poses | Twists) -> bytes:
    """Encode a table as one message."""
    fields: dict[str, Any] = {"v": VERSION, "n": int(table.t.size)}
    for column in COLUMNS[kind]:
        fields[column.name] = np.ascontiguousarray(getattr(table, column.name), column.dtype).tobytes()
    return bytes(msgpack.packb(fields))


def unpack_columns(kind: str, data: bytes) -> Any:
    """Decode the table of a message.

    Raises:
        BadColumns: the message does not hold a valid table of this kind.
    """
    fields = _fields(data)
    n = fields.get("n")
    if type(n) is not int or n < 0:
        raise BadColumns(f"n={n!r} is not a number of rows")
    columns = []
    for name, dtype, width in COLUMNS[kind]:
        blob = fields.get(name)
        if not isinstance(blob, bytes) or len(blob) != n * width * np.dtype(dtype).itemsize:
            raise BadColumns(f"column {name} does not have {n} rows")
        column = np.frombuffer(blob, dtype)
        columns.append(column.reshape(n, width) if width > 1 else column)
    return TYPES[kind](*columns)


def pack_frame(frame: Frame) -> bytes:
    """Encode an image as one message."""
    height, width, *channels = frame.image.shape
    image = np.ascontiguousarray(frame.image, np.uint8).tobytes()
    shape = {"height": height, "width": width, "channels": channels[0] if channels else 1}
    return bytes(msgpack.packb({"v": VERSION, "t_us": int(frame.t_us), **shape, "image": image}))


def unpack_frame(data: bytes) -> Frame:
    """Decode the image of a message.

    Returns:
        A frame whose image has shape (height, width) or (height, width, 3), uint8.

    Raises:
        BadColumns: the message does not hold a valid image.
    """
    fields = _fields(data)
    numbers = [fields.get(name) for name in ("t_us", "height", "width", "channels")]
    image = fields.get("image")
    if not all(type(number) is int for number in numbers) or not isinstance(image, bytes):
        raise BadColumns("the message is not an image")
    t_us, height, width, channels = (int(number or 0) for number in numbers)
    if channels not in (1, 3) or min(height, width) < 0 or len(image) != height * width * channels:
        raise BadColumns(f"{len(image)} bytes are not an image of {width}x{height}x{channels}")
    shape = (height, width) if channels == 1 else (height, width, channels)
    return Frame(t_us, np.frombuffer(image, np.uint8).reshape(shape))


def _fields(data: bytes) -> Mapping[str, Any]:
    try:
        fields = msgpack.unpackb(data)
    except (ValueError, TypeError, msgpack.UnpackException) as error:
        raise BadColumns(str(error) or type(error).__name__) from None
    if not isinstance(fields, dict) or fields.get("v") != VERSION:
        raise BadColumns("the message is not a map of version 1")
    return fields
