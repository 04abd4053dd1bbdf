"""Make valid chunks of the events that a reader decodes, and count what is not valid."""

from collections.abc import Iterator
from typing import Any, TypeVar, cast

import numpy as np

from neurove_core.geometry.motion import Poses, Twists
from neurove_core.io.errors import BrokenRecording
from neurove_core.io.faults import Reason, Tally
from neurove_core.io.order import Order, T, Where
from neurove_core.io.recording import CHUNK_EVENTS, Recording, in_chunks
from neurove_protocol.errors import InvalidField
from neurove_protocol.events import Events, Sensor
from neurove_protocol.imu import Imu

V = TypeVar("V")

_MIN_EVENTS = CHUNK_EVENTS // 4

Piece = tuple[str | Where, Events]
"""Some events as they were recorded, and their place: a text, or a function that gives the place of event i.

The columns of these events may have any integer type, see `as_recorded`.
"""


def numbered(first: int, noun: str = "event") -> Where:
    """The place of item i of a piece that begins with item number `first` of the recording, counted from 0."""
    return lambda i: f"{noun} {first + i:,}"


def as_recorded(t: Any, x: Any, y: Any, p: Any) -> Events:
    """Events with columns of any integer type, so that a coordinate that does not fit is not wrapped; for `cleaned`."""
    return Events(t, x, y, p)


def cleaned(pieces: Iterator[Piece], sensor: Sensor, tally: Tally, note: str = "") -> Iterator[Events]:
    """Valid events of all pieces, ordered by time, in chunks that are neither empty nor very small.

    Events outside the sensor and late events are left out, see `Order`; `tally` counts them. An error that ends the
    pieces ends the chunks too: it is counted as `UNREAD` and not raised, and all events before it are given.

    Args:
        pieces: what the reader decoded, in recorded order. A piece may be empty.
        sensor: the pixel array.
        tally: of this pass.
        note: on the sensor; ends the text for an event outside it.
    """
    order: Order[Events] = Order(tally)
    for batch in _batches(pieces, tally):
        events = _joined(batch)
        if events is not None and _inside(events, sensor).all() and order.is_plain(events):
            order.passed(events)
            yield from in_chunks(_typed(events))
            continue
        parts = [part for where, piece in batch for part in order.push(*_on_sensor(where, piece, sensor, tally, note))]
        yield from in_chunks(_typed(Events.join(parts)))
    yield from in_chunks(_typed(Events.join(list(order.finish()))))


def ordered(pieces: Iterator[tuple[str | Where, T]], tally: Tally) -> Iterator[T]:
    """The samples of all pieces ordered by time, in batches that are not empty; for streams other than the events.

    What is late is left out and counted, and so are inertial samples that are not finite, and everything after a
    restart of the clock; see `Order`. An error that ends the pieces is counted as `UNREAD` and not raised.

    Args:
        pieces: for each its place, as in `cleaned`, and its samples.
        tally: of this pass.
    """
    order: Order[T] = Order(tally, restart=False)
    try:
        for where, rows in pieces:
            place = _where(where)
            if isinstance(rows, Imu):
                kept, place = _finite(rows, place, tally)
                yield from order.push(cast("T", kept), place)
            else:
                yield from order.push(rows, place)
    except BrokenRecording as error:
        unread(tally, error)
    yield from order.finish()


def _finite(imu: Imu, where: Where, tally: Tally) -> tuple[Imu, Where]:
    """The samples that are finite, and their places."""
    finite = np.isfinite(imu.accel_m_s2).all(axis=1) & np.isfinite(imu.gyro_rad_s).all(axis=1)
    if finite.all():
        return imu, where
    kept, first = np.flatnonzero(finite), int(finite.argmin())
    tally.add(Reason.INVALID, where(first), "the sample is not finite", finite.size - kept.size)
    return Imu(imu.t[kept], imu.accel_m_s2[kept], imu.gyro_rad_s[kept]), lambda i: where(int(kept[i]))


def truth(recording: Recording) -> tuple[Poses | None, Twists | None]:
    """Poses and twists of a recording; None for one that cannot be read or is not valid, which is counted."""
    found: list[Any] = []
    for kind, read in (("poses", recording.poses), ("twists", recording.twists)):
        try:
            found.append(read())
        except BrokenRecording as error:
            unread(recording.faults.of(kind), error)
            found.append(None)
        except InvalidField as error:
            recording.faults.of(kind).add(Reason.UNREAD, kind, error.message)
            found.append(None)
    return found[0], found[1]


def until_broken(items: Iterator[V], tally: Tally) -> Iterator[V]:
    """The same items, for example images. An error that ends them is counted as `UNREAD` and not raised."""
    try:
        yield from items
    except BrokenRecording as error:
        unread(tally, error)


def unread(tally: Tally, error: BrokenRecording) -> None:
    """Count an error that ends the reading of a stream."""
    tally.add(Reason.UNREAD, error.where, error.why)


def _batches(pieces: Iterator[Piece], tally: Tally) -> Iterator[list[Piece]]:
    """Batches of at least _MIN_EVENTS events, except the last."""
    batch: list[Piece] = []
    n = 0
    try:
        for piece in pieces:
            batch.append(piece)
            n += piece[1].n
            if n >= _MIN_EVENTS:
                yield batch
                batch, n = [], 0
    except BrokenRecording as error:
        unread(tally, error)
    if batch:
        yield batch


def _joined(batch: list[Piece]) -> Events | None:
    return Events.join([piece for _, piece in batch]) if batch else None


def _inside(events: Events, sensor: Sensor) -> np.ndarray[tuple[int], np.dtype[np.bool_]]:
    """Which events lie on the sensor."""
    x, y = events.x, events.y
    inside = (x < sensor.width) & (y < sensor.height)
    for column in (x, y):
        if column.dtype.kind != "u":
            inside &= column >= 0
    return inside


def _on_sensor(where: str | Where, events: Events, sensor: Sensor, tally: Tally, note: str) -> tuple[Events, Where]:
    """The events on the sensor, and their places."""
    place, inside = _where(where), _inside(events, sensor)
    if inside.all():
        return events, place
    kept, outside = np.flatnonzero(inside), np.flatnonzero(~inside)
    first = int(outside[0])
    why = f"x={events.x[first]} y={events.y[first]} lies outside the sensor {sensor}{note}"
    tally.add(Reason.OUTSIDE, place(first), why, outside.size)
    return Events(events.t[kept], events.x[kept], events.y[kept], events.p[kept]), lambda i: place(int(kept[i]))


def _where(where: str | Where) -> Where:
    return (lambda _: where) if isinstance(where, str) else where


def _typed(events: Events) -> Events:
    return Events.from_columns(*events)
