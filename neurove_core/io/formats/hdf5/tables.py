"""Readers of event and IMU tables in HDF5: they check every row, read bounded blocks, and start at any time."""

from abc import abstractmethod
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from neurove_core.geometry.motion import Twists, twists
from neurove_core.io.errors import BrokenRecording, UnknownSource
from neurove_core.io.formats.hdf5.file import FAULTS, Column, opened, read_rows
from neurove_core.io.recording import CHUNK_EVENTS, EventsOnly, Imu, later
from neurove_protocol.events import Events, Sensor

_MAX_T_US = 1 << 62


class EventTable(NamedTuple):
    """Where the events of a file are and how to decode them."""

    name: str  # of the group or data set, for messages
    columns: tuple[Any, ...]  # data sets, one row per event
    txyp: Callable[..., tuple[Column, Column, Column, Column]]  # rows of the columns -> t [us], x, y, p of any type
    offset_us: int = 0  # added to the times
    note: str = ""  # on the sensor; ends the error text of an event outside it

    @property
    def n(self) -> int:
        """Number of rows that every column has."""
        return min(int(column.shape[0]) for column in self.columns)

    def times(self, first: int, stop: int) -> Column:
        """Times [us] of these rows on the sensor's clock, not checked.

        Raises:
            Any of FAULTS: the rows cannot be read.
        """
        t = self.txyp(*(column[first:stop] for column in self.columns))[0]
        return np.asarray(t.astype(np.float64) + self.offset_us)


def event_chunks(path: Path, table: EventTable, sensor: Sensor, first: int = 0) -> Iterator[Events]:
    """Events from row `first` on; see `Recording.chunks`.

    Raises:
        BrokenRecording: a row cannot be read, its event is outside the sensor, has an invalid polarity or is before the
            previous event, or the columns differ in length. The error names the row.
    """
    n, not_before_us = table.n, None
    for at in range(first, n, CHUNK_EVENTS):
        rows, unread = read_rows(table.columns, at, min(at + CHUNK_EVENTS, n))
        with np.errstate(all="ignore"):  # nan, inf and overflow, which are reported below
            events, bad = valid_prefix(table, rows, sensor, not_before_us)
        if events.n:
            not_before_us = int(events.t[-1])
            yield events
        if bad or unread:
            raise BrokenRecording(path, f"row {at + events.n} of {table.name}", bad or unread)
    lengths = [int(column.shape[0]) for column in table.columns]
    if max(lengths) > n:
        raise BrokenRecording(path, f"row {n} of {table.name}", f"its columns have unequal lengths: {lengths}")


def valid_prefix(
    table: EventTable, rows: list[Column], sensor: Sensor, not_before_us: int | None
) -> tuple[Events, str]:
    """The events before the first invalid one, and what is wrong with that one.

    A polarity above 0 is ON; 0 or -1 is OFF.

    Args:
        table: the table of the rows.
        rows: rows of its columns, of any number type.
        sensor: the pixel array.
        not_before_us: the time of the previous event, if there is one.
    """
    t, x, y, p = table.txyp(*rows)
    in_time = (t > -_MAX_T_US) & (t < _MAX_T_US)
    t_us = np.where(in_time, np.rint(t) if t.dtype.kind == "f" else t, 0).astype(np.int64) + table.offset_us
    inside = (x >= 0) & (x < sensor.width) & (y >= 0) & (y < sensor.height)
    before = np.concatenate([[t_us[0] if not_before_us is None else not_before_us], t_us[:-1]]) if t.size else t_us
    good = in_time & inside & ((p == 0) | (p == 1) | (p == -1)) & (t_us >= before)
    n = t.size if good.all() else int(good.argmin())
    events = Events.from_columns(t_us[:n], x[:n], y[:n], p[:n] > 0)
    if n == t.size:
        return events, ""
    if not in_time[n]:
        return events, f"t={t[n]:g} is not a valid time"
    if not inside[n]:
        return events, f"an event at x={x[n]:g} y={y[n]:g} lies outside the sensor {sensor}{table.note}"
    if t_us[n] < before[n]:
        return events, f"t={t_us[n]} us comes after t={before[n]} us: time runs backwards"
    return events, f"the polarity p={p[n]:g} is neither 1 nor 0 nor -1"


def seek_indexed(path: Path, table: EventTable, sensor: Sensor, index: Any, t_us: int) -> Iterator[Events]:
    """Events from a time on, by an index of the first event at or after each millisecond of the table's own times.

    An index that does not match the events is ignored: then all events are read.
    """
    ms = min(max((t_us - table.offset_us) // 1000, 0), int(index.shape[0]) - 1)
    first = 0
    try:
        entry = int(index[ms]) if ms >= 0 else 0
        around = table.times(max(entry - 1, 0), entry + 1)
        if 0 < entry < table.n and around[0] < ms * 1000 + table.offset_us <= around[1]:
            first = entry
    except (*FAULTS, IndexError):
        first = 0
    yield from later(event_chunks(path, table, sensor, first), t_us)


def seek_ordered(path: Path, table: EventTable, sensor: Sensor, t_us: int) -> Iterator[Events]:
    """Events from a time on, found by bisection of the times in the file."""
    first, last = 0, table.n
    try:
        while first < last:
            middle = (first + last) // 2
            if float(table.times(middle, middle + 1)[0]) < t_us - 1:  # a float's time may be rounded up to a whole us
                first = middle + 1
            else:
                last = middle
    except FAULTS:
        first = 0
    yield from later(event_chunks(path, table, sensor, first), t_us)


class ImuTable(NamedTuple):
    """Where the IMU samples of a file are and how to decode them."""

    name: str
    columns: tuple[Any, ...]  # data sets, one row per sample
    decode: Callable[..., tuple[Column, Column, Column]]  # rows -> t [us], accel (N, 3) [m/s2], gyro (N, 3) [rad/s]
    rotation: NDArray[np.float64]  # (3, 3) from the IMU's axes to the camera's
    may_miss: bool = False  # the table has nan for samples that were never taken; they are skipped


def imu_blocks(path: Path, table: ImuTable) -> Iterator[Imu]:
    """All samples, in the camera's optical frame.

    Raises:
        BrokenRecording: a row cannot be read, is not finite or is before the previous row; the error names the row.
    """
    n, not_before_us, step = min(int(column.shape[0]) for column in table.columns), -_MAX_T_US, CHUNK_EVENTS // 8
    for at in range(0, n, step):
        rows, unread = read_rows(table.columns, at, min(at + step, n))
        with np.errstate(all="ignore"):
            t, accel, gyro = table.decode(*rows)
            known = np.asarray(np.isfinite(accel).all(axis=1) & np.isfinite(gyro).all(axis=1))
            index = np.flatnonzero(known) if table.may_miss else np.arange(t.size)
            t_us = np.where((t > -_MAX_T_US) & (t < _MAX_T_US), t, -_MAX_T_US)[index]
            t_us = (np.rint(t_us) if t.dtype.kind == "f" else t_us).astype(np.int64)
        good = known[index] & (t_us > -_MAX_T_US) & (np.diff(t_us, prepend=not_before_us) >= 0)
        valid = index.size if good.all() else int(good.argmin())
        keep = index[:valid]
        if valid:
            not_before_us = int(t_us[valid - 1])
            yield Imu(t_us[:valid], accel[keep] @ table.rotation.T, gyro[keep] @ table.rotation.T)
        if valid < index.size:
            why = "the sample is not finite, or is before the previous sample"
            raise BrokenRecording(path, f"row {at + index[valid]} of {table.name}", why)
        if unread:
            raise BrokenRecording(path, f"row {at + t.size} of {table.name}", unread)


@dataclass(frozen=True, slots=True)
class TableRecording(EventsOnly):
    """One event stream of an HDF5 file; see `Recording`. Each layout gives the place of its tables."""

    path: Path
    name: str
    sensor: Sensor
    topic: str  # the group of the file that holds the stream
    held: tuple[str, ...]  # the value of `streams`
    endless: bool = False

    @property
    def streams(self) -> tuple[str, ...]:
        """The streams that the file has."""
        return self.held

    @abstractmethod
    def event_table(self, file: Any) -> EventTable:
        """The event table of the opened file."""

    def imu_table(self, file: Any) -> ImuTable | None:
        """The IMU table of the opened file, or None without one."""
        return None

    def chunks(self) -> Iterator[Events]:
        """All events from the beginning; see `Recording`.

        Raises:
            BrokenRecording: a row cannot be read or is not an event of this sensor; the error names the row.
        """
        with opened(self.path) as file:
            yield from event_chunks(self.path, self.event_table(file), self.sensor)

    def since(self, t_us: int) -> Iterator[Events]:
        """As `chunks`, from this time on, found by bisection of the times; earlier events are not read."""
        with opened(self.path) as file:
            yield from seek_ordered(self.path, self.event_table(file), self.sensor, t_us)

    def imu(self) -> Iterator[Imu]:
        """All samples, in the camera's optical frame; see `Recording`.

        Raises:
            BrokenRecording: a row cannot be read, is not finite or is before the previous row.
        """
        with opened(self.path) as file:
            table = self.imu_table(file)
            if table is not None:
                yield from imu_blocks(self.path, table)

    def twists(self) -> Twists | None:
        """Twists from the poses, by `geometry.twists` with its filter; None without poses."""
        poses = self.poses()
        return poses and twists(poses)


def chosen_topic(path: Path, topics: tuple[str, ...], topic: str | None) -> str:
    """The event stream to read: the requested one, or the first.

    Raises:
        UnknownSource: the file has no such stream, or none at all; the error lists the existing ones.
    """
    wanted = topic.strip("/") if topic is not None else next(iter(topics), "")
    if wanted not in topics:
        raise UnknownSource(path, f"it has no event stream {wanted!r}; it has {', '.join(topics) or 'none'}")
    return wanted
