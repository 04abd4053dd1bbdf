"""Events and the packet that carries them: EVENT_DTYPE, Sensor, Events, EventPacket, encode_packet, decode_packet.

`open_packet` leaves the events in the layout of the packet, for a reader that decodes them itself.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, Any, ClassVar, NamedTuple

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from neurove_protocol.codec import Count, Message, Name, unpack, validate
from neurove_protocol.errors import BlobLength, EventOutsideSensor, InvalidField, TimeBackwards, UnknownFormat
from neurove_protocol.header import header_bytes

EVENT_DTYPE = np.dtype([("t", "<i8"), ("x", "<u2"), ("y", "<u2"), ("p", "u1")])
"""One event as a record, for files and tables: t sensor clock [us], x and y [px], p polarity (1 ON, 0 OFF)."""

FORMATS = ("soa6", "soa8")
"""Layouts of the event blob; the name ends with the bytes per event. `evt3` is reserved for raw Prophesee words."""

SCHEMA = "application/msgpack;neurove.events.1"
"""Zenoh Encoding of an event packet."""

MAX_PACKET_BYTES = 32 << 20
"""No packet is larger, whatever a service configures: the transport refuses larger messages."""

MAX_HEADER_BYTES = 1024
"""Cap of a packet's fields without its events."""

_Y_MASK = np.uint16((1 << 15) - 1)


@dataclass(frozen=True, slots=True)
class Sensor:
    """The pixel array of a camera.

    >>> print(Sensor(346, 260))
    346x260
    """

    width: int
    height: int

    def __post_init__(self) -> None:
        for name, value in (("width", self.width), ("height", self.height)):
            if not 1 <= value <= 1 << 15:
                raise InvalidField("sensor", name, value, "must be 1 to 32768 px")

    def __str__(self) -> str:
        return f"{self.width}x{self.height}"


class Events(NamedTuple):
    """Events as columns, all of the same length N and ordered by t. Columns may be read-only views."""

    t: NDArray[np.int64]  # sensor clock [us]
    x: NDArray[np.uint16]  # [px], right
    y: NDArray[np.uint16]  # [px], down
    p: NDArray[np.uint8]  # 1 ON (brighter), 0 OFF

    @property
    def n(self) -> int:
        """Number of events."""
        return int(self.t.size)

    @property
    def first_us(self) -> int:
        """Time of the first event [us]; there must be one."""
        return int(self.t[0])

    @property
    def last_us(self) -> int:
        """Time of the last event [us]; there must be one."""
        return int(self.t[-1])

    def before(self, t_us: int) -> int:
        """Number of events earlier than `t_us`."""
        return int(self.t.searchsorted(t_us))

    def span(self, first: int, stop: int) -> "Events":
        """Events [first, stop), as views."""
        return Events(self.t[first:stop], self.x[first:stop], self.y[first:stop], self.p[first:stop])

    def to_records(self) -> NDArray[np.void]:
        """A copy as one array of EVENT_DTYPE."""
        records = np.empty(self.n, EVENT_DTYPE)
        for name, column in zip(EVENT_DTYPE.names or (), self, strict=True):
            records[name] = column
        return records

    @classmethod
    def from_columns(cls, t: Any, x: Any, y: Any, p: Any) -> "Events":
        """Events from array-likes; copies a column only if its type differs."""
        return cls(np.asarray(t, np.int64), np.asarray(x, np.uint16), np.asarray(y, np.uint16), np.asarray(p, np.uint8))

    @classmethod
    def from_records(cls, records: NDArray[np.void]) -> "Events":
        """Columns of an array with the fields t, x, y, p."""
        return cls.from_columns(*(np.ascontiguousarray(records[name]) for name in ("t", "x", "y", "p")))

    @classmethod
    def empty(cls) -> "Events":
        """No events."""
        return cls.from_columns((), (), (), ())

    @classmethod
    def join(cls, parts: Sequence["Events"]) -> "Events":
        """All events of the parts, in the order given."""
        if len(parts) == 1:
            return parts[0]
        return cls(*(np.concatenate(columns) for columns in zip(*parts, strict=True))) if parts else cls.empty()


class WireEvents(NamedTuple):
    """Events in the layout of a packet, 6 or 8 bytes each."""

    t0_us: int  # sensor clock
    blob: NDArray[np.uint8]  # of a packet, read-only; at any address
    wide: bool  # soa8, else soa6
    first: int  # these are events [first, stop) of the blob
    stop: int

    @property
    def n(self) -> int:
        """Number of events."""
        return self.stop - self.first

    @property
    def first_us(self) -> int:
        """Time of the first event [us]; there must be one."""
        return self._time_us(self.first)

    @property
    def last_us(self) -> int:
        """Time of the last event [us]; there must be one."""
        return self._time_us(self.stop - 1)

    def before(self, t_us: int) -> int:
        """Number of events earlier than `t_us`."""
        offset, after_us = self._column(0), t_us - self.t0_us
        if after_us <= 0:
            return 0
        kind = offset.dtype.type  # another type would convert the whole column
        return self.n if after_us > np.iinfo(kind).max else int(offset.searchsorted(kind(after_us)))

    def span(self, first: int, stop: int) -> "WireEvents":
        """Events [first, stop), as views."""
        first, stop, _ = slice(first, stop).indices(self.n)
        return self._replace(first=self.first + first, stop=self.first + max(first, stop))

    def columns(self) -> Events:
        """The same events as columns; x stays a view, the others are computed."""
        offset, x, y_and_p = (self._column(index) for index in range(3))
        p = (y_and_p >> np.uint16(15)).astype(np.uint8)
        return Events(offset.astype(np.int64) + self.t0_us, x, y_and_p & _Y_MASK, p)

    def _time_us(self, index: int) -> int:
        """Time of one event of the blob [us]; a view of the column would take longer."""
        size = 4 if self.wide else 2
        return self.t0_us + int.from_bytes(self.blob[size * index : size * (index + 1)].tobytes(), "little")

    def _column(self, index: int) -> NDArray[Any]:
        """Offsets from t0_us [us], x, or y with the polarity in bit 15."""
        bytes_each = 4 if self.wide else 2
        events = self.blob.size // (bytes_each + 4)
        if index == 0:
            whole = self.blob[: bytes_each * events].view("<u4" if self.wide else "<u2")
        else:
            begin = (bytes_each + 2 * (index - 1)) * events
            whole = self.blob[begin : begin + 2 * events].view("<u2")
        return whole[self.first : self.stop]


def check_events(events: Events, sensor: Sensor, not_before_us: int | None = None) -> None:
    """Refuse events that lie outside the sensor or whose times run backwards.

    Args:
        events: what to check.
        sensor: the pixel array they must lie on.
        not_before_us: the first event must not be earlier than this [us], where given.

    Raises:
        EventOutsideSensor, TimeBackwards: the first event that is wrong is named.
    """
    if not events.n:
        return
    if int(events.x.max()) >= sensor.width or int(events.y.max()) >= sensor.height:
        index = int(np.flatnonzero((events.x >= sensor.width) | (events.y >= sensor.height))[0])
        raise EventOutsideSensor(index, int(events.x[index]), int(events.y[index]), sensor)
    if not_before_us is not None and events.t[0] < not_before_us:
        raise TimeBackwards(0, not_before_us, int(events.t[0]))
    backwards = events.t[1:] < events.t[:-1]
    if backwards.any():
        index = int(np.flatnonzero(backwards)[0]) + 1
        raise TimeBackwards(index, int(events.t[index - 1]), int(events.t[index]))


@dataclass(frozen=True, slots=True)
class EventPacket:
    """The ordered events of one stream, from t0_us on, that a driver sends at once.

    A packet without events is a clock tick: the driver has sent every event before t0_us.
    """

    stream: str
    seq: int  # counts packets of this stream from 0, without gaps
    sensor: Sensor
    t0_us: int  # sensor clock; no event of this packet is earlier
    events: Events


class WirePacket(NamedTuple):
    """An EventPacket whose events are still in the layout of the packet."""

    stream: str
    seq: int
    sensor: Sensor
    t0_us: int
    events: WireEvents


@dataclass(frozen=True, slots=True)
class PacketLimits:
    """Caps on a packet; a larger one is refused."""

    max_events: int = 1_000_000
    max_side_px: int = 4096

    @property
    def max_bytes(self) -> int:
        """Largest packet on the wire: the largest blob and its header."""
        return self.max_events * 8 + MAX_HEADER_BYTES


DEFAULT_LIMITS = PacketLimits()
_BLOB_KEY = b"\xa4data"

Packet = EventPacket | WirePacket


class _Header(Message):
    what: ClassVar[str] = "event packet"

    stream: Name
    seq: Count
    width: Annotated[int, Field(ge=1)]
    height: Annotated[int, Field(ge=1)]
    t0_us: Annotated[int, Field(ge=-(1 << 62), lt=1 << 62)]
    n: Count
    format: str
    data: bytes


def encode_packet(packet: EventPacket, blob_format: str | None = None) -> bytes:
    """The packet's bytes; see README.md of this package for the layout.

    Args:
        packet: events ordered by time, on the sensor, none before t0_us.
        blob_format: one of FORMATS; by default the smallest that the packet's time span fits.

    Raises:
        EventOutsideSensor, TimeBackwards, InvalidField: the packet is invalid.
    """
    check_events(packet.events, packet.sensor, packet.t0_us)
    if (packet.events.p > 1).any():  # -1 for OFF would become ON
        raise InvalidField(_Header.what, "p", int(packet.events.p.max()), "the polarity is 1 (ON) or 0 (OFF)")
    span_us = int(packet.events.t[-1]) - packet.t0_us if packet.events.n else 0
    blob_format = blob_format or ("soa6" if span_us < 1 << 16 else "soa8")
    if blob_format not in FORMATS:
        raise UnknownFormat(blob_format, FORMATS)
    offset_type, limit_us = ("<u2", 1 << 16) if blob_format == "soa6" else ("<u4", 1 << 32)
    if span_us >= limit_us:
        raise InvalidField(_Header.what, "t", span_us, f"{blob_format} holds offsets below {limit_us} us")
    y_and_p = packet.events.y | (packet.events.p.astype(np.uint16) << np.uint16(15))
    blob = b"".join(
        (
            (packet.events.t - packet.t0_us).astype(offset_type).tobytes(),
            packet.events.x.astype("<u2", copy=False).tobytes(),
            y_and_p.astype("<u2", copy=False).tobytes(),
        )
    )
    header = {
        "stream": packet.stream,
        "seq": packet.seq,
        "width": packet.sensor.width,
        "height": packet.sensor.height,
        "t0_us": packet.t0_us,
        "n": packet.events.n,
        "format": blob_format,
        "data": blob,
    }
    return validate(_Header, header).encode()


def decode_packet(data: bytes, limits: PacketLimits = DEFAULT_LIMITS) -> EventPacket:
    """Read and check an event packet; x is a view into `data`, the other columns are computed.

    Raises:
        NeuroVEError: Malformed, UnsupportedVersion, InvalidField, UnknownFormat, BlobLength, EventOutsideSensor or
            TimeBackwards; never any other exception.
    """
    packet = open_packet(data, limits)
    events = packet.events.columns()
    check_events(events, packet.sensor)
    return EventPacket(packet.stream, packet.seq, packet.sensor, packet.t0_us, events)


def open_packet(data: bytes, limits: PacketLimits = DEFAULT_LIMITS) -> WirePacket:
    """Read an event packet and check everything except its events, which may lie outside the sensor or run backwards.

    Raises:
        NeuroVEError: as decode_packet, except for EventOutsideSensor and TimeBackwards.
    """
    if len(data) <= limits.max_bytes:
        size = header_bytes(data, _BLOB_KEY, MAX_HEADER_BYTES)
        if size > MAX_HEADER_BYTES:
            why = f"the fields without the events have at most {MAX_HEADER_BYTES} bytes"
            raise InvalidField(_Header.what, "header", size, why)
    header = validate(_Header, unpack(data, _Header.what, limits.max_bytes))
    for name, value, bound in (
        ("n", header.n, limits.max_events),
        ("width", header.width, limits.max_side_px),
        ("height", header.height, limits.max_side_px),
    ):
        if value > bound:
            raise InvalidField(_Header.what, name, value, f"the configured cap is {bound}")
    if header.format not in FORMATS:
        raise UnknownFormat(header.format, FORMATS)
    wide = header.format == "soa8"
    record_bytes = 8 if wide else 6
    if len(header.data) != header.n * record_bytes:
        raise BlobLength(len(header.data), header.n, record_bytes)
    events = WireEvents(header.t0_us, np.frombuffer(header.data, np.uint8), wide, 0, header.n)
    return WirePacket(header.stream, header.seq, Sensor(header.width, header.height), header.t0_us, events)
