"""Event Stream files (.es, version 2): a header, then events of five bytes and bytes that only advance the clock."""

from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final, Self

import numpy as np
from numpy.typing import NDArray

from neurove_core.compiled import compiled
from neurove_core.io.checked import Piece, as_recorded, cleaned, numbered
from neurove_core.io.errors import BrokenRecording, MissingGeometry, UnknownSource
from neurove_core.io.faults import Faults
from neurove_core.io.format import Format
from neurove_core.io.recording import BLOCK_BYTES, CHUNK_EVENTS, EventsOnly, empty_events, refuse_topic
from neurove_protocol.errors import InvalidField
from neurove_protocol.events import Events, Sensor

_MAGIC = b"Event Stream"
_HEADER_BYTES = 20
_TYPES = {0: "generic", 1: "DVS", 2: "ATIS", 3: "display", 4: "color"}
DVS, ATIS = 1, 2
EVENT_BYTES: Final = 5


@dataclass(frozen=True, slots=True)
class EventStreamRecording(EventsOnly):
    """An .es file of DVS or ATIS events; see `Recording`. Exposure measurements of ATIS are skipped.

    In the format y counts upwards: its own converters flip the y of a Prophesee camera, which counts downwards. This
    reader flips y to image coordinates.

    Source: github.com/neuromorphic-paris/event_stream, version 2.0.
    """

    path: Path
    sensor: Sensor
    kind: int
    endless: bool = False
    faults: Faults = field(default_factory=Faults, compare=False, repr=False)

    @classmethod
    def open(cls, path: Path, sensor: Sensor | None = None) -> Self:
        """Open the recording in this file.

        Args:
            path: the .es file.
            sensor: its pixel array, which takes precedence over the header.

        Raises:
            UnknownSource: the file is not of version 2, or its events are of another type.
            MissingGeometry: the header has no valid sensor size.
            BrokenRecording: the file ends within its header.
        """
        with path.open("rb") as file:
            header = file.read(_HEADER_BYTES)
        if not header.startswith(_MAGIC[: len(header)]):
            raise UnknownSource(path, "the file does not begin with the Event Stream signature")
        if len(header) < _HEADER_BYTES:
            raise BrokenRecording(path, f"byte {len(header)}", "the file ends within its header")
        major, minor, _, kind = header[12:16]
        if major != 2:
            raise UnknownSource(path, f"it is Event Stream {major}.{minor}; the supported version is 2")
        if kind not in (DVS, ATIS):
            raise UnknownSource(path, f"its events are of type {kind} ({_TYPES.get(kind, 'unknown')})")
        try:
            width, height = np.frombuffer(header, "<u2", 2, 16).tolist()
            return cls(path, sensor or Sensor(width, height), kind)
        except InvalidField:
            raise MissingGeometry(path) from None

    @property
    def name(self) -> str:
        """The file's name."""
        return self.path.name

    def chunks(self) -> Iterator[Events]:
        """All events from the beginning; see `Recording`. Times [us] start at 0 at the start of the recording."""
        return cleaned(self._pieces(), self.sensor, self.faults.begin("events"))

    def _pieces(self) -> Iterator[Piece]:
        at, t_us, number, pending = _HEADER_BYTES, 0, 0, b""
        with self.path.open("rb") as file:
            file.seek(at)
            while block := file.read(BLOCK_BYTES):
                data = np.frombuffer(pending + block, np.uint8)
                while True:
                    out = empty_events(CHUNK_EVENTS)
                    t_us, read, n = es_decode(data, t_us, self.kind, out)
                    yield numbered(number), self._flipped(out.span(0, n))
                    at, number, data = at + read, number + n, data[read:]
                    if n < CHUNK_EVENTS:
                        break
                pending = data.tobytes()
        if pending:
            raise BrokenRecording(self.path, f"byte {at}", "the file ends within an event")

    def _flipped(self, events: Events) -> Events:
        """The events with y downwards. A y outside the sensor becomes negative."""
        return as_recorded(
            events.t, events.x, self.sensor.height - 1 - events.y.astype(np.int32), events.p
        )  # signed: `cleaned` names a negative number


@compiled
def es_decode(
    data: NDArray[np.uint8], t_us: int, kind: int, out: Events
) -> tuple[int, int, int]:  # pragma: no cover (machine code)
    """Decode bytes until an event is truncated or `out` is full.

    Args:
        data: (N,) bytes, starting with the first byte of an event.
        t_us: time before these bytes [us].
        kind: DVS or ATIS.
        out: columns of equal length for the events, with y as in the file. They may lie outside the sensor.

    Returns:
        The time after the bytes read [us], the number of bytes read, and the number of events in `out`.
    """
    t_out, x_out, y_out, p_out = out
    shift, longest = (1, 127) if kind == DVS else (2, 63)  # `longest`: largest step of an overflow byte [us]
    n, i = 0, 0
    while i < data.size and n < t_out.size:
        first = np.int64(data[i])
        if first >> shift == longest:
            t_us += longest * int(first & 1 if kind == DVS else first & 3)  # 0: a reset, the clock does not advance
            i += 1
            continue
        if i + EVENT_BYTES > data.size:
            break
        x = np.int64(data[i + 1]) | np.int64(data[i + 2]) << 8
        y = np.int64(data[i + 3]) | np.int64(data[i + 4]) << 8
        if kind == DVS or not first & 1:
            t_out[n], x_out[n], y_out[n] = t_us + (first >> shift), x, y
            p_out[n] = first & 1 if kind == DVS else (first >> 1) & 1
            n += 1
        t_us += int(first >> shift)
        i += EVENT_BYTES
    return t_us, i, n


def es_reference(data: NDArray[np.uint8], t_us: int, kind: int) -> tuple[int, int, Events]:
    """Reference implementation of `es_decode` without a limit on events: time, bytes read, events."""
    rows: list[tuple[int, int, int, int]] = []
    at = 0
    left = data.tobytes()
    while left:
        first = left[0]
        overflow = {254: 0, 255: 127} if kind == DVS else {252: 0, 253: 63, 254: 126, 255: 189}
        if first in overflow:
            t_us, at, left = t_us + overflow[first], at + 1, left[1:]
            continue
        if len(left) < EVENT_BYTES:
            break
        x, y = int.from_bytes(left[1:3], "little"), int.from_bytes(left[3:5], "little")
        step, change, p = (first >> 1, True, first & 1) if kind == DVS else (first >> 2, not first & 1, first >> 1 & 1)
        t_us, at, left = t_us + step, at + EVENT_BYTES, left[EVENT_BYTES:]
        if change:
            rows.append((t_us, x, y, p))
    return t_us, at, Events.from_columns(*(zip(*rows, strict=True) if rows else [()] * 4))


def _open(path: Path, sensor: Sensor | None, topic: str | None) -> EventStreamRecording:
    refuse_topic(path, topic)
    return EventStreamRecording.open(path, sensor)


FORMAT = Format("FILE.es (Event Stream)", _open, (".es",), signature=b"Event Stream")
