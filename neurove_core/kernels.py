"""The hot loops, each compiled, beside its plain reference.

A kernel is a pure function: state goes in and comes out as a named tuple, arrays are read or filled, nothing is kept.
It is compiled by numba on first use, cached on disk, and runs without the GIL. Its reference (`*_reference`) does the
same in plain Python or numpy, written for reading; tests hold the two together bit for bit.
"""

from collections.abc import Callable
from typing import Any, Final, NamedTuple, ParamSpec, TypeVar, cast

import numba
import numpy as np
from numpy.typing import NDArray

from neurove_core.geometry import OUTSIDE as NO_CELL
from protocol.events import Events

P = ParamSpec("P")
R = TypeVar("R")


def compiled(function: Callable[P, R]) -> Callable[P, R]:
    """The function as machine code with the same signature; numba itself is untyped."""
    try:
        return cast("Callable[P, R]", numba.njit(nogil=True, cache=True)(function))
    except RuntimeError:  # nowhere to write a cache, as in a read-only image: compiled anew at each start
        return cast("Callable[P, R]", numba.njit(nogil=True)(function))


# --- binning: events -> counts of a window ---------------------------------------------------------------------------


def count_events(events: Events, start_us: int, bin_us: int, lut: NDArray[np.int32], counts: NDArray[np.uint8]) -> int:
    """Add events to a window's counts, in place, saturating at 255.

    Args:
        events: all with start_us <= t < start_us + n * bin_us, on the sensor of `lut`.
        start_us: of the window.
        bin_us: length of one of its n bins.
        lut: (sensor.height, sensor.width) cell of each pixel, or geometry.OUTSIDE.
        counts: (2n, H, W), changed.

    Returns:
        how many of the events no cell sees.
    """
    cells = counts.shape[1] * counts.shape[2]
    return _count(events, start_us, bin_us, lut, cells, counts.reshape(-1))


def count_events_reference(
    events: Events, start_us: int, bin_us: int, lut: NDArray[np.int32], counts: NDArray[np.uint8]
) -> int:
    """What count_events computes, in plain numpy."""
    cell = lut[events.y, events.x]
    seen = cell != NO_CELL
    channel = 2 * ((events.t - start_us) // bin_us) + (events.p > 0)
    index = channel[seen] * (counts.shape[1] * counts.shape[2]) + cell[seen]
    added = np.bincount(index, minlength=counts.size).reshape(counts.shape)
    counts[:] = np.minimum(counts + added, 255).astype(np.uint8)
    return int((~seen).sum())


_BLOCK: Final = 512  # events whose cells are looked up together: a loop that the compiler turns into vectors


@compiled
def _count(
    events: Events, start_us: int, bin_us: int, lut: NDArray[np.int32], cells: int, flat: NDArray[np.uint8]
) -> int:  # pragma: no cover (machine code)
    """Bin by bin: its last event by bisection instead of a division per event, then looked up and added in blocks."""
    t, x, y, p = events.t, events.x, events.y, events.p
    pixels, columns = lut.reshape(-1), np.uint32(lut.shape[1])
    on, end = np.uint32(cells), np.uint32(2 * cells)
    found = np.empty(_BLOCK, np.uint32)
    outside, first = 0, 0
    for bin_ in range(flat.size // (2 * cells)):
        last = first + int(np.searchsorted(t[first:], np.int64(start_us + (bin_ + 1) * bin_us)))
        pair = flat[2 * bin_ * cells : (2 * bin_ + 2) * cells]
        for i in range(first, last, _BLOCK):
            m = min(_BLOCK, last - i)
            xs, ys, ps = x[i : i + m], y[i : i + m], p[i : i + m]
            for j in range(m):
                found[j] = np.uint32(ys[j]) * columns + np.uint32(xs[j])
            for j in range(m):
                cell = np.int32(pixels[found[j]])
                found[j] = np.uint32(cell) + on * np.uint32(ps[j] != 0) * np.uint32(cell >= 0)
            for j in range(m):
                k = found[j]
                if k >= end:  # OUTSIDE, -1, is the largest of all
                    outside += 1
                    continue
                pair[k] += np.uint8(pair[k] < 255)
        first = last
    return outside


# --- Prophesee EVT2 and EVT3: camera words -> events -----------------------------------------------------------------

OK: Final = 0  # every word was read, or `out` is full: call again with the words that were not
ILLEGAL: Final = 1  # the next word is of no known type
OUTSIDE: Final = 2  # the next word holds an event that is not on the sensor; it stands in `out`, after the good ones

STEP_BACK: Final = 10
"""How far TIME_HIGH may step back without that being a wrap of its counter; what Prophesee's own decoder allows."""

VECTOR_EVENTS: Final = 12
"""Most events that one word makes; `out` must have at least this much room."""

_ADDR_Y, _ADDR_X, _BASE_X, _VECT_12, _VECT_8, _TIME_LOW, _TIME_HIGH = 0, 2, 3, 4, 5, 6, 8
_EVT3_SKIPPED = (0x7, 0xA, 0xE, 0xF)  # CONTINUED_4, EXT_TRIGGER, OTHERS, CONTINUED_12
_EVT2_SKIPPED = (0xA, 0xE, 0xF)  # EXT_TRIGGER, OTHERS, CONTINUED


class Evt3State(NamedTuple):
    """What an EVT3 decoder carries from word to word; the default is the start of a recording or what follows a gap."""

    timed: int = 0  # 1 from the first TIME_HIGH on; before it events have no time and are ignored
    high: int = 0  # TIME_HIGH, counted on over its wraps [4096 us]
    low: int = 0  # TIME_LOW [us]
    last_us: int = 0  # time of the last event [us]
    y: int = -1  # row [px], -1 before the first one
    base_x: int = -1  # column of the next vector [px], -1 before the first one
    p: int = 0  # polarity of the vectors


class Evt2State(NamedTuple):
    """What an EVT2 decoder carries from word to word; the default is the start of a recording or what follows a gap."""

    timed: int = 0  # 1 from the first TIME_HIGH on; before it events have no time and are ignored
    high: int = 0  # TIME_HIGH, counted on over its wraps [64 us]
    last_us: int = 0  # time of the last event [us]


@compiled
def _signed(word: np.unsignedinteger[Any]) -> int:  # pragma: no cover (machine code)
    return np.int64(word)  # type: ignore[return-value]  # int() would stay unsigned in numba, and mix to float


@compiled
def _counted_on(high: int, value: int, period: int) -> int:  # pragma: no cover (machine code)
    return high + (value - high + STEP_BACK) % period - STEP_BACK


@compiled
def evt3_decode(
    words: NDArray[np.uint16], state: Evt3State, width: int, height: int, out: Events
) -> tuple[Evt3State, int, int, int]:  # pragma: no cover (machine code)
    """Decode EVT3 words until they end, `out` is full, or a word can not be used.

    The camera's clock is 24 bits of us, wraps every 16.777 s and is counted on. TIME_HIGH sometimes steps back a little
    (up to STEP_BACK) without a wrap; emitted times never run backwards: an event from such a moment carries the time of
    the event before it. Triggers and monitoring words are skipped, and so is what precedes the first TIME_HIGH.

    Source: docs.prophesee.ai, EVT 3.0 format.

    Args:
        words: (N,) words as the camera wrote them.
        state: of the words before these.
        width: of the sensor [px].
        height: of the sensor [px].
        out: columns of one length, at least VECTOR_EVENTS, to write events into.

    Returns:
        The state after the words read, how many words were read, how many events lie in `out`, and OK, ILLEGAL or
        OUTSIDE. After anything but OK the state is of no more use.
    """
    timed, high, low, last_us, y, base_x, p = state
    n = 0
    for i in range(words.size):
        word = _signed(words[i])
        kind, value = word >> 12, word & 0xFFF
        x, mask, polarity = base_x, 0, p
        if kind == _ADDR_X:
            x, mask, polarity = value & 0x7FF, 1, value >> 11
        elif kind == _VECT_12:
            mask = value
        elif kind == _VECT_8:
            mask = value & 0xFF
        elif kind == _ADDR_Y:
            y = value & 0x7FF
        elif kind == _BASE_X:
            base_x, p = value & 0x7FF, value >> 11
        elif kind == _TIME_LOW:
            low = value
        elif kind == _TIME_HIGH:
            counted = _counted_on(high, value, 1 << 12) if timed else value
            if counted != high or not timed:  # the old TIME_LOW belongs to the old TIME_HIGH
                low = 0
            if not timed:
                timed, last_us = 1, counted << 12
            high = counted
        elif kind not in _EVT3_SKIPPED:
            return Evt3State(timed, high, low, last_us, y, base_x, p), i, n, ILLEGAL
        if mask and timed and y >= 0 and x >= 0:
            if n + VECTOR_EVENTS > out.t.size:
                return Evt3State(timed, high, low, last_us, y, base_x, p), i, n, OK
            last_us = max(last_us, (high << 12) + low)
            while mask:
                if mask & 1:
                    out.t[n], out.x[n], out.y[n], out.p[n] = last_us, x, y, polarity
                    if x >= width or y >= height:
                        return Evt3State(timed, high, low, last_us, y, base_x, p), i, n, OUTSIDE
                    n += 1
                x += 1
                mask >>= 1
        if base_x >= 0 and kind in (_VECT_12, _VECT_8):
            base_x += 12 if kind == _VECT_12 else 8
    return Evt3State(timed, high, low, last_us, y, base_x, p), words.size, n, OK


@compiled
def evt2_decode(
    words: NDArray[np.uint32], state: Evt2State, width: int, height: int, out: Events
) -> tuple[Evt2State, int, int, int]:  # pragma: no cover (machine code)
    """Decode EVT2 words until they end, `out` is full, or a word can not be used.

    Time is 28 bits of TIME_HIGH and 6 bits in each event, wraps every 4.77 h and is counted on; it never runs
    backwards, and what precedes the first TIME_HIGH is skipped, as in `evt3_decode`.

    Source: docs.prophesee.ai, EVT 2.0 format.

    Args:
        words: (N,) words as the camera wrote them.
        state: of the words before these.
        width: of the sensor [px].
        height: of the sensor [px].
        out: columns of one length to write events into.

    Returns:
        As `evt3_decode`.
    """
    timed, high, last_us = state
    n = 0
    for i in range(words.size):
        word = _signed(words[i])
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
        elif kind == _TIME_HIGH:
            value = word & 0xFFF_FFFF
            high = _counted_on(high, value, 1 << 28) if timed else value
            if not timed:
                timed, last_us = 1, high << 6
        elif kind not in _EVT2_SKIPPED:
            return Evt2State(timed, high, last_us), i, n, ILLEGAL
    return Evt2State(timed, high, last_us), words.size, n, OK


def evt3_reference(
    words: NDArray[np.uint16], state: Evt3State, width: int, height: int
) -> tuple[Evt3State, int, Events, int]:
    """The plain twin of `evt3_decode`, with room for any number of events: state, words read, events, verdict."""
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
                step = _step(value - s["high"] % (1 << 12), 1 << 12)
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
    """The plain twin of `evt2_decode`, all words at once: state, words read, events, verdict."""
    kinds = words >> 28
    known = np.isin(kinds, (0x0, 0x1, 0x8, 0xA, 0xE, 0xF))
    read, verdict = (words.size, OK) if known.all() else (int(np.argmin(known)), ILLEGAL)

    ticks = np.flatnonzero(kinds[:read] == 0x8)
    highs = [state.high]
    for value in (words[ticks] & 0xFFF_FFFF).tolist():
        first = len(highs) == 1 and not state.timed
        highs.append(value if first else highs[-1] + _step(value - highs[-1] % (1 << 28), 1 << 28))
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


def _step(difference: int, period: int) -> int:
    """How far a counter went that shows this difference: a little back is back, more is once around."""
    if difference < -STEP_BACK:
        return difference + period
    return difference - period if difference >= period - STEP_BACK else difference
