"""Event Camera Dataset (Mueggler 2017): events as text lines `t[s] x y p`, and the lens as nine numbers."""

from bisect import bisect_left
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Self

import numpy as np

from neurove_core.io.errors import BrokenRecording
from neurove_core.io.recording import BLOCK_BYTES, EventsOnly, in_chunks
from protocol.camera import CameraInfo
from protocol.errors import EventOutsideSensor, InvalidField, TimeBackwards
from protocol.events import Events, Sensor, check_events

DAVIS240C = Sensor(240, 180)
"""What the data set was recorded with."""

MAX_T_S = 1e12  # [s]; beyond it a time is no time
_BAD = (ValueError, EventOutsideSensor, TimeBackwards)
_LINE = np.dtype([("t", "f8"), ("x", "u2"), ("y", "u2"), ("p", "u1")])
_CALIB = "nine numbers are expected: fx fy cx cy k1 k2 p1 p2 k3, focal lengths above 0"


@dataclass(frozen=True, slots=True)
class EcdRecording(EventsOnly):
    """A text file of events, with the calib.txt beside it where there is one; see `Recording`."""

    path: Path
    name: str
    sensor: Sensor
    lens: CameraInfo | None
    endless: bool = False

    @classmethod
    def open(cls, path: Path, name: str, sensor: Sensor | None = None) -> Self:
        """The recording in this file.

        Args:
            path: the file of events.
            name: what to call it.
            sensor: the pixel array; by default a DAVIS240C's.

        Raises:
            OSError: the file can not be opened. InvalidField: the calib.txt beside it does not hold what it must.
        """
        path.open("rb").close()  # what can not be opened is told now
        sensor = sensor or DAVIS240C
        calib = path.parent / "calib.txt"
        return cls(path, name, sensor, read_calib(calib, sensor) if calib.is_file() else None)

    def camera(self, stream: str) -> CameraInfo | None:
        """The lens of calib.txt, or None without one."""
        return self.lens and CameraInfo(**(self.lens.model_dump() | {"stream": stream}))

    def chunks(self) -> Iterator[Events]:
        """All events from the beginning; see `Recording`. Times are those of the file, to the nearest us.

        Raises:
            BrokenRecording: a line is no event, or one outside the sensor or earlier than the one before; it names the
                line.
        """
        first, not_before_us = 1, None
        for lines in self._blocks():
            whole, why = len(lines), ""
            try:
                events = _parse(lines, self.sensor, not_before_us)
            except _BAD:
                whole, why = _first_bad(lines, self.sensor, not_before_us)
                events = _parse(lines[:whole], self.sensor, not_before_us)
            yield from in_chunks(events)
            if why:
                text = lines[whole][:60].decode("ascii", "backslashreplace")
                raise BrokenRecording(self.path, f"line {first + whole}", f"{why}: {text!r}")
            first += len(lines)
            not_before_us = int(events.t[-1]) if events.n else not_before_us

    def _blocks(self) -> Iterator[list[bytes]]:
        """The file's lines, some BLOCK_BYTES at a time."""
        rest = b""
        with self.path.open("rb") as file:
            while block := file.read(BLOCK_BYTES):
                whole, newline, rest = (rest + block).rpartition(b"\n")
                if newline:
                    yield whole.split(b"\n")
                elif len(rest) > BLOCK_BYTES:  # no text at all: let it fail as the line that it is
                    break
        if rest:
            yield [rest]


def read_calib(path: Path, sensor: Sensor) -> CameraInfo:
    """The lens that a calib.txt describes: `fx fy cx cy k1 k2 p1 p2 k3` [px, dimensionless].

    Raises:
        InvalidField: these are not nine fitting numbers; it names the file.
    """
    text = path.read_bytes()[:1024].decode("ascii", "backslashreplace").strip()
    try:
        fx, fy, cx, cy, *distortion = (float(number) for number in text.split())
        if len(distortion) != 5:
            raise ValueError(f"{4 + len(distortion)} numbers")
        return CameraInfo(
            stream="recording",
            width=sensor.width,
            height=sensor.height,
            lens="pinhole",
            fx=fx,
            fy=fy,
            cx=cx,
            cy=cy,
            distortion=tuple(distortion),
        )
    except ValueError:  # pydantic's is one too
        raise InvalidField(str(path), "calib", text, _CALIB) from None


def _parse(lines: list[bytes], sensor: Sensor, not_before_us: int | None) -> Events:
    """The events of these lines; blank lines are passed over.

    Raises:
        ValueError: a line is not `t[s] x y p`. EventOutsideSensor, TimeBackwards: it is, but the event is not good.
    """
    if not any(map(bytes.strip, lines)):
        return Events.empty()
    rows = np.loadtxt(lines, _LINE, comments=None, ndmin=1)
    if not (np.abs(rows["t"]) < MAX_T_S).all() or rows["p"].max() > 1:  # so written that nan fails
        raise ValueError("t is not finite or p is neither 0 nor 1")
    events = Events.from_columns(np.rint(rows["t"] * 1e6), rows["x"], rows["y"], rows["p"])
    check_events(events, sensor, not_before_us)
    return events


def _first_bad(lines: list[bytes], sensor: Sensor, not_before_us: int | None) -> tuple[int, str]:
    """How many of these lines come before the first bad one, and what is wrong with that.

    By bisection: the lines up to and with any one of them are either all good or not.
    """

    def fault(stop: int) -> str:
        try:
            _parse(lines[:stop], sensor, not_before_us)
        except EventOutsideSensor:
            return f"the event lies outside the sensor {sensor}"
        except TimeBackwards:
            return "time runs backwards"
        except ValueError:
            return "the line is not `t[s] x y p`"
        return ""

    stop = bisect_left(range(1, len(lines)), True, key=lambda stop: fault(stop) != "") + 1
    return stop - 1, fault(stop)
