"""Prophesee .dat files: a text header, two bytes with the type and size of the records, then records of 8 bytes."""

from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Self

import numpy as np
from numpy.typing import NDArray

from neurove_core.io.checked import Piece, cleaned, ordered
from neurove_core.io.clock import unwrap_times
from neurove_core.io.errors import BrokenRecording, MissingGeometry, UnknownSource
from neurove_core.io.faults import Faults
from neurove_core.io.format import Format
from neurove_core.io.formats.prophesee.raw import HEADER_BYTES, parse_header
from neurove_core.io.order import Where
from neurove_core.io.recording import BLOCK_BYTES, EventsOnly, Triggers, later, refuse_topic
from neurove_protocol.events import Events, Sensor

RECORD = np.dtype([("t", "<u4"), ("bits", "<u4")])
_EVENTS, _TRIGGERS = (0x00, 0x0C), (0x0E,)
VERSION = "2"
"""Version of the layout of the records. In version 1 the coordinates have other bits."""

SEEK_RECORDS = 4096
"""Distance between the records that the search for a time reads."""


@dataclass(frozen=True, slots=True)
class DatRecording(EventsOnly):
    """A .dat file of events, or of triggers without events; see `Recording`."""

    path: Path
    sensor: Sensor
    kind: int  # of its records
    start: int  # byte of the first record
    endless: bool = False
    faults: Faults = field(default_factory=Faults, compare=False, repr=False)

    @classmethod
    def open(cls, path: Path, sensor: Sensor | None = None) -> Self:
        """Open the recording in this file.

        Args:
            path: the .dat file.
            sensor: its pixel array, which takes precedence over the header.

        Raises:
            UnknownSource: its records are neither events nor triggers of 8 bytes, or the header gives another version.
            MissingGeometry: neither the header nor `sensor` gives the sensor size.
            BrokenRecording: the file ends within its header.
        """
        with path.open("rb") as file:
            head = file.read(HEADER_BYTES)
        header = parse_header(path, head)
        if header.version not in (None, VERSION):
            raise UnknownSource(path, f"its header says version {header.version}; the supported version is {VERSION}")
        kind_and_size = head[header.size : header.size + 2]
        if len(kind_and_size) < 2:
            raise BrokenRecording(path, f"byte {len(head)}", "the file ends within its header")
        kind, size = kind_and_size
        if kind not in _EVENTS + _TRIGGERS or size != RECORD.itemsize:
            raise UnknownSource(path, f"its records are of type 0x{kind:02x} and {size} bytes")
        sensor = sensor or header.sensor
        if sensor is None:
            raise MissingGeometry(path)
        return cls(path, sensor, kind, header.size + 2)

    @property
    def name(self) -> str:
        """The file's name."""
        return self.path.name

    @property
    def streams(self) -> tuple[str, ...]:
        """Events or triggers: a file has only one of them."""
        return ("triggers",) if self.kind in _TRIGGERS else ("events",)

    def chunks(self) -> Iterator[Events]:
        """All events from the beginning; see `Recording`. The 32-bit clock wraps every 71.6 min and is unwrapped."""
        return self._events(0, None)

    def since(self, t_us: int) -> Iterator[Events]:
        """As `chunks`, from this time [us], found by bisection.

        The search reads the time of every SEEK_RECORDS-th record. It misses a wrap of the clock if these events take
        longer than the 71.6 min of a wrap.
        """
        n = (self.path.stat().st_size - self.start) // RECORD.itemsize
        if n <= 0:
            return self.chunks()
        records = np.memmap(self.path, RECORD, "r", self.start, (n,))
        times, _ = unwrap_times(np.array(records["t"][::SEEK_RECORDS]), None)
        sample = max(int(times.searchsorted(t_us)) - 1, 0)
        return later(self._events(sample * SEEK_RECORDS, int(times[sample])), t_us)

    def triggers(self) -> Iterator[Triggers]:
        """The trigger edges of a file of triggers; see `Recording`."""
        if self.kind in _TRIGGERS:
            yield from ordered(self._edges(), self.faults.begin("triggers"))

    def _edges(self) -> Iterator[tuple[Where, Triggers]]:
        for at, t, bits in self._blocks(0, None):
            yield _place(at), Triggers(t, (bits >> 8 & 0x1F).astype(np.uint8), (bits & 1).astype(np.uint8))

    def _events(self, first: int, before_us: int | None) -> Iterator[Events]:
        """The events from record number `first`. `before_us` is the time of this record or of an earlier one [us]."""
        if self.kind not in _EVENTS:
            return iter(())
        return cleaned(self._pieces(first, before_us), self.sensor, self.faults.begin("events"))

    def _pieces(self, first: int, before_us: int | None) -> Iterator[Piece]:
        for at, t, bits in self._blocks(first, before_us):
            yield _place(at), Events.from_columns(t, bits & 0x3FFF, bits >> 14 & 0x3FFF, bits >> 28 & 1)

    def _blocks(self, first: int, before_us: int | None) -> Iterator[tuple[int, NDArray[np.int64], NDArray[np.uint32]]]:
        """Blocks of up to BLOCK_BYTES: the byte of the first record, the times [us] and the second words."""
        at = self.start + first * RECORD.itemsize
        with self.path.open("rb") as file:
            file.seek(at)
            while block := file.read(BLOCK_BYTES):
                records = np.frombuffer(block, RECORD, len(block) // RECORD.itemsize)
                t, before_us = unwrap_times(records["t"], before_us)
                yield at, t, records["bits"]
                at += records.nbytes
                if len(block) % RECORD.itemsize:
                    raise BrokenRecording(self.path, f"byte {at}", "the file ends within a record")


def _place(at: int) -> Where:
    """The byte of record i of a block that begins at byte `at`."""
    return lambda i: f"byte {at + i * RECORD.itemsize}"


def _open(path: Path, sensor: Sensor | None, topic: str | None) -> DatRecording:
    refuse_topic(path, topic)
    return DatRecording.open(path, sensor)


FORMAT = Format("FILE.dat (Prophesee DAT)", _open, (".dat",), signature=rb"(?:% [^\n]*\n)*?% (?i:data file|version) ")
