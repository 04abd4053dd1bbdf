"""Event messages of ROS -> events, in each encoding that drivers use.

Which clock `t` is depends on the encoding: of `evt3` and `mono` it is the sensor's, over its wraps counted on; of
`libcaer`, `libcaer_cmp` and dvs_msgs it is unix time as the driver's host had it, carried on by the sensor's clock.
"""

from collections.abc import Iterator
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from neurove_core.io.formats.prophesee import evt, triggers
from neurove_core.io.formats.ros.libcaer import WORD_EVENTS, LibcaerState, libcaer_decode
from neurove_core.io.formats.ros.messages import DVS, BadMessage, EventMessage
from neurove_core.io.recording import CHUNK_EVENTS, Triggers, empty_events
from neurove_protocol.events import Events, Sensor

ENCODINGS: Final = ("evt3", "libcaer", "libcaer_cmp", "mono")
UNIX_TIME: Final = ("libcaer", "libcaer_cmp", DVS)
"""Encodings whose times are unix time already."""

_EVT3_PERIOD_US = 1 << 24
_LIBCAER_PERIOD_US = 1 << 31
_MICROSECOND = 1000  # [ns]
_WORDS = CHUNK_EVENTS // WORD_EVENTS  # decoded at once


class Anchor(NamedTuple):
    """One moment on both clocks."""

    stamp_ns: int  # of the message's header: host clock
    t_us: int  # of its first event: sensor clock


class Decoder:
    """Turns the messages of one topic into events, one after the other.

    Args:
        sensor: the pixel array.
        anchor: a moment before the first message that will come, where it is not the first of the recording.
    """

    def __init__(self, sensor: Sensor, anchor: Anchor | None = None) -> None:
        self._sensor = sensor
        self._anchor = anchor
        self._seq: int | None = None
        self._evt3 = evt.Evt3State()
        self._triggers = triggers.TriggerState()
        self._libcaer = LibcaerState()
        self._shift_us: int | None = 0 if anchor is None else None  # None: to be found, after a gap

    def events(self, message: EventMessage) -> Iterator[Events]:
        """The events of the next message.

        Raises:
            BadMessage: after the events before the first that can not be used.
        """
        self._heed_a_gap(message)
        yield from self._decoded(message)

    def _decoded(self, message: EventMessage) -> Iterator[Events]:
        match message.encoding:
            case "evt3":
                yield from self._of_evt3(message)
            case "libcaer_cmp":
                yield from self._of_libcaer_cmp(message)
            case "libcaer":
                yield _libcaer(message)
            case "mono":
                yield _mono(message)
            case other:
                raise BadMessage(f"its encoding is {other!r}; known are {', '.join(ENCODINGS)}")

    def triggers(self, message: EventMessage) -> Iterator[Triggers]:
        """The trigger edges of the next message, which only `evt3` has; call this or `events` of a message.

        Raises:
            BadMessage: some word of it can not be used.
        """
        if message.encoding != "evt3":
            return
        self._heed_a_gap(message)
        for _ in self._decoded(message):  # the clock goes on by the events, and a bad word is told
            pass
        self._triggers, (t, channel, level) = triggers.evt3_triggers(_words(message), self._triggers)
        if t.size:
            yield Triggers(t + self._shift(message, int(t[0])), channel, level)

    def _heed_a_gap(self, message: EventMessage) -> None:
        """After lost messages it is not known what the camera said last of row, column and time."""
        if self._seq is not None and message.seq not in (self._seq + 1, -1):
            self._evt3, self._triggers, self._shift_us = evt.Evt3State(), triggers.TriggerState(), None
            self._libcaer = LibcaerState()
        self._seq = message.seq

    def _of_evt3(self, message: EventMessage) -> Iterator[Events]:
        words, done = _words(message), 0
        while words.size:
            out = empty_events(min(CHUNK_EVENTS, max(words.size * evt.VECTOR_EVENTS, evt.VECTOR_EVENTS)))
            width, height = self._sensor.width, self._sensor.height
            self._evt3, read, n, verdict = evt.evt3_decode(words, self._evt3, width, height, out)
            if n:
                yield self._counted_on(out.span(0, n), message)
            if verdict == evt.OUTSIDE:
                raise BadMessage(f"an event at x={out.x[n]} y={out.y[n]} lies outside the sensor {self._sensor}")
            if verdict != evt.OK:
                raise BadMessage(f"its word {done + read}, 0x{int(words[read]):04x}, is of no known type")
            words, done = words[read:], done + read

    def _counted_on(self, events: Events, message: EventMessage) -> Events:
        """The same events on one clock with those before."""
        shift_us = self._shift(message, int(events.t[0]))
        self._anchor = Anchor(message.stamp_ns, int(events.t[0]) + shift_us)
        return events._replace(t=events.t + shift_us) if shift_us else events

    def _shift(self, message: EventMessage, t0_us: int) -> int:
        """What the clock has wrapped unseen [us]: in a gap, by the stamps of the messages before and after it."""
        if self._shift_us is None and self._anchor is not None:
            away_us = (message.stamp_ns - self._anchor.stamp_ns) // _MICROSECOND
            self._shift_us = round((self._anchor.t_us + away_us - t0_us) / _EVT3_PERIOD_US) * _EVT3_PERIOD_US
        return self._shift_us or 0

    def _of_libcaer_cmp(self, message: EventMessage) -> Iterator[Events]:
        base_us, width, height = message.time_base_ns // _MICROSECOND, self._sensor.width, self._sensor.height
        self._libcaer = self._libcaer._replace(high=0, low=0)
        words = _words(message)
        for first in range(0, words.size, _WORDS):
            part = words[first : first + _WORDS]
            out = empty_events(part.size * WORD_EVENTS)
            self._libcaer, read, n, verdict = libcaer_decode(part, self._libcaer, base_us, width, height, out)
            yield out.span(0, n)
            if verdict == evt.OUTSIDE:
                raise BadMessage(f"an event at x={out.x[n]} y={out.y[n]} lies outside the sensor {self._sensor}")
            if verdict != evt.OK:
                raise BadMessage(f"its word {first + read}, 0x{int(part[read]):04x}, is of no known type")


def _words(message: EventMessage) -> NDArray[np.uint16]:
    if len(message.data) % 2:
        raise BadMessage("it ends within a word")
    return np.frombuffer(message.data, "<u2")


def _rows(message: EventMessage, dtype: list[tuple[str, str]]) -> NDArray[np.void]:
    row = np.dtype(dtype)
    if len(message.data) % row.itemsize:
        raise BadMessage(f"its {len(message.data)} bytes are no multiple of {row.itemsize}")
    return np.frombuffer(message.data, row)


def _libcaer(message: EventMessage) -> Events:
    """Events of 8 bytes as libcaer has them: valid, polarity, y, x from bit 0, 1, 2, 17 on, then 31 bits of time [us].

    The message's time base holds the bits of the time above those 31; a wrap within a message is counted on here.
    """
    rows = _rows(message, [("data", "<u4"), ("t", "<i4")])
    if (rows["t"] < 0).any():
        raise BadMessage("a time is below 0")
    low = rows["t"].astype(np.int64)
    wraps = np.concatenate(([0], np.cumsum(low[1:] < low[:-1] - _LIBCAER_PERIOD_US // 2))) if low.size else low
    t = message.time_base_ns // _MICROSECOND + low + wraps * _LIBCAER_PERIOD_US
    data, valid = rows["data"], rows["data"] & 1 > 0
    events = Events.from_columns(t, data >> 17, data >> 2 & 0x7FFF, data >> 1 & 1)
    return events if valid.all() else Events(events.t[valid], events.x[valid], events.y[valid], events.p[valid])


def _mono(message: EventMessage) -> Events:
    """8 bytes an event: time after the message's time base [ns], x, y with the polarity in bit 15."""
    rows = _rows(message, [("dt", "<u4"), ("x", "<u2"), ("y", "<u2")])
    base_us, rest_ns = divmod(message.time_base_ns, _MICROSECOND)  # as a whole it may not fit a signed number
    t = base_us + (rest_ns + rows["dt"].astype(np.int64)) // _MICROSECOND
    return Events.from_columns(t, rows["x"].copy(), rows["y"] & 0x7FFF, rows["y"] >> 15)
