"""Reader of N-MNIST and N-Caltech101 (Orchard 2015): FILE.bin of events of 40 bits.

Bits 39 to 32 are x, 31 to 24 y, 23 the polarity (1 ON), 22 to 0 the time [us], with the highest byte first. An event
with y = 240 is none: from there on, 8,192 us are added to the times.

Sources: https://www.garrickorchard.com/datasets/n-mnist, and Read_Ndataset.m, which is part of the data sets.
"""

from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final, Self

import numpy as np
from numpy.typing import NDArray

from neurove_core.io.checked import Piece, as_recorded, cleaned
from neurove_core.io.errors import BrokenRecording, UnknownSource
from neurove_core.io.faults import Faults
from neurove_core.io.format import Format
from neurove_core.io.recording import BLOCK_BYTES, EventsOnly, refuse_topic
from neurove_protocol.events import Events, Sensor

NMNIST: Final = Sensor(34, 34)
"""The part of the ATIS sensor that N-MNIST keeps."""

EVENT_BYTES: Final = 5
OVERFLOW_Y, OVERFLOW_US = 240, 1 << 13
_ASSUMED = ", which is N-MNIST's: give --sensor 240x180 for N-Caltech101"
_SAMPLE = 64
_LATE = 0.1  # largest share of steps back in the first times of a file of this format


@dataclass(frozen=True, slots=True)
class AtisBinRecording(EventsOnly):
    """A .bin of N-MNIST or N-Caltech101; see `Recording`."""

    path: Path
    sensor: Sensor
    assumed: bool  # the caller does not give the sensor
    endless: bool = False
    faults: Faults = field(default_factory=Faults, compare=False, repr=False)

    @classmethod
    def open(cls, path: Path, sensor: Sensor | None = None) -> Self:
        """Open the recording in this file.

        Args:
            path: the .bin file.
            sensor: the pixel array; by default that of N-MNIST.

        Raises:
            UnknownSource: the times of the first events are not ordered, so it is another format.
        """
        with path.open("rb") as file:
            t, *_ = _decoded(file.read(_SAMPLE * EVENT_BYTES))
        if t.size > 1 and (np.diff(t) < 0).mean() > _LATE:
            raise UnknownSource(path, "the times of its first events are not ordered, so it is not a .bin of N-MNIST")
        return cls(path, sensor or NMNIST, sensor is None)

    @property
    def name(self) -> str:
        """The file's name."""
        return self.path.name

    def chunks(self) -> Iterator[Events]:
        """All events from the beginning; see `Recording`."""
        return cleaned(self._pieces(), self.sensor, self.faults.begin("events"), _ASSUMED if self.assumed else "")

    def _pieces(self) -> Iterator[Piece]:
        at = added_us = 0
        with self.path.open("rb") as file:
            while block := file.read(BLOCK_BYTES // EVENT_BYTES * EVENT_BYTES):
                t, x, y, p = _decoded(block)
                overflows = y == OVERFLOW_Y
                rows = np.flatnonzero(~overflows)
                t += added_us + np.cumsum(overflows) * OVERFLOW_US
                added_us += int(overflows.sum()) * OVERFLOW_US
                start, place = at, rows
                yield (
                    lambda i, start=start, place=place: f"byte {start + int(place[i]) * EVENT_BYTES}",  # type: ignore[misc]
                    as_recorded(t[rows], x[rows], y[rows], p[rows]),
                )
                at += t.size * EVENT_BYTES
                if len(block) % EVENT_BYTES:
                    raise BrokenRecording(self.path, f"byte {at}", "the file ends within an event")


def _decoded(data: bytes) -> tuple[NDArray[np.int64], NDArray[np.uint8], NDArray[np.uint8], NDArray[np.uint8]]:
    """The columns t [us], x, y, p of the complete events."""
    events = np.frombuffer(data, np.uint8, len(data) // EVENT_BYTES * EVENT_BYTES).reshape(-1, EVENT_BYTES)
    x, y, high, middle, low = events.T
    t = (high.astype(np.int64) & 0x7F) << 16 | middle.astype(np.int64) << 8 | low
    return t, x, y, (high >> 7).astype(np.uint8)


def _open(path: Path, sensor: Sensor | None, topic: str | None) -> AtisBinRecording:
    refuse_topic(path, topic)
    return AtisBinRecording.open(path, sensor)


FORMAT = Format("FILE.bin (N-MNIST, N-Caltech101)", _open, (".bin",))
