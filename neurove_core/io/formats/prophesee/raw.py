"""Prophesee .raw files: a text header, then EVT2 or EVT3 words from the camera."""

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

HEADER_BYTES = 64 << 10  # maximum size; a header has about 500 bytes

Decode = Callable[[NDArray[Any], Any, int, int, Events], tuple[Any, int, int, int]]
FindTriggers = Callable[[NDArray[Any], triggers.TriggerState], tuple[triggers.TriggerState, triggers.Columns]]


class Words(NamedTuple):
    """A word format: its word type and its decoders."""

    dtype: np.dtype[Any]
    known: NDArray[np.bool_]  # (16,) known word types, indexed by the first four bits
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
    """Content of the text header."""

    format: str | None
    sensor: Sensor | None  # None if the header has no valid sensor size
    size: int  # [bytes]


def parse_header(path: Path, head: bytes) -> Header:
    r"""Read the lines that begin with `% `, up to the first other line or `% end`.

    The geometry is either in a line of its own (or one line each for width and height) or in fields of the format line.
    If a value occurs twice, the later one applies.

    >>> parse_header(Path("a.raw"), b"% evt 3.0\n% format EVT3;height=720;width=1280\n% end\n\x00\x80")
    Header(format='EVT3', sensor=Sensor(width=1280, height=720), size=52)

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
        if header.format not in FORMATS:
            why = f"its words are {header.format}" if header.format else "its header does not name a word format"
            raise UnknownSource(path, why)
        sensor = sensor or header.sensor
        if sensor is None:
            raise MissingGeometry(path)
        return cls(path, sensor, FORMATS[header.format], header.size)

    @property
    def streams(self) -> tuple[str, ...]:
        """Events and triggers. Only reading shows whether there are triggers."""
        return ("events", "triggers")

    @property
    def name(self) -> str:
        """The file's name."""
        return self.path.name

    def chunks(self) -> Iterator[Events]:
        """All events from the beginning; see `Recording`. Other words are skipped.

        Raises:
            BrokenRecording: a word is truncated, has an unknown type, or has an event outside the sensor. The error
                names the byte.
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
                        raise BrokenRecording(
                            self.path, f"byte {at}", self._fault_text(verdict, int(words[read]), out, n)
                        )
                    words = words[read:]
                if len(block) % dtype.itemsize:
                    raise BrokenRecording(self.path, f"byte {at}", "the file ends within a word")

    def triggers(self) -> Iterator[Triggers]:
        """All edges on the trigger inputs; see `Recording`. Their times are in the clock of the events.

        Raises:
            BrokenRecording: a word is truncated or has an unknown type. The error names the byte.
        """
        dtype, known, _, _, find = self.words
        at, state = self.header_bytes, triggers.TriggerState()
        with self.path.open("rb") as file:
            file.seek(at)
            while block := file.read(BLOCK_BYTES):
                words = np.frombuffer(block, dtype, len(block) // dtype.itemsize)
                is_known = known[words >> (8 * dtype.itemsize - 4)]
                n = words.size if is_known.all() else int(is_known.argmin())
                state, columns = find(words[:n], state)
                if columns[0].size:
                    yield Triggers(*columns)
                at += n * dtype.itemsize
                if n < words.size:
                    raise BrokenRecording(self.path, f"byte {at}", self._unknown_text(int(words[n])))
                if len(block) % dtype.itemsize:
                    raise BrokenRecording(self.path, f"byte {at}", "the file ends within a word")

    def _unknown_text(self, word: int) -> str:
        return f"0x{word:0{2 * self.words.dtype.itemsize}x} has an unknown word type"

    def _fault_text(self, verdict: int, word: int, out: Events, n: int) -> str:
        if verdict == evt.OUTSIDE:
            return f"an event at x={out.x[n]} y={out.y[n]} lies outside the sensor {self.sensor}"
        return self._unknown_text(word)


def _open(path: Path, sensor: Sensor | None, topic: str | None) -> PropheseeRecording:
    refuse_topic(path, topic)
    return PropheseeRecording.open(path, sensor)


FORMAT = Format("FILE.raw (Prophesee EVT2, EVT3)", _open, (".raw",), signature=rb"(?:% [^\n]*\n)*?% (?i:evt|format) ")
