"""Decoders of Prophesee EVT2 and EVT3 words: a compiled fast path and a reference implementation of each."""

from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from neurove_core.compiled import compiled
from neurove_protocol.events import Events

OK: Final = 0  # all words were read, or `out` is full: call again with the remaining words
ILLEGAL: Final = 1  # the next word has an unknown type
OUTSIDE: Final = 2  # the next word has an event outside the sensor; it is in `out` after the valid ones

STEP_BACK: Final = 10
"""Maximum decrease of TIME_HIGH that is not a wrap of its counter. Prophesee's own decoder has the same limit."""

VECTOR_EVENTS: Final = 12
"""Maximum number of events in one word. `out` must have space for at least as many."""

EVT2_WORDS: Final = (0x0, 0x1, 0x8, 0xA, 0xE, 0xF)
EVT3_WORDS: Final = (0x0, 0x2, 0x3, 0x4, 0x5, 0x6, 0x7, 0x8, 0xA, 0xE, 0xF)
"""Known word types, given by the first four bits."""

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
    """Unwrap a counter whose new value is `value`. A decrease by more than STEP_BACK is a wrap."""
    return high + (value - high + STEP_BACK) % period - STEP_BACK


@compiled
def evt3_decode(
    words: NDArray[np.uint16], state: Evt3State, width: int, height: int, out: Events
) -> tuple[Evt3State, int, int, int]:  # pragma: no cover (machine code)
    """Decode EVT3 words until they end, `out` is full, or a word cannot be used.

    The camera's clock has 24 bits [us] and wraps every 16.777 s; the times are unwrapped. TIME_HIGH sometimes decreases
    by up to STEP_BACK without a wrap. Output times never decrease: an event at such a moment gets the time of the event
    before it. Triggers, monitoring words, and events before the first TIME_HIGH are skipped.

    Source: docs.prophesee.ai, EVT 3.0 format.

    Args:
        words: (N,) words from the camera.
        state: state after the words before these.
        width: width of the sensor [px].
        height: height of the sensor [px].
        out: columns of equal length, at least VECTOR_EVENTS, for the events.

    Returns:
        The state after the words read, the number of words read, the number of events in `out`, and OK, ILLEGAL or
        OUTSIDE. The state is valid only after OK.
    """
    timed, high, low, last_us, y, base_x, p = state
    t_out, x_out, y_out, p_out = out
    if t_out.size < VECTOR_EVENTS:  # a negative limit would become a huge unsigned number
        return state, 0, 0, OK
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
                    return Evt3State(timed, high, low, last_us, y, base_x, p), i, signed(n), OK
                last_us = max(last_us, base + low)
                x = value & 0x7FF
                t_out[n], x_out[n], y_out[n], p_out[n] = last_us, x, y, value >> 11
                if (x >= width) | (y >= height):
                    return Evt3State(timed, high, low, last_us, y, base_x, p), i, signed(n), OUTSIDE
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
                    return Evt3State(timed, high, low, last_us, y, base_x, p), i, signed(n), OK
                last_us = max(last_us, base + low)
                while mask:
                    x = base_x + _BIT[(mask & -mask) % 13]
                    t_out[n], x_out[n], y_out[n], p_out[n] = last_us, x, y, p
                    if (x >= width) | (y >= height):
                        return Evt3State(timed, high, low, last_us, y, base_x, p), i, signed(n), OUTSIDE
                    n += _ONE
                    mask &= mask - 1
            if base_x >= 0:
                base_x += 12 if kind == _VECT_12 else 8
        elif kind == _BASE_X:
            base_x, p = value & 0x7FF, value >> 11
        else:
            return Evt3State(timed, high, low, last_us, y, base_x, p), i, signed(n), ILLEGAL
    return Evt3State(timed, high, low, last_us, y, base_x, p), words.size, signed(n), OK


@compiled
def evt2_decode(
    words: NDArray[np.uint32], state: Evt2State, width: int, height: int, out: Events
) -> tuple[Evt2State, int, int, int]:  # pragma: no cover (machine code)
    """Decode EVT2 words until they end, `out` is full, or a word cannot be used.

    Time has 28 bits in TIME_HIGH and 6 bits in each event. It wraps every 4.77 h and is unwrapped. As in `evt3_decode`,
    output times never decrease, and events before the first TIME_HIGH are skipped.

    Source: docs.prophesee.ai, EVT 2.0 format.

    Args:
        words: (N,) words from the camera.
        state: state after the words before these.
        width: width of the sensor [px].
        height: height of the sensor [px].
        out: columns of equal length for the events.

    Returns:
        As `evt3_decode`.
    """
    timed, high, last_us = state
    n = 0
    for i in range(words.size):
        word = signed(words[i])
        kind = word >> 28
        if kind <= 1:
            if timed:
                if n == out.t.size:
                    return Evt2State(timed, high, last_us), i, n, OK
                x, y = (word >> 11) & 0x7FF, word & 0x7FF
                last_us = max(last_us, (high << 6) + ((word >> 22) & 0x3F))
                out.t[n], out.x[n], out.y[n], out.p[n] = last_us, x, y, kind
                if x >= width or y >= height:
                    return Evt2State(timed, high, last_us), i, n, OUTSIDE
                n += 1
        elif kind == TIME_HIGH:
            value = word & 0xFFF_FFFF
            high = unwrapped(high, value, 1 << 28) if timed else value
            if not timed:
                timed, last_us = 1, high << 6
        elif kind not in _EVT2_SKIPPED:
            return Evt2State(timed, high, last_us), i, n, ILLEGAL
    return Evt2State(timed, high, last_us), words.size, n, OK


def evt3_reference(
    words: NDArray[np.uint16], state: Evt3State, width: int, height: int
) -> tuple[Evt3State, int, Events, int]:
    """Reference implementation of `evt3_decode` without a limit on events: state, words read, events, verdict."""
    s = state._asdict()
    events: list[tuple[int, int, int, int]] = []

    def done(read: int, verdict: int) -> tuple[Evt3State, int, Events, int]:
        return Evt3State(**s), read, Events.from_columns(*(zip(*events, strict=True) if events else [()] * 4)), verdict

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
                step = step_of(value - s["high"] % (1 << 12), 1 << 12)
                s.update(high=s["high"] + step, low=0 if step else s["low"])
            case 0x7 | 0xA | 0xE | 0xF:
                pass
            case _:
                return done(i, ILLEGAL)
        if hits and s["timed"] and s["y"] >= 0:
            s["last_us"] = max(s["last_us"], (s["high"] << 12) + s["low"])
            for x, p in hits:
                if x >= width or s["y"] >= height:
                    return done(i, OUTSIDE)
                events.append((s["last_us"], x, s["y"], p))
    return done(words.size, OK)


def evt2_reference(
    words: NDArray[np.uint32], state: Evt2State, width: int, height: int
) -> tuple[Evt2State, int, Events, int]:
    """Reference implementation of `evt2_decode`, vectorised over all words: state, words read, events, verdict."""
    kinds = words >> 28
    known = np.isin(kinds, EVT2_WORDS)
    read, verdict = (words.size, OK) if known.all() else (int(np.argmin(known)), ILLEGAL)

    ticks = np.flatnonzero(kinds[:read] == 0x8)
    highs = [state.high]
    for value in (words[ticks] & 0xFFF_FFFF).tolist():
        first = len(highs) == 1 and not state.timed
        highs.append(value if first else highs[-1] + step_of(value - highs[-1] % (1 << 28), 1 << 28))
    floor_us = state.last_us if state.timed or not ticks.size else highs[1] << 6

    at = np.flatnonzero(kinds[:read] <= 1)
    if not state.timed:
        at = at[at > ticks[0]] if ticks.size else at[:0]
    cd = words[at].astype(np.int64)
    t = (np.array(highs)[np.searchsorted(ticks, at)] << 6) + (cd >> 22 & 0x3F)
    events = Events.from_columns(
        np.maximum.accumulate(np.maximum(t, floor_us)), cd >> 11 & 0x7FF, cd & 0x7FF, kinds[at]
    )
    outside = np.flatnonzero((events.x >= width) | (events.y >= height))
    if outside.size:
        read, verdict, events = int(at[outside[0]]), OUTSIDE, events.span(0, int(outside[0]))
    last_us = int(events.t[-1]) if events.n else floor_us
    return Evt2State(int(state.timed or ticks.size > 0), highs[-1], last_us), read, events, verdict


def step_of(difference: int, period: int) -> int:
    """Step of a counter with this difference of values. A decrease by more than STEP_BACK is a wrap."""
    if difference < -STEP_BACK:
        return difference + period
    return difference - period if difference >= period - STEP_BACK else difference
