"""Prophesee .raw files: a text header, then EVT2, EVT2.1, EVT3 or EVT4 words from the camera.

Source: docs.prophesee.ai/stable/data/file_formats/raw.html.
"""

from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from neurove_core.io.checked import Piece, cleaned, numbered, ordered
from neurove_core.io.errors import BrokenRecording, MissingGeometry, UnknownSource
from neurove_core.io.faults import Faults, Reason, Tally
from neurove_core.io.format import Format
from neurove_core.io.formats.prophesee.words import ENDIANNESS, FORMATS, Words, endianness_of, words_in
from neurove_core.io.recording import BLOCK_BYTES, CHUNK_EVENTS, EventsOnly, Triggers, empty_events, refuse_topic
from neurove_protocol.errors import InvalidField
from neurove_protocol.events import Events, Sensor

HEADER_BYTES = 64 << 10  # maximum size; a header has about 500 bytes

_FORMAT_OF_EVT = {"2.0": "EVT2", "2.1": "EVT21", "3.0": "EVT3", "4.0": "EVT4"}


class Header(NamedTuple):
    """Content of the text header."""

    format: str | None
    sensor: Sensor | None  # None if the header has no valid sensor size
    size: int  # [bytes]
    version: str | None = None  # of the records of a .dat file
    endianness: str | None = None  # order of the bytes of a word


def parse_header(path: Path, head: bytes) -> Header:
    r"""Read the lines that begin with `% `, up to the first other line or `% end`.

    The geometry is either in a line of its own (or one line each for width and height) or in fields of the format line.
    If a value occurs twice, the later one applies.

    >>> parse_header(Path("a.raw"), b"% evt 3.0\n% format EVT3;height=720;width=1280\n% end\n\x00\x80")
    Header(format='EVT3', sensor=Sensor(width=1280, height=720), size=52, version=None, endianness=None)

    Raises:
        BrokenRecording: a header line has no end.
    """
    fields: dict[str, str] = {}
    at = 0
    while head.startswith(b"% ", at):  # with the space: the first word can begin with the byte of '%'
        end = head.find(b"\n", at)
        if end < 0:
            raise BrokenRecording(path, f"byte {at}", "the file ends within its header")
        key, _, value = head[at + 2 : end].decode("latin-1").strip().partition(" ")
        at = end + 1
        if key.lower() == "end":
            break
        if key.lower() == "format":
            value, *parts = value.split(";")
            fields.update((name.strip().lower(), text) for name, _, text in (part.partition("=") for part in parts))
        elif key.lower() == "evt":
            key, value = "format", _FORMAT_OF_EVT.get(value.strip(), f"EVT {value}")
        elif key.lower() == "geometry":
            fields["width"], _, fields["height"] = value.partition("x")
        fields[key.lower()] = value.strip()
    try:
        sensor = Sensor(int(fields.get("width", "")), int(fields.get("height", "")))
    except (ValueError, InvalidField):
        sensor = None
    return Header(fields.get("format"), sensor, at, fields.get("version"), fields.get("endianness"))


@dataclass(frozen=True, slots=True)
class PropheseeRecording(EventsOnly):
    """A .raw file; see `Recording`.

    If the header does not give the order of the bytes, it is little-endian; the order of EVT2.1 is found in its words.
    """

    path: Path
    sensor: Sensor
    words: Words
    header_bytes: int
    endianness: str = "little"
    endless: bool = False
    faults: Faults = field(default_factory=Faults, compare=False, repr=False)

    @classmethod
    def open(cls, path: Path, sensor: Sensor | None = None) -> Self:
        """Open the recording in this file.

        Args:
            path: the .raw file.
            sensor: its pixel array, which takes precedence over the header.

        Raises:
            UnknownSource: the header does not name a supported format.
            MissingGeometry: neither the header nor `sensor` gives the sensor size.
            BrokenRecording: the file ends within its header.
        """
        with path.open("rb") as file:
            header = parse_header(path, file.read(HEADER_BYTES))
            file.seek(header.size)
            first = file.read(HEADER_BYTES)
        if header.format not in FORMATS:
            known = ", ".join(FORMATS)
            why = f"its words are {header.format}" if header.format else "its header does not name a word format"
            raise UnknownSource(path, f"{why}; supported: {known}")
        endianness = header.endianness or endianness_of(header.format, first) or "little"
        if endianness not in ENDIANNESS:
            raise UnknownSource(path, f"its endianness is {endianness!r}; supported: {', '.join(ENDIANNESS)}")
        sensor = sensor or header.sensor
        if sensor is None:
            raise MissingGeometry(path)
        return cls(path, sensor, FORMATS[header.format], header.size, endianness)

    @property
    def streams(self) -> tuple[str, ...]:
        """Events and triggers. Only reading shows whether there are triggers."""
        return ("events", "triggers")

    @property
    def name(self) -> str:
        """The file's name."""
        return self.path.name

    def chunks(self) -> Iterator[Events]:
        """All events from the beginning; see `Recording`. Words of reserved types are skipped and counted."""
        tally = self.faults.begin("events")
        return cleaned(self._pieces(tally), self.sensor, tally)

    def _pieces(self, tally: Tally) -> Iterator[Piece]:
        state, number = self.words.start, 0
        for at, words in self._blocks():
            while words.size:
                out, reserved = empty_events(CHUNK_EVENTS), np.zeros(2, np.int64)
                state, read, n = self.words.decode(words, state, out, reserved)
                yield numbered(number), out.span(0, n)
                number += n
                count, first = reserved.tolist()
                if count:
                    word = f"0x{int(words[first]):0{2 * words.itemsize}x}"
                    place = f"byte {at + first * words.itemsize}"
                    tally.add(Reason.RESERVED, place, f"the word {word} has a reserved type", count)
                at, words = at + read * words.itemsize, words[read:]
        if getattr(state, "pending", -1) >= 0:
            tally.add(Reason.UNREAD, f"byte {self.path.stat().st_size}", "the file ends within a vector")

    def triggers(self) -> Iterator[Triggers]:
        """All edges on the trigger inputs; see `Recording`. Their times are in the clock of the events."""
        return ordered(self._edges(), self.faults.begin("triggers"))

    def _edges(self) -> Iterator[tuple[str, Triggers]]:
        state = self.words.first
        for at, words in self._blocks():
            state, columns = self.words.triggers(words, state)
            yield f"the words from byte {at}", Triggers(*columns)

    def _blocks(self) -> Iterator[tuple[int, NDArray[Any]]]:
        """Blocks of up to BLOCK_BYTES: the byte of the first word, and the words."""
        dtype, at = self.words.dtype, self.header_bytes
        with self.path.open("rb") as file:
            file.seek(at)
            while block := file.read(BLOCK_BYTES):
                words = words_in(block, self.words, self.endianness)
                yield at, words
                at += words.nbytes
                if len(block) % dtype.itemsize:
                    raise BrokenRecording(self.path, f"byte {at}", "the file ends within a word")


def _open(path: Path, sensor: Sensor | None, topic: str | None) -> PropheseeRecording:
    refuse_topic(path, topic)
    return PropheseeRecording.open(path, sensor)


FORMAT = Format(
    "FILE.raw (Prophesee EVT2, EVT2.1, EVT3, EVT4)", _open, (".raw",), signature=rb"(?:% [^\n]*\n)*?% (?i:evt|format) "
)
