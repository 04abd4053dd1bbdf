"""Prophesee .raw files: a text header, then EVT2 or EVT3 words as the camera wrote them."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from neurove_core.io.errors import BrokenRecording, MissingGeometry, UnknownSource
from neurove_core.io.format import Format
from neurove_core.io.formats.prophesee import evt, triggers
from neurove_core.io.recording import BLOCK_BYTES, CHUNK_EVENTS, EventsOnly, Triggers, empty_events, refuse_topic
from neurove_protocol.errors import InvalidField
from neurove_protocol.events import Events, Sensor

HEADER_BYTES = 64 << 10  # a header is some 500 bytes; more than this is none

Decode = Callable[[NDArray[Any], Any, int, int, Events], tuple[Any, int, int, int]]
FindTriggers = Callable[[NDArray[Any], triggers.TriggerState], tuple[triggers.TriggerState, triggers.Columns]]


class Words(NamedTuple):
    """One word format: how wide a word is and what reads it."""

    dtype: np.dtype[Any]
    known: NDArray[np.bool_]  # (16,) of the four bits that tell a word's type
    decode: Decode
    start: NamedTuple
    triggers: FindTriggers


def _known(*kinds: int) -> NDArray[np.bool_]:
    return np.isin(np.arange(16), kinds)


FORMATS = {
    "EVT2": Words(np.dtype("<u4"), _known(*evt.EVT2_WORDS), evt.evt2_decode, evt.Evt2State(), triggers.evt2_triggers),
    "EVT3": Words(np.dtype("<u2"), _known(*evt.EVT3_WORDS), evt.evt3_decode, evt.Evt3State(), triggers.evt3_triggers),
}
_FORMAT_OF_EVT = {"2.0": "EVT2", "2.1": "EVT21", "3.0": "EVT3"}


class Header(NamedTuple):
    """What the text in front of the words says."""

    format: str | None
    sensor: Sensor | None  # None where it says nothing that a sensor could have
    size: int  # [bytes]


def parse_header(path: Path, head: bytes) -> Header:
    r"""Read the lines that begin with `% `, up to the first that does not or to `% end`.

    Both ways of writing the geometry occur: a line of its own (or one each for width and height), and as fields of the
    format. Of two that speak of the same, the later one counts.

    >>> parse_header(Path("a.raw"), b"% evt 3.0\n% format EVT3;height=720;width=1280\n% end\n\x00\x80")
    Header(format='EVT3', sensor=Sensor(width=1280, height=720), size=52)

    Raises:
        BrokenRecording: a header line has no end.
    """
    fields: dict[str, str] = {}
    at = 0
    while head.startswith(b"% ", at):  # the blank too: a first word may well begin with the byte of a '%'
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
    return Header(fields.get("format"), sensor, at)


@dataclass(frozen=True, slots=True)
class PropheseeRecording(EventsOnly):
    """A .raw file of EVT2 or EVT3 words; see `Recording`."""

    path: Path
    sensor: Sensor
    words: Words
    header_bytes: int
    endless: bool = False

    @classmethod
    def open(cls, path: Path, sensor: Sensor | None = None) -> Self:
        """The recording in this file.

        Args:
            path: the .raw file.
            sensor: its pixel array; overrides the header.

        Raises:
            UnknownSource: the header names no format that can be read.
            MissingGeometry: the header does not tell the sensor's size and `sensor` does not either.
            BrokenRecording: the file ends within its header.
        """
        with path.open("rb") as file:
            header = parse_header(path, file.read(HEADER_BYTES))
        if header.format not in FORMATS:
            why = f"its words are {header.format}" if header.format else "its header names no word format"
            raise UnknownSource(path, why)
        sensor = sensor or header.sensor
        if sensor is None:
            raise MissingGeometry(path)
        return cls(path, sensor, FORMATS[header.format], header.size)

    @property
    def streams(self) -> tuple[str, ...]:
        """Events and triggers: whether any trigger came shows when they are read."""
        return ("events", "triggers")

    @property
    def name(self) -> str:
        """The file's name."""
        return self.path.name

    def chunks(self) -> Iterator[Events]:
        """All events from the beginning; see `Recording`. Other words are skipped.

        Raises:
            BrokenRecording: a word is cut, of no known type, or holds an event outside the sensor; it names the byte.
        """
        dtype, _, decode, state, _ = self.words
        at = self.header_bytes
        with self.path.open("rb") as file:
            file.seek(at)
            while block := file.read(BLOCK_BYTES):
                words = np.frombuffer(block, dtype, len(block) // dtype.itemsize)
                while words.size:
                    out = empty_events(CHUNK_EVENTS)
                    state, read, n, verdict = decode(words, state, self.sensor.width, self.sensor.height, out)
                    if n:
                        yield out.span(0, n)
                    at += read * dtype.itemsize
                    if verdict != evt.OK:
                        raise BrokenRecording(self.path, f"byte {at}", self._why(verdict, int(words[read]), out, n))
                    words = words[read:]
                if len(block) % dtype.itemsize:
                    raise BrokenRecording(self.path, f"byte {at}", "the file ends within a word")

    def triggers(self) -> Iterator[Triggers]:
        """All edges on the trigger inputs; see `Recording`. Their times are of the clock of the events.

        Raises:
            BrokenRecording: a word is cut or of no known type; it names the byte.
        """
        dtype, known, _, _, find = self.words
        at, state = self.header_bytes, triggers.TriggerState()
        with self.path.open("rb") as file:
            file.seek(at)
            while block := file.read(BLOCK_BYTES):
                words = np.frombuffer(block, dtype, len(block) // dtype.itemsize)
                good = known[words >> (8 * dtype.itemsize - 4)]
                n = words.size if good.all() else int(good.argmin())
                state, columns = find(words[:n], state)
                if columns[0].size:
                    yield Triggers(*columns)
                at += n * dtype.itemsize
                if n < words.size:
                    raise BrokenRecording(self.path, f"byte {at}", self._unknown(int(words[n])))
                if len(block) % dtype.itemsize:
                    raise BrokenRecording(self.path, f"byte {at}", "the file ends within a word")

    def _unknown(self, word: int) -> str:
        return f"0x{word:0{2 * self.words.dtype.itemsize}x} is of no known word type"

    def _why(self, verdict: int, word: int, out: Events, n: int) -> str:
        if verdict == evt.OUTSIDE:
            return f"an event at x={out.x[n]} y={out.y[n]} lies outside the sensor {self.sensor}"
        return self._unknown(word)


def _open(path: Path, sensor: Sensor | None, topic: str | None) -> PropheseeRecording:
    refuse_topic(path, topic)
    return PropheseeRecording.open(path, sensor)


FORMAT = Format("FILE.raw (Prophesee EVT2, EVT3)", _open, (".raw",))
