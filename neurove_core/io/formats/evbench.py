"""Reader of eventVision-evbench (Barranco 2016): .mat files of four columns, with ground truth in a text file."""

import re
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Final, Self

import numpy as np
from numpy.typing import NDArray

from neurove_core.geometry.motion import Twists
from neurove_core.io.checked import Piece, as_recorded, cleaned, numbered
from neurove_core.io.errors import UnknownSource
from neurove_core.io.faults import Faults, Reason, Tally
from neurove_core.io.format import Format
from neurove_core.io.formats.mat5 import MatFault, read_columns
from neurove_core.io.recording import EventsOnly, refuse_topic
from neurove_core.io.units import SAMPLE, TimeSample, scaled
from neurove_protocol.events import Events, Sensor

DAVIS240B = Sensor(240, 180)
"""The sensor of the recordings; they use 190 of its columns."""

COLUMNS: Final = ("ts", "x", "y", "pol")
MAX_COLUMN_BYTES: Final = 16 << 20
"""Largest column that is read: a packed one cannot be read in parts. A recording has some 300,000 events of 7 bytes."""

TRUTH: Final = "ground-truth_3Dcam.txt"
FRAME_S: Final = 0.05
"""Time unit of the rotations in the ground truth: "approx. 50 ms"."""


@dataclass(frozen=True, slots=True)
class EvbenchRecording(EventsOnly):
    """A .mat file of the columns ts [us], x, y, pol; see `Recording`.

    In the file y counts upwards, as in jAER and against the axes of the ground truth. The reader flips it to the
    image's y. The events confirm this: after the flip, their vertical flow has the sign of the true rotation about x.
    """

    path: Path
    sensor: Sensor
    streams: tuple[str, ...]
    endless: bool = False
    faults: Faults = field(default_factory=Faults, compare=False, repr=False)
    time_unit: str = "us"

    @classmethod
    def open(cls, path: Path, sensor: Sensor | None = None) -> Self:
        """Open the recording in this file.

        Args:
            path: the .mat file.
            sensor: the pixel array; by default that of a DAVIS240b.

        Raises:
            UnknownSource: the file is not a MATLAB 5 file with these four columns, or a column is too long.
        """
        columns = _columns(path)
        if len({column.size for column in columns.values()}) != 1 or set(columns) != set(COLUMNS):
            raise UnknownSource(path, f"it does not have the columns {', '.join(COLUMNS)} of the same length")
        truth = ("twists",) if _rotation(path) is not None else ()
        return cls(path, sensor or DAVIS240B, ("events", *truth))

    @property
    def name(self) -> str:
        """The file's name."""
        return self.path.name

    def chunks(self) -> Iterator[Events]:
        """All events from the beginning; see `Recording`. The whole file is read at once."""
        tally = self.faults.begin("events")
        pieces: Iterator[Piece] = iter([(numbered(0), self._events(tally))])
        return cleaned(pieces, self.sensor, tally)

    def time_sample(self) -> TimeSample | None:
        """Times of the first events, see `Timed`."""
        t = _columns(self.path)["ts"]
        return TimeSample(self.path, t[:SAMPLE], "us", t.size)

    def in_unit(self, unit: str) -> Self:
        """The same recording with times in another unit, see `Timed`."""
        return replace(self, time_unit=unit)

    def twists(self) -> Twists | None:
        """The truth in ground-truth_3Dcam.txt of the same folder, at the first and the last event; None without it.

        Only the rotation about x is given; the rest is nan. The other rotations contradict the events and the log of
        the pan-tilt unit, and the unit of the translation is not documented.
        """
        rotation = _rotation(self.path)
        if rotation is None:
            return None
        t = self._events(Tally("twists")).t
        twist = np.full((2, 6), np.nan)
        twist[:, 3] = rotation / FRAME_S
        return Twists(t[[0, -1]], twist) if t.size else None

    def _events(self, tally: Tally) -> Events:
        columns = _columns(self.path)
        t = np.rint(scaled(columns["ts"], self.time_unit)).astype(np.int64)
        x, y, p = (columns[name].astype(np.int64) for name in COLUMNS[1:])
        valid = (p == 0) | (p == 1)
        if not valid.all():
            first = int(valid.argmin())
            why = f"the polarity p={p[first]} is neither 1 nor 0"
            tally.add(Reason.INVALID, f"event {first}", why, int(np.count_nonzero(~valid)))
            t, x, y, p = (column[valid] for column in (t, x, y, p))
        return as_recorded(t, x, self.sensor.height - 1 - y, p)  # signed: `cleaned` names a negative number


def _columns(path: Path) -> dict[str, NDArray[Any]]:
    try:
        return read_columns(path, COLUMNS, MAX_COLUMN_BYTES)
    except MatFault as fault:
        raise UnknownSource(path, f"it cannot be read as a MATLAB 5 file: {fault}") from None


def _rotation(path: Path) -> float | None:
    """The rotation about x per frame [rad] of this file in the ground truth of its folder, or None."""
    truth = path.parent / TRUTH
    if not truth.is_file():
        return None
    text = truth.read_bytes()[: 64 << 10].decode("ascii", "replace")
    rotations = re.findall(r"rvec *= *(-?\d+\.\d+)", text)
    known = dict(zip(re.findall(r"seq_\d+", text), rotations, strict=False))
    sequence = re.match(r"seq_\d+", path.name)
    found = known.get(sequence.group()) if sequence else None
    return None if found is None else float(found)


def _open(path: Path, sensor: Sensor | None, topic: str | None) -> EvbenchRecording:
    refuse_topic(path, topic)
    return EvbenchRecording.open(path, sensor)


FORMAT = Format("FILE.mat (eventVision-evbench)", _open, (".mat",))
