"""Event messages of ROS -> events, in each encoding that drivers use.

Which clock `t` is depends on the encoding: of `evt3` and `mono` it is the sensor's, over its wraps counted on; of
`libcaer`, `libcaer_cmp` and dvs_msgs it is unix time as the driver's host had it, carried on by the sensor's clock.
"""

from collections.abc import Iterator
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from neurove_core import kernels
from neurove_core.io.recording import CHUNK_EVENTS, Triggers
from neurove_core.io.ros_messages import DVS, BadMessage, EventMessage
from neurove_core.kernels_libcaer import WORD_EVENTS, LibcaerState, libcaer_decode, signed
from protocol.events import Events, Sensor

ENCODINGS: Final = ("evt3", "libcaer", "libcaer_cmp", "mono")
UNIX_TIME: Final = ("libcaer", "libcaer_cmp", DVS)
"""Encodings whose times are unix time already."""

_EVT3_PERIOD_US = 1 << 24
_LIBCAER_PERIOD_US = 1 << 31
_MICROSECOND = 1000  # [ns]


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
        self._evt3 = kernels.Evt3State()
        self._libcaer = LibcaerState()
        self._shift_us: int | None = 0 if anchor is None else None  # None: to be found, after a gap

    def events(self, message: EventMessage) -> Iterator[Events]:
        """The events of the next message.

        Raises:
            BadMessage: after the events before the first that can not be used.
        """
        gap = self._seq is not None and message.seq not in (self._seq + 1, -1)
        self._seq = message.seq
        if gap:  # what the camera said last of row, column and time is not known
            self._evt3, self._libcaer, self._shift_us = kernels.Evt3State(), LibcaerState(), None
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
        """The trigger edges of the next message, which only `evt3` has."""
        if message.encoding != "evt3":
            return
        words = _words(message)
        before = self._evt3
        for _ in self.events(message):
            pass
        shift_us = self._shift_us
        if shift_us is not None:
            found = trigger_edges(words, before)
            if found.t.size:
                yield found._replace(t=found.t + shift_us)

    def _of_evt3(self, message: EventMessage) -> Iterator[Events]:
        words = _words(message)
        while words.size:
            out = _room(min(CHUNK_EVENTS, max(words.size * kernels.VECTOR_EVENTS, kernels.VECTOR_EVENTS)))
            width, height = self._sensor.width, self._sensor.height
            self._evt3, read, n, verdict = kernels.evt3_decode(words, self._evt3, width, height, out)
            if n:
                yield self._counted_on(out.span(0, n), message)
            if verdict == kernels.OUTSIDE:
                raise BadMessage(f"an event at x={out.x[n]} y={out.y[n]} lies outside the sensor {self._sensor}")
            if verdict != kernels.OK:
                raise BadMessage(f"its word {read}, 0x{int(words[read]):04x}, is of no known type")
            words = words[read:]

    def _counted_on(self, events: Events, message: EventMessage) -> Events:
        """The same events on one clock with those before: after a gap the clock may have wrapped unseen."""
        t0_us = int(events.t[0])
        if self._shift_us is None and self._anchor is not None:
            away_us = (message.stamp_ns - self._anchor.stamp_ns) // _MICROSECOND
            self._shift_us = round((self._anchor.t_us + away_us - t0_us) / _EVT3_PERIOD_US) * _EVT3_PERIOD_US
        shift_us = self._shift_us or 0
        self._anchor = Anchor(message.stamp_ns, t0_us + shift_us)
        return events._replace(t=events.t + shift_us) if shift_us else events

    def _of_libcaer_cmp(self, message: EventMessage) -> Iterator[Events]:
        base_us, width, height = message.time_base_ns // _MICROSECOND, self._sensor.width, self._sensor.height
        words = _words(message)
        out = _room(words.size * WORD_EVENTS)
        self._libcaer, read, n, verdict = libcaer_decode(words, self._libcaer, base_us, width, height, out)
        yield out.span(0, n)
        if verdict == kernels.OUTSIDE:
            raise BadMessage(f"an event at x={out.x[n]} y={out.y[n]} lies outside the sensor {self._sensor}")
        if verdict != kernels.OK:
            raise BadMessage(f"its word {read}, 0x{int(words[read]):04x}, is of no known type")


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
    t = (message.time_base_ns + rows["dt"].astype(np.int64)) // _MICROSECOND
    return Events.from_columns(t, rows["x"].copy(), rows["y"] & 0x7FFF, rows["y"] >> 15)


def trigger_edges(words: NDArray[np.uint16], state: kernels.Evt3State) -> Triggers:
    """The trigger words (0xA: channel in bits 8 to 11, level in bit 0) among EVT3 words, and when they came.

    Args:
        words: (N,) words as the camera wrote them.
        state: of the decoder before them.
    """
    out = Triggers(np.empty(words.size, np.int64), np.empty(words.size, np.uint8), np.empty(words.size, np.uint8))
    n = _edges(words, state.timed, state.high, state.low, out.t, out.channel, out.level)
    return Triggers(out.t[:n], out.channel[:n], out.level[:n])


@kernels.compiled
def _edges(
    words: NDArray[np.uint16],
    timed: int,
    high: int,
    low: int,
    t: NDArray[np.int64],
    channel: NDArray[np.uint8],
    level: NDArray[np.uint8],
) -> int:  # pragma: no cover (machine code)
    n = 0
    for i in range(words.size):
        word = signed(words[i])
        kind, value = word >> 12, word & 0xFFF
        if kind == 0x6:
            low = value
        elif kind == 0x8:
            step = (value - high + kernels.STEP_BACK) % 4096 - kernels.STEP_BACK
            if not timed:
                high, low, timed = value, 0, 1
            elif step:
                high, low = high + step, 0
        elif kind == 0xA and timed:
            t[n], channel[n], level[n] = (high << 12) + low, (value >> 8) & 0xF, value & 1
            n += 1
    return n


def _room(n: int) -> Events:
    return Events(np.empty(n, np.int64), np.empty(n, np.uint16), np.empty(n, np.uint16), np.empty(n, np.uint8))
