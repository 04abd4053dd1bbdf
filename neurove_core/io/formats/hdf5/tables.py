"""Readers of event and IMU tables in HDF5: they check every row, read bounded blocks, and start at any time."""

from abc import abstractmethod
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from neurove_core.geometry.motion import Twists, twists
from neurove_core.io.checked import Piece, as_recorded, cleaned, ordered
from neurove_core.io.errors import BrokenRecording, UnknownSource
from neurove_core.io.faults import Faults, Reason, Tally
from neurove_core.io.formats.hdf5.file import FAULTS, Column, check_ratio, opened, read_rows
from neurove_core.io.order import Where
from neurove_core.io.recording import CHUNK_EVENTS, EventsOnly, Recording, later
from neurove_core.io.units import SAMPLE, UNITS, TimeSample, scaled
from neurove_protocol.events import Events, Sensor
from neurove_protocol.imu import Imu

_MAX_T_US, _MAX_XY = 1 << 62, 1 << 40


class EventTable(NamedTuple):
    """Where the events of a file are and how to decode them."""

    name: str  # of the group or data set, for messages
    columns: tuple[Any, ...]  # data sets, one row per event
    txyp: Callable[..., tuple[Column, Column, Column, Column]]  # rows of the columns -> t [us], x, y, p of any type
    offset_us: int = 0  # added to the times
    unit: str = "us"  # of the times in the file

    def in_unit(self, unit: str) -> "EventTable":
        """The same table with the times of the file, and the offset, read in another unit."""

        def txyp(*rows: Column) -> tuple[Column, Column, Column, Column]:
            t, x, y, p = self.txyp(*rows)
            return scaled(t, unit, self.unit), x, y, p

        offset_us = round(self.offset_us * UNITS[unit] / UNITS[self.unit])
        return self._replace(txyp=txyp, offset_us=offset_us, unit=unit)

    @property
    def n(self) -> int:
        """Number of rows that every column has."""
        return min(int(column.shape[0]) for column in self.columns)

    def times(self, first: int, stop: int) -> Column:
        """Times [us] of these rows on the sensor's clock, not checked.

        Raises:
            Any of FAULTS: the rows cannot be read.
        """
        with np.errstate(all="ignore"):
            t = self.txyp(*(column[first:stop] for column in self.columns))[0]
        return np.asarray(t.astype(np.float64) + self.offset_us)


def event_pieces(path: Path, table: EventTable, tally: Tally, first: int = 0) -> Iterator[Piece]:
    """Events from row `first` on, for `cleaned`. Rows that are not events, or cannot be read, are skipped."""
    for at, rows in row_blocks(path, table.name, table.columns, tally, CHUNK_EVENTS, first):
        with np.errstate(all="ignore"):  # nan, inf and overflow, which are counted
            yield _decoded(table, rows, at, tally)


def row_blocks(
    path: Path, name: str, columns: Sequence[Any], tally: Tally, size: int, first: int = 0
) -> Iterator[tuple[int, list[Column]]]:
    """Blocks of up to `size` rows of all columns, each with its first row, from row `first` on.

    A part that cannot be read is skipped up to the next stored chunk, and counted.

    Raises:
        BrokenRecording: the columns differ in length, or nothing can be read from a row on. It is raised at the end.
    """
    check_ratio(path, columns)
    lengths = [int(column.shape[0]) for column in columns]
    n, at = min(lengths), first
    while at < n:
        rows, unread = read_rows(columns, at, min(at + size, n))
        if len(rows[0]):
            yield at, rows
        at += len(rows[0])
        if unread:
            chunked = [column.chunks[0] for column in columns if column.chunks]
            after = min(((at // rows_each + 1) * rows_each for rows_each in chunked), default=n)
            if after >= n:
                raise BrokenRecording(path, f"row {at} of {name}", unread)
            tally.add(Reason.DAMAGED, f"row {at} of {name}", unread, after - at)
            at = after
    if max(lengths) > n:
        raise BrokenRecording(path, f"row {n} of {name}", f"its columns have unequal lengths: {lengths}")


def _decoded(table: EventTable, rows: list[Column], first: int, tally: Tally) -> Piece:
    """The events of some rows, as recorded. A polarity above 0 is ON; 0 or -1 is OFF."""
    t, x, y, p = table.txyp(*rows)
    checks = (
        (t, (t > -_MAX_T_US) & (t < _MAX_T_US), "t={:g} is not a valid time"),
        (x, np.abs(x) < _MAX_XY, "x={:g} is not a column"),
        (y, np.abs(y) < _MAX_XY, "y={:g} is not a row"),
        (p, (p == 0) | (p == 1) | (p == -1), "the polarity p={:g} is neither 1 nor 0 nor -1"),
    )
    kept = np.ones(t.size, np.bool_)
    for values, valid, why in checks:
        bad = np.flatnonzero(kept & ~valid)
        if bad.size:
            tally.add(Reason.INVALID, f"row {first + bad[0]} of {table.name}", why.format(values[bad[0]]), bad.size)
            kept &= valid
    index = np.flatnonzero(kept)
    t, x, y, p = (column if kept.all() else column[index] for column in (t, x, y, p))
    t_us = (np.rint(t) if t.dtype.kind == "f" else t).astype(np.int64) + table.offset_us
    x, y = (np.floor(column).astype(np.int64) if column.dtype.kind == "f" else column for column in (x, y))
    return lambda i: f"row {first + int(index[i])} of {table.name}", as_recorded(t_us, x, y, p > 0)


def row_indexed(table: EventTable, index: Any, t_us: int) -> int:
    """A row before the events from a time on, by an index of the first event at or after each millisecond of the table.

    It is 0 if the index does not match the events: then all events are read.
    """
    ms = min(max((t_us - table.offset_us) // 1000, 0), int(index.shape[0]) - 1)
    try:
        entry = int(index[ms]) if ms >= 0 else 0
        around = table.times(max(entry - 1, 0), entry + 1)
        found = 0 < entry < table.n and around[0] < ms * 1000 + table.offset_us <= around[1]
    except (*FAULTS, IndexError):
        return 0
    return entry if found else 0


def row_ordered(table: EventTable, t_us: int) -> int:
    """A row before the events from a time on, by bisection of the times in the file; 0 if they cannot be read."""
    first, last = 0, table.n
    try:
        while first < last:
            middle = (first + last) // 2
            if float(table.times(middle, middle + 1)[0]) < t_us - 1:  # a float's time may be rounded up to a whole us
                first = middle + 1
            else:
                last = middle
    except FAULTS:
        return 0
    return first


class ImuTable(NamedTuple):
    """Where the IMU samples of a file are and how to decode them."""

    name: str
    columns: tuple[Any, ...]  # data sets, one row per sample
    decode: Callable[..., tuple[Column, Column, Column]]  # rows -> t [us], accel (N, 3) [m/s2], gyro (N, 3) [rad/s]
    rotation: NDArray[np.float64]  # (3, 3) from the IMU's axes to the camera's
    may_miss: bool = False  # the table has nan for samples that were never taken; they are skipped


def imu_pieces(path: Path, table: ImuTable, tally: Tally) -> Iterator[tuple[Where, Imu]]:
    """All samples that are finite, in the camera's optical frame; the others are counted."""
    for at, rows in row_blocks(path, table.name, table.columns, tally, CHUNK_EVENTS // 8):
        with np.errstate(all="ignore"):
            t, accel, gyro = table.decode(*rows)
            known = np.asarray(np.isfinite(accel).all(axis=1) & np.isfinite(gyro).all(axis=1))
            in_time = (t > -_MAX_T_US) & (t < _MAX_T_US)
        bad = np.flatnonzero(~in_time if table.may_miss else ~(known & in_time))
        if bad.size:
            tally.add(Reason.INVALID, f"row {at + bad[0]} of {table.name}", "the sample is not finite", bad.size)
        keep = np.flatnonzero(known & in_time)
        t_us = (np.rint(t[keep]) if t.dtype.kind == "f" else t[keep]).astype(np.int64)
        yield _row_of(table.name, at, keep), Imu(t_us, accel[keep] @ table.rotation.T, gyro[keep] @ table.rotation.T)


def _row_of(name: str, first: int, index: NDArray[np.intp]) -> Where:
    return lambda i: f"row {first + int(index[i])} of {name}"


@dataclass(frozen=True, slots=True)
class TableRecording(EventsOnly):
    """One event stream of an HDF5 file; see `Recording`. Each layout gives the place of its tables."""

    path: Path
    name: str
    sensor: Sensor
    topic: str  # the group of the file that holds the stream
    held: tuple[str, ...]  # the value of `streams`
    endless: bool = False
    faults: Faults = field(default_factory=Faults, compare=False, repr=False)
    time_unit: str | None = None  # of the times of the events in the file; None: that of the layout

    def time_sample(self) -> TimeSample | None:
        """Times of the first events, see `Timed`."""
        with opened(self.path) as file:
            try:
                table = self.event_table(file)
                with np.errstate(all="ignore"):
                    t, *_ = table.txyp(*(column[:SAMPLE] for column in table.columns))
            except (*FAULTS, BrokenRecording):  # reading the events reports it
                return None
            times = t if table.unit == "us" else t / UNITS[table.unit]
            return TimeSample(self.path, times, table.unit, table.n)

    def in_unit(self, unit: str) -> Recording:
        """The same recording with the times of its events in another unit, see `Timed`."""
        return replace(self, time_unit=unit)

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
        """All events from the beginning; see `Recording`."""
        return self._cleaned(None)

    def since(self, t_us: int) -> Iterator[Events]:
        """As `chunks`, from this time on; see `first_row`. Earlier events are not read."""
        return later(self._cleaned(t_us), t_us)

    @property
    def sensor_note(self) -> str:
        """What to add to the text for an event outside the sensor."""
        return ""

    def first_row(self, file: Any, table: EventTable, t_us: int) -> int:
        """A row of the opened file before the events from a time on, found by bisection of the times."""
        return row_ordered(table, t_us)

    def _cleaned(self, t_us: int | None) -> Iterator[Events]:
        tally = self.faults.begin("events")
        return cleaned(self._pieces(t_us, tally), self.sensor, tally, self.sensor_note)

    def _pieces(self, t_us: int | None, tally: Tally) -> Iterator[Piece]:
        with opened(self.path) as file:
            table = self.event_table(file)
            table = table.in_unit(self.time_unit) if self.time_unit is not None else table
            first = 0 if t_us is None else self.first_row(file, table, t_us)
            yield from event_pieces(self.path, table, tally, first)

    def imu(self) -> Iterator[Imu]:
        """All samples, in the camera's optical frame; see `Recording`."""
        tally = self.faults.begin("imu")
        return ordered(self._imu_pieces(tally), tally)

    def _imu_pieces(self, tally: Tally) -> Iterator[tuple[Where, Imu]]:
        with opened(self.path) as file:
            table = self.imu_table(file)
            if table is not None:
                yield from imu_pieces(self.path, table, tally)

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
