"""The service's fast path from a packet's bytes to a window's counts, without event columns in between.

`neurove_protocol.decode_packet` and `counting.count_events` are the reference implementation: they reject the same
packets with the same error texts and give the same counts, bit for bit.
"""

from functools import lru_cache
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from neurove_core.compiled import compiled
from neurove_core.ingest.counting import add_events
from neurove_core.ingest.products import scaled_cell
from neurove_core.ingest.scaling import Scale, scale_of
from neurove_protocol.events import (
    DEFAULT_LIMITS,
    PacketLimits,
    Sensor,
    WireEvents,
    WirePacket,
    decode_packet,
    open_packet,
)
from neurove_protocol.keys import is_name

_BLOCK: Final = 512  # as in counting.py


def read_packet(data: bytes, limits: PacketLimits = DEFAULT_LIMITS) -> WirePacket:
    """Read and check an event packet; its events are not copied.

    Raises:
        NeuroVEError: as decode_packet.
    """
    raw = np.frombuffer(data, np.uint8)
    if raw.size <= limits.max_bytes:
        found = _read(raw, limits.max_events, limits.max_side_px)
        stream = data[found.name : found.name_end].decode("ascii", "replace")
        if found.blob and is_name(stream):
            events = WireEvents(found.t0_us, raw[found.blob :], found.wide, 0, found.n)
            return WirePacket(stream, found.seq, _sensor(found.width, found.height), found.t0_us, events)
    packet = open_packet(data, limits)
    if not _valid(packet.events.blob, packet.events.wide, packet.sensor.width, packet.sensor.height):
        decode_packet(data, limits)  # raises an error that names the wrong event
    return packet


_sensor = lru_cache(64)(Sensor)


def count_wire(
    events: WireEvents, start_us: int, bin_us: int, lut: NDArray[np.int32], counts: NDArray[np.uint8]
) -> int:
    """`counting.count_events` for events in the layout of a packet.

    Args:
        events: all with start_us <= t < start_us + n * bin_us, ordered by time, on the sensor of `lut`.
        start_us: start of the window [us].
        bin_us: length of one of its n bins [us].
        lut: (sensor.height, sensor.width) cell of each pixel, or geometry.camera.OUTSIDE.
        counts: (2n, H, W), changed.

    Returns:
        number of events whose pixel has no cell.
    """
    t0_us, blob, wide, first, stop = events
    return _count(blob, wide, first, stop, start_us - t0_us, bin_us, lut, scale_of(lut, counts.shape[2]), counts)


class _Found(NamedTuple):
    """The fields of a packet; offsets are in bytes from its start."""

    blob: int  # offset of the events; 0 where the packet was not read
    name: int = 0
    name_end: int = 0
    seq: int = 0
    width: int = 0
    height: int = 0
    t0_us: int = 0
    n: int = 0
    wide: bool = False


def _key(text: bytes) -> NDArray[np.uint8]:
    return np.frombuffer(text, np.uint8)


_TO_STREAM, _TO_SEQ, _TO_WIDTH, _TO_HEIGHT, _TO_T0, _TO_N, _TO_FORMAT, _TO_DATA = (
    _key(bytes([128 + 9]) + b"\xa1v\x01\xa6stream"),  # a map of nine, version 1
    *(_key(bytes([160 + len(name)]) + name) for name in (b"seq", b"width", b"height", b"t0_us", b"n")),
    _key(b"\xa6format\xa4soa"),
    _key(b"\xa4data"),
)


@compiled
def _read(data: NDArray[np.uint8], max_events: int, max_side: int) -> _Found:  # pragma: no cover (machine code)
    """Read a valid packet with the field order of our encoder; any other packet is left to the reference reader."""
    nothing = _Found(0, 0, 0, 0, 0, 0, 0, 0, False)
    name = _past(data, 0, _TO_STREAM)
    if name < 0 or not 160 < data[name] < 192:
        return nothing
    name_end = name + 1 + data[name] - 160
    seq, at = _integer(data, _past(data, name_end, _TO_SEQ))
    width, at = _integer(data, _past(data, at, _TO_WIDTH))
    height, at = _integer(data, _past(data, at, _TO_HEIGHT))
    t0_us, at = _integer(data, _past(data, at, _TO_T0))
    n, at = _integer(data, _past(data, at, _TO_N))
    at = _past(data, at, _TO_FORMAT)
    if at < 0 or (data[at] != _SIX and data[at] != _EIGHT):
        return nothing
    wide = data[at] == _EIGHT
    at = _past(data, at + 1, _TO_DATA)
    size, blob = _length(data, at)
    most = min(max_side, 1 << 15)
    good = seq >= 0 and 1 <= width <= most and 1 <= height <= most and 0 <= n <= max_events
    good = good and -(1 << 62) <= t0_us < 1 << 62 and size == n * (8 if wide else 6) and size == data.size - blob
    if blob < 0 or not good or not _valid(data[blob:], wide, width, height):
        return nothing
    return _Found(blob, name + 1, name_end, seq, width, height, t0_us, n, wide)


_SIX, _EIGHT = ord("6"), ord("8")


@compiled
def _past(data: NDArray[np.uint8], at: int, text: NDArray[np.uint8]) -> int:  # pragma: no cover (machine code)
    """Offset behind the text expected at `at`, which another byte must follow; -1 where there is another text."""
    if at < 0 or at + text.size >= data.size:
        return -1
    for i in range(text.size):
        if data[at + i] != text[i]:
            return -1
    return at + text.size


@compiled
def _integer(data: NDArray[np.uint8], at: int) -> tuple[Any, Any]:  # pragma: no cover (machine code)
    """The msgpack integer at `at` and the offset behind it; 0 and -1 where there is none below 2**63."""
    if at < 0:
        return 0, -1
    head: Any = np.int64(data[at])
    at += 1
    if head < 0x80:
        return head, at
    if head >= 0xE0:
        return head - 0x100, at
    if not 0xCC <= head <= 0xD3:
        return 0, -1
    size = 1 << ((head - 0xCC) % 4)
    if at + size > data.size:
        return 0, -1
    signed = head >= 0xD0
    value: Any = np.int64(data[at])
    if value >= 0x80 and (signed or size == 8):
        if not signed:
            return 0, -1
        value -= 0x100
    for i in range(1, size):
        value = value * 256 + np.int64(data[at + i])
    return value, at + size


@compiled
def _length(data: NDArray[np.uint8], at: int) -> tuple[Any, Any]:  # pragma: no cover (machine code)
    """Length of the msgpack bin at `at` and offset of its bytes; 0 and -1 where there is none."""
    if at < 0 or not 0xC4 <= data[at] <= 0xC6:
        return 0, -1
    size, value = 1 << (np.int64(data[at]) - 0xC4), np.int64(0)
    if at + 1 + size > data.size:
        return 0, -1
    for i in range(size):
        value = value * 256 + np.int64(data[at + 1 + i])
    return value, at + 1 + size


@compiled
def _valid(blob: NDArray[np.uint8], wide: bool, width: int, height: int) -> bool:  # pragma: no cover (machine code)
    """Whether all events of a blob are on the sensor and ordered by time."""
    n = blob.size // (8 if wide else 6)
    if wide:
        return _valid_columns(blob[: 4 * n].view(np.uint32), blob[4 * n :].view(np.uint16), width, height)
    return _valid_columns(blob[: 2 * n].view(np.uint16), blob[2 * n :].view(np.uint16), width, height)


@compiled
def _valid_columns(
    offset: NDArray[Any], x_and_y: NDArray[np.uint16], width: int, height: int
) -> bool:  # pragma: no cover (machine code)
    n = offset.size
    x, y_and_p = x_and_y[:n], x_and_y[n:]
    furthest, lowest, backwards = np.uint16(0), np.uint16(0), False
    for i in range(n):
        furthest, lowest = max(furthest, x[i]), max(lowest, y_and_p[i] & np.uint16(0x7FFF))
    for i in range(1, n):
        backwards |= offset[i] < offset[i - 1]
    return bool(n == 0 or (furthest < width and lowest < height and not backwards))


@compiled
def _count(
    blob: NDArray[np.uint8],
    wide: bool,
    first: int,
    stop: int,
    start: int,
    bin_us: int,
    lut: NDArray[np.int32],
    scale: Scale,
    counts: NDArray[np.uint8],
) -> int:  # pragma: no cover (machine code)
    """Count events `first` to `stop` of a blob; `start` is the window's start relative to the packet's t0_us."""
    if wide:
        n = blob.size // 8
        offset, xy = blob[: 4 * n].view(np.uint32)[first:stop], blob[4 * n :].view(np.uint16)
        return _count_columns(offset, xy[first:stop], xy[n + first : n + stop], start, bin_us, lut, scale, counts)
    n = blob.size // 6
    short, xy = blob[: 2 * n].view(np.uint16)[first:stop], blob[2 * n :].view(np.uint16)
    return _count_columns(short, xy[first:stop], xy[n + first : n + stop], start, bin_us, lut, scale, counts)


@compiled
def _count_columns(
    offset: NDArray[Any],
    x: NDArray[np.uint16],
    y_and_p: NDArray[np.uint16],
    start: int,
    bin_us: int,
    lut: NDArray[np.int32],
    scale: Scale,
    counts: NDArray[np.uint8],
) -> int:  # pragma: no cover (machine code)
    """As counting._count, on columns of the packet's types."""
    pixels, columns, flat = lut.reshape(-1), np.uint32(lut.shape[1]), counts.reshape(-1)
    cells = counts.shape[1] * counts.shape[2]
    on, rows = np.uint32(cells), np.uint16(0x7FFF)
    by_row, by_column, width = np.uint32(scale.rows), np.uint32(scale.columns), np.uint32(scale.width)
    found, plane = np.empty(_BLOCK, np.uint32), np.empty(_BLOCK, np.uint32)
    outside, first = 0, 0
    for bin_ in range(counts.shape[0] // 2):
        stop = start + (bin_ + 1) * bin_us
        last, above = first, offset.size
        while last < above:
            middle = (last + above) // 2
            if np.int64(offset[middle]) < stop:
                last = middle + 1
            else:
                above = middle
        pair = flat[2 * bin_ * cells : (2 * bin_ + 2) * cells]
        for i in range(first, last, _BLOCK):
            m = min(_BLOCK, last - i)
            xs, ys = x[i : i + m], y_and_p[i : i + m]
            if width:
                for j in range(m):
                    y, p = np.uint16(ys[j] & rows), np.uint16(ys[j] >> np.uint16(15))
                    found[j] = scaled_cell(y, xs[j], p, by_row, by_column, width, on)
                add_events(found, m, pair)
                continue
            for j in range(m):
                found[j] = np.uint32(ys[j] & rows) * columns + np.uint32(xs[j])
                plane[j] = on * np.uint32(ys[j] >> np.uint16(15))
            for j in range(m):
                cell = pixels[found[j]]
                if cell < 0:
                    outside += 1
                    continue
                k = np.uint32(cell) + plane[j]
                pair[k] += np.uint8(pair[k] < 255)
        first = last
    return outside
