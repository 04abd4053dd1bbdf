"""Decoders of Prophesee EVT2 and EVT3 words: a compiled fast path and a reference implementation of each."""

from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from neurove_core.compiled import compiled
from neurove_protocol.events import Events

STEP_BACK: Final = 10
"""Maximum decrease of TIME_HIGH that is a disturbance of one word. Prophesee's own decoder has the same limit."""

EVT3_BACK_US: Final = (STEP_BACK + 1) << 12
EVT2_BACK_US: Final = (STEP_BACK + 1) << 6
"""An event that is earlier by less than this gets the time of the event before it."""

VECTOR_EVENTS: Final = 12
"""Maximum number of events in one word. `out` must have space for at least as many."""

_ADDR_Y, _ADDR_X, _BASE_X, _VECT_12, _VECT_8, TIME_LOW, TIME_HIGH = 0, 2, 3, 4, 5, 6, 8
_EVT3_SKIPPED = 1 << 0x7 | 1 << 0xA | 1 << 0xE | 1 << 0xF  # CONTINUED_4, EXT_TRIGGER, OTHERS, CONTINUED_12
_EVT2_SKIPPED = (0xA, 0xE, 0xF)  # EXT_TRIGGER, OTHERS, CONTINUED
_ONE = np.uint64(1)
_BIT = np.array([0, 0, 1, 4, 2, 9, 5, 11, 3, 8, 10, 7, 6])  # maps 2**k % 13 to k; the remainders differ for k < 12


class Evt3State(NamedTuple):
    """State of an EVT3 decoder between words. The default is for the start of a recording or after a gap."""

    timed: int = 0  # 1 after the first TIME_HIGH; before it events have no time and are ignored
    high: int = 0  # TIME_HIGH, unwrapped [4096 us]
    low: int = 0  # TIME_LOW [us]
    last_us: int = 0  # time of the last event [us]
    y: int = -1  # row [px], -1 before the first row
    base_x: int = -1  # column of the next vector [px], -1 before the first vector
    p: int = 0  # polarity of the vectors


class Evt2State(NamedTuple):
    """State of an EVT2 decoder between words. The default is for the start of a recording or after a gap."""

    timed: int = 0  # 1 after the first TIME_HIGH; before it events have no time and are ignored
    high: int = 0  # TIME_HIGH, unwrapped [64 us]
    last_us: int = 0  # time of the last event [us]


@compiled
def signed(word: np.unsignedinteger[Any]) -> int:  # pragma: no cover (machine code)
    """A word as a signed number."""
    return np.int64(word)  # type: ignore[return-value]  # int() is unsigned in numba, and mixed arithmetic gives float


@compiled
def unwrapped(high: int, value: int, period: int) -> int:  # pragma: no cover (machine code)
    """Unwrap a counter whose new value is `value`: see `step_of`."""
    step = value - high % period
    if step >= period - STEP_BACK:
        step -= period
    elif step < -STEP_BACK and value < period // 4 and value - step >= period // 4 * 3:
        step += period
    return high + step


@compiled
def not_before(last_us: int, t_us: int, back_us: int) -> int:  # pragma: no cover (machine code)
    """The time of an event after one at `last_us`: `last_us` if the step back is small, otherwise the clock changed."""
    return last_us if last_us - back_us < t_us < last_us else t_us


@compiled
def evt3_decode(
    words: NDArray[np.uint16], state: Evt3State, out: Events, reserved: NDArray[np.int64]
) -> tuple[Evt3State, int, int]:  # pragma: no cover (machine code)
    """Decode EVT3 words until they end or `out` is full.

    The camera's clock has 24 bits [us] and wraps every 16.777 s; the times are unwrapped. TIME_HIGH sometimes decreases
    by up to STEP_BACK: an event at such a moment gets the time of the event before it. Triggers, monitoring words,
    events before the first TIME_HIGH, and words of a reserved type are skipped. Some cameras fill packets with the
    latter.

    Source: docs.prophesee.ai, EVT 3.0 format.

    Args:
        words: (N,) words from the camera.
        state: state after the words before these.
        out: columns of equal length, at least VECTOR_EVENTS, for the events. They may lie outside the sensor.
        reserved: (2,) the number of reserved words, which is increased, and the index in `words` of the first one,
            which is set if the number is 0.

    Returns:
        The state after the words read, the number of words read, and the number of events in `out`. If not all words
        were read, `out` is full: call again with the remaining words.
    """
    timed, high, low, last_us, y, base_x, p = state
    t_out, x_out, y_out, p_out = out
    if t_out.size < VECTOR_EVENTS:  # a negative limit would become a huge unsigned number
        return state, 0, 0
    n, limit = (
        np.uint64(0),
        np.uint64(t_out.size - VECTOR_EVENTS),
    )  # unsigned: numba omits the check for negative indices
    base = high << 12
    for i in range(words.size):
        word = signed(words[i])
        kind, value = word >> 12, word & 0xFFF
        if kind == _ADDR_X:
            if timed and y >= 0:
                if n > limit:
                    return Evt3State(timed, high, low, last_us, y, base_x, p), i, signed(n)
                last_us = not_before(last_us, base + low, EVT3_BACK_US)
                t_out[n], x_out[n], y_out[n], p_out[n] = last_us, value & 0x7FF, y, value >> 11
                n += _ONE
        elif kind == _ADDR_Y:
            y = value & 0x7FF
        elif kind == TIME_LOW:
            low = value
        elif (_EVT3_SKIPPED >> kind) & 1:
            pass
        elif kind == TIME_HIGH:
            if not timed:
                timed, high, low, last_us = 1, value, 0, value << 12
                base = high << 12
            elif value != high & 0xFFF:
                high, low = unwrapped(high, value, 1 << 12), 0  # TIME_LOW belongs to the previous TIME_HIGH
                base = high << 12
        elif kind in (_VECT_12, _VECT_8):
            mask = value if kind == _VECT_12 else value & 0xFF
            if mask and timed and y >= 0 and base_x >= 0:
                if n > limit:
                    return Evt3State(timed, high, low, last_us, y, base_x, p), i, signed(n)
                last_us = not_before(last_us, base + low, EVT3_BACK_US)
                while mask:
                    x = base_x + _BIT[(mask & -mask) % 13]
                    t_out[n], x_out[n], y_out[n], p_out[n] = last_us, x, y, p
                    n += _ONE
                    mask &= mask - 1
            if base_x >= 0:
                base_x += 12 if kind == _VECT_12 else 8
        elif kind == _BASE_X:
            base_x, p = value & 0x7FF, value >> 11
        else:
            if not reserved[0]:
                reserved[1] = i
            reserved[0] += 1
    return Evt3State(timed, high, low, last_us, y, base_x, p), words.size, signed(n)


@compiled
def evt2_decode(
    words: NDArray[np.uint32], state: Evt2State, out: Events, reserved: NDArray[np.int64]
) -> tuple[Evt2State, int, int]:  # pragma: no cover (machine code)
    """Decode EVT2 words until they end or `out` is full; see `evt3_decode`.

    Time has 28 bits in TIME_HIGH and 6 bits in each event. It wraps every 4.77 h and is unwrapped.

    Source: docs.prophesee.ai, EVT 2.0 format.
    """
    timed, high, last_us = state
    n = 0
    for i in range(words.size):
        word = signed(words[i])
        kind = word >> 28
        if kind <= 1:
            if timed:
                if n == out.t.size:
                    return Evt2State(timed, high, last_us), i, n
                last_us = not_before(last_us, (high << 6) + ((word >> 22) & 0x3F), EVT2_BACK_US)
                out.t[n], out.x[n], out.y[n], out.p[n] = last_us, (word >> 11) & 0x7FF, word & 0x7FF, kind
                n += 1
        elif kind == TIME_HIGH:
            value = word & 0xFFF_FFFF
            high = unwrapped(high, value, 1 << 28) if timed else value
            if not timed:
                timed, last_us = 1, high << 6
        elif kind not in _EVT2_SKIPPED:
            if not reserved[0]:
                reserved[1] = i
            reserved[0] += 1
    return Evt2State(timed, high, last_us), words.size, n


def evt3_reference(words: NDArray[np.uint16], state: Evt3State) -> tuple[Evt3State, Events, list[int]]:
    """Reference implementation of `evt3_decode` without a limit on events: state, events, indices of reserved words."""
    s = state._asdict()
    events: list[tuple[int, int, int, int]] = []
    reserved: list[int] = []
    for i, word in enumerate(words.tolist()):
        value = word & 0xFFF
        hits: list[tuple[int, int]] = []  # x and polarity of this word's events
        match word >> 12:
            case 0x0:
                s["y"] = value & 0x7FF
            case 0x2:
                hits = [(value & 0x7FF, value >> 11)]
            case 0x3:
                s["base_x"], s["p"] = value & 0x7FF, value >> 11
            case 0x4 | 0x5 as kind:
                length = 12 if kind == 0x4 else 8
                if s["base_x"] >= 0:
                    hits = [(s["base_x"] + k, s["p"]) for k in range(length) if value >> k & 1]
                    s["base_x"] += length
            case 0x6:
                s["low"] = value
            case 0x8 if not s["timed"]:
                s.update(timed=1, high=value, low=0, last_us=value << 12)
            case 0x8:
                step = step_of(s["high"] % (1 << 12), value, 1 << 12)
                s.update(high=s["high"] + step, low=0 if step else s["low"])
            case 0x7 | 0xA | 0xE | 0xF:
                pass
            case _:
                reserved.append(i)
        if hits and s["timed"] and s["y"] >= 0:
            t_us = (s["high"] << 12) + s["low"]
            s["last_us"] = s["last_us"] if 0 < s["last_us"] - t_us < EVT3_BACK_US else t_us
            events += [(s["last_us"], x, s["y"], p) for x, p in hits]
    return Evt3State(**s), Events.from_columns(*(zip(*events, strict=True) if events else [()] * 4)), reserved


def evt2_reference(words: NDArray[np.uint32], state: Evt2State) -> tuple[Evt2State, Events, list[int]]:
    """Reference implementation of `evt2_decode`: state, events, indices of reserved words."""
    timed, high, last_us = state
    events: list[tuple[int, int, int, int]] = []
    reserved: list[int] = []
    for i, word in enumerate(words.tolist()):
        match word >> 28:
            case 0x0 | 0x1 as p if timed:
                t_us = (high << 6) + (word >> 22 & 0x3F)
                last_us = last_us if 0 < last_us - t_us < EVT2_BACK_US else t_us
                events.append((last_us, word >> 11 & 0x7FF, word & 0x7FF, p))
            case 0x8 if not timed:
                timed, high = 1, word & 0xFFF_FFFF
                last_us = high << 6
            case 0x8:
                high += step_of(high % (1 << 28), word & 0xFFF_FFFF, 1 << 28)
            case 0x0 | 0x1 | 0xA | 0xE | 0xF:
                pass
            case _:
                reserved.append(i)
    columns = zip(*events, strict=True) if events else [()] * 4
    return Evt2State(timed, high, last_us), Events.from_columns(*columns), reserved


def step_of(before: int, value: int, period: int) -> int:
    """Step of a counter from the value `before`.

    A decrease by up to STEP_BACK is a disturbance, also across a wrap. A larger one is a wrap if it comes from the top
    quarter of the range and ends in the bottom quarter. Any other decrease is a change of the clock, which is kept.
    """
    if value - before >= period - STEP_BACK:
        return value - before - period
    wraps = value - before < -STEP_BACK and before >= period // 4 * 3 and value < period // 4
    return value - before + (period if wraps else 0)
