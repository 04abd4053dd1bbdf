"""ROS event messages -> events, for each encoding that drivers use.

The clock of `t` depends on the encoding:

- `evt2`, `evt21`, `evt3`, `evt4` and `mono`: the sensor clock, unwrapped.
- `libcaer`, `libcaer_cmp` and dvs_msgs: unix time of the driver's host, continued by the sensor clock.

Source: github.com/ros-event-camera/event_camera_msgs. The encodings `evt...` are the words of the camera, unchanged.
"""

from collections.abc import Iterator
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from neurove_core.io.clock import unwraps
from neurove_core.io.faults import Reason, Tally
from neurove_core.io.formats.prophesee.words import FORMATS, Words, endianness_of, words_in
from neurove_core.io.formats.ros.libcaer import WORD_EVENTS, LibcaerState, libcaer_decode
from neurove_core.io.formats.ros.messages import DVS, BadMessage, EventMessage
from neurove_core.io.recording import CHUNK_EVENTS, Triggers, empty_events
from neurove_protocol.events import Events

PROPHESEE: Final = {name.lower(): words for name, words in FORMATS.items()}
"""Encodings of Prophesee words: evt2, evt21, evt3, evt4. Only they have triggers."""

ENCODINGS: Final = (*PROPHESEE, "libcaer", "libcaer_cmp", "mono")
UNIX_TIME: Final = ("libcaer", "libcaer_cmp", DVS)
"""Encodings whose times are unix time."""

_LIBCAER_PERIOD_US = 1 << 31
_MICROSECOND = 1000  # [ns]
_WORDS = CHUNK_EVENTS // WORD_EVENTS  # words decoded in one call


class Anchor(NamedTuple):
    """One moment on the host clock and on the sensor clock."""

    stamp_ns: int  # stamp of the message header: host clock
    t_us: int  # time of the first event: sensor clock


class Decoder:
    """Decodes the messages of one topic into events. Pass the messages in recorded order.

    The events may lie outside the sensor, and their times may decrease.

    Args:
        anchor: a moment before the first message to decode. Not needed if decoding starts at the first message of the
            recording.
        tally: counts reserved words.
    """

    def __init__(self, anchor: Anchor | None = None, tally: Tally | None = None) -> None:
        self._anchor = anchor
        self._tally = tally
        self._seq: int | None = None
        self._where = ""
        self._encoding = ""  # of Prophesee words
        self._endianness: str | None = None
        self._state: Any = None  # of the decoder of Prophesee words; None: at the start
        self._triggers: Any = None
        self._libcaer = LibcaerState()
        self._known_wraps_us: int | None = 0 if anchor is None else None  # None: unknown after a gap

    def events(self, message: EventMessage, where: str = "") -> Iterator[Events]:
        """Yield the events of the next message.

        Args:
            message: the message.
            where: its place in the recording.

        Raises:
            BadMessage: the message is invalid.
        """
        self._where = where
        self._reset_after_gap(message)
        yield from self._decoded(message)

    def _decoded(self, message: EventMessage) -> Iterator[Events]:
        match message.encoding:
            case encoding if encoding in PROPHESEE:
                yield from self._decode_prophesee(message, PROPHESEE[encoding])
            case "libcaer_cmp":
                yield from self._decode_libcaer_cmp(message)
            case "libcaer":
                yield _libcaer(message)
            case "mono":
                yield _mono(message)
            case other:
                raise BadMessage(f"unknown encoding {other!r}; supported: {', '.join(ENCODINGS)}")

    def triggers(self, message: EventMessage) -> Iterator[Triggers]:
        """Yield the trigger edges of the next message. Only Prophesee words have them.

        Call either this method or `events` for a message, not both.

        Raises:
            BadMessage: a word of the message is invalid.
        """
        words = PROPHESEE.get(message.encoding)
        if words is None:
            return
        self._reset_after_gap(message)
        for _ in self._decoded(message):  # advances the clock
            pass
        found = self._words_of(message, words)
        self._triggers, (t, channel, level) = words.triggers(found, self._triggers or words.first)
        if t.size:
            yield Triggers(t + self._wraps_us(message, int(t[0])), channel, level)

    def _reset_after_gap(self, message: EventMessage) -> None:
        """Reset row, column and time after lost messages: their last values are unknown."""
        if self._seq is not None and message.seq not in (self._seq + 1, -1):
            self._state = self._triggers = self._known_wraps_us = None
            self._libcaer = LibcaerState()
        if message.encoding != self._encoding:
            self._state = self._triggers = self._endianness = None
        self._seq, self._encoding = message.seq, message.encoding

    def _words_of(self, message: EventMessage, words: Words) -> NDArray[Any]:
        if len(message.data) % words.dtype.itemsize:
            raise BadMessage("the message ends within a word")
        if self._endianness is None:
            self._endianness = endianness_of(message.encoding.upper(), message.data)
        return words_in(message.data, words, self._endianness or "little")

    def _decode_prophesee(self, message: EventMessage, format_: Words) -> Iterator[Events]:
        words, done = self._words_of(message, format_), 0
        state = format_.start if self._state is None else self._state
        while words.size:
            out = empty_events(min(CHUNK_EVENTS, (words.size + 1) * format_.events))
            reserved = np.zeros(2, np.int64)
            state, read, n = format_.decode(words, state, out, reserved)
            self._state = state
            if n:
                yield self._unwrapped(out.span(0, n), message)
            self._count(reserved, words, done)
            words, done = words[read:], done + read

    def _count(self, reserved: NDArray[np.int64], words: NDArray[Any], done: int) -> None:
        count, first = reserved.tolist()
        if count and self._tally is not None:
            why = f"word {done + first} (0x{int(words[first]):0{2 * words.itemsize}x}) has an unknown type"
            self._tally.add(Reason.RESERVED, self._where, why, count)

    def _unwrapped(self, events: Events, message: EventMessage) -> Events:
        """Return the events on the same unwrapped clock as the events before."""
        wraps_us = self._wraps_us(message, int(events.t[0]))
        self._anchor = Anchor(message.stamp_ns, int(events.t[0]) + wraps_us)
        return events._replace(t=events.t + wraps_us) if wraps_us else events

    def _wraps_us(self, message: EventMessage, t0_us: int) -> int:
        """Return the duration of all clock wraps in a gap [us], from the message stamps before and after the gap."""
        if self._known_wraps_us is None and self._anchor is not None:
            elapsed_us = (message.stamp_ns - self._anchor.stamp_ns) // _MICROSECOND
            period_us = PROPHESEE[message.encoding].period_us
            self._known_wraps_us = round((self._anchor.t_us + elapsed_us - t0_us) / period_us) * period_us
        return self._known_wraps_us or 0

    def _decode_libcaer_cmp(self, message: EventMessage) -> Iterator[Events]:
        base_us = message.time_base_ns // _MICROSECOND
        self._libcaer = self._libcaer._replace(high=0, low=0)
        words = _words(message)
        for first in range(0, words.size, _WORDS):
            part = words[first : first + _WORDS]
            out, reserved = empty_events(part.size * WORD_EVENTS), np.zeros(2, np.int64)
            self._libcaer, n = libcaer_decode(part, self._libcaer, base_us, out, reserved)
            yield out.span(0, n)
            self._count(reserved, part, first)


def _words(message: EventMessage) -> NDArray[np.uint16]:
    if len(message.data) % 2:
        raise BadMessage("the message ends within a word")
    return np.frombuffer(message.data, "<u2")


def _rows(message: EventMessage, dtype: list[tuple[str, str]]) -> NDArray[np.void]:
    row = np.dtype(dtype)
    if len(message.data) % row.itemsize:
        raise BadMessage(f"{len(message.data)} bytes are not a multiple of {row.itemsize}")
    return np.frombuffer(message.data, row)


def _libcaer(message: EventMessage) -> Events:
    """Decode libcaer events of 8 bytes: valid, polarity, y and x from bits 0, 1, 2 and 17, then 31 bits of time [us].

    The message's time base holds the bits of the time above those 31. Wraps within a message are unwrapped here.
    """
    rows = _rows(message, [("data", "<u4"), ("t", "<i4")])
    if (rows["t"] < 0).any():
        raise BadMessage("an event has a negative time")
    low = rows["t"].astype(np.int64)
    wraps = unwraps(low, _LIBCAER_PERIOD_US)
    t = message.time_base_ns // _MICROSECOND + low + wraps * _LIBCAER_PERIOD_US
    data, valid = rows["data"], rows["data"] & 1 > 0
    events = Events.from_columns(t, data >> 17, data >> 2 & 0x7FFF, data >> 1 & 1)
    return events if valid.all() else Events(events.t[valid], events.x[valid], events.y[valid], events.p[valid])


def _mono(message: EventMessage) -> Events:
    """Decode `mono` events of 8 bytes: time after the message's time base [ns], x, y with the polarity in bit 15."""
    rows = _rows(message, [("dt", "<u4"), ("x", "<u2"), ("y", "<u2")])
    base_us, remainder_ns = divmod(message.time_base_ns, _MICROSECOND)  # the time base may not fit a signed number
    t = base_us + (remainder_ns + rows["dt"].astype(np.int64)) // _MICROSECOND
    return Events.from_columns(t, rows["x"].copy(), rows["y"] & 0x7FFF, rows["y"] >> 15)
