"""Decoders of Prophesee EVT2.1 and EVT4 words: up to 32 events of one row, time and polarity in one vector.

Both have the clock of EVT2: 28 bits in TIME_HIGH [64 us] and 6 bits in each event [us].

EVT2.1: words of 64 bits. Bits 60 to 63 are the type.

| type | content |
| --- | --- |
| 0, 1 EVT_NEG, EVT_POS | time in bits 54-59, column x in 43-53, row y in 32-42; bit k < 32: an event at x + k |
| 8 TIME_HIGH | time in bits 32-59 |
| A EXT_TRIGGER | time in bits 54-59, channel in 40-44, level in bit 32 |
| E, F OTHERS, CONTINUED | monitoring |

Sources: docs.prophesee.ai/stable/data/encoding_formats/evt21.html; for the order `legacy` of the halves (IMX636: the
upper 32 bits come first) github.com/prophesee-ai/openeb, hal/cpp/include/metavision/hal/decoders/evt21.

EVT4: words of 32 bits. Bits 28 to 31 are the type.

| type | content |
| --- | --- |
| A, B CD_OFF, CD_ON | an event: time in bits 22-27, x in 11-21, y in 0-10 |
| C, D CD_VEC_OFF, CD_VEC_ON | as A and B; in the word that follows, bit k is an event at x + k |
| E TIME_HIGH | time in bits 0-27 |
| 9 EXT_TRIGGER | time in bits 22-27, channel in 8-12, level in bit 0 |
| 6, 7, F OTHERS, CONTINUED, PADDING | monitoring, and words without content |

Source: github.com/prophesee-ai/openeb, hal/cpp/include/metavision/hal/decoders/evt4 (evt4_event_types.h).
"""

from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from neurove_core.compiled import compiled
from neurove_core.io.formats.prophesee.evt import (
    EVT2_BACK_US,
    TIME_HIGH,
    Evt2State,
    not_before,
    signed,
    unwrapped,
)
from neurove_core.io.formats.prophesee.triggers import Columns, TriggerState, evt2_triggers
from neurove_protocol.events import Events

VECTOR_EVENTS: Final = 32
"""Maximum number of events in one vector. `out` must have space for at least as many."""

_HALF, _LOW = np.uint64(32), np.uint64(0xFFFF_FFFF)
_EVT21_SKIPPED = (0xA, 0xE, 0xF)  # EXT_TRIGGER, OTHERS, CONTINUED
_CD_OFF, _CD_ON, _VECTOR_OFF, _VECTOR_ON, _EVT4_TIME_HIGH, _EVT4_TRIGGER = 0xA, 0xB, 0xC, 0xD, 0xE, 0x9
_EVT4_SKIPPED = (0x6, 0x7, 0x9, 0xF)  # OTHERS, CONTINUED, EXT_TRIGGER, PADDING
_EVT2_TRIGGER = 0xA


class Evt4State(NamedTuple):
    """State of an EVT4 decoder between words. The default is for the start of a recording or after a gap."""

    timed: int = 0  # 1 after the first TIME_HIGH; before it events have no time and are ignored
    high: int = 0  # TIME_HIGH, unwrapped [64 us]
    last_us: int = 0  # time of the last event [us]
    pending: int = -1  # first word of a vector whose second word comes next; -1: none


class Evt4TriggerState(NamedTuple):
    """State of the search for triggers in EVT4 words."""

    pending: int = -1  # as in `Evt4State`
    edges: TriggerState = TriggerState()


def is_legacy(words: NDArray[np.uint64]) -> bool | None:
    """Whether the halves of EVT2.1 words are in the order `legacy`; None if these words do not show it.

    In the right order the words of TIME_HIGH have a lower half of zeros. In the other order no word of the camera does.
    """
    upper, lower = words >> _HALF, words & _LOW
    little = np.count_nonzero((upper >> np.uint64(28) == TIME_HIGH) & (lower == 0))
    legacy = np.count_nonzero((lower >> np.uint64(28) == TIME_HIGH) & (upper == 0))
    return None if little == legacy else bool(legacy > little)


def swapped(words: NDArray[np.uint64]) -> NDArray[np.uint64]:
    """The words with their halves exchanged."""
    return words >> _HALF | words << _HALF


@compiled
def evt21_decode(
    words: NDArray[np.uint64], state: Evt2State, out: Events, reserved: NDArray[np.int64]
) -> tuple[Evt2State, int, int]:  # pragma: no cover (machine code)
    """Decode EVT2.1 words, the upper half in the upper 32 bits, until they end or `out` is full; see `evt3_decode`."""
    timed, high, last_us = state
    n = 0
    if out.t.size < VECTOR_EVENTS:
        return state, 0, 0
    for i in range(words.size):
        word, mask = signed(words[i] >> _HALF), signed(words[i] & _LOW)
        kind = word >> 28
        if kind <= 1:
            if timed and mask:
                if n > out.t.size - VECTOR_EVENTS:
                    return Evt2State(timed, high, last_us), i, n
                last_us = not_before(last_us, (high << 6) + ((word >> 22) & 0x3F), EVT2_BACK_US)
                n = _spread(word, mask, last_us, out, n)
        elif kind == TIME_HIGH:
            value = word & 0xFFF_FFFF
            high = unwrapped(high, value, 1 << 28) if timed else value
            if not timed:
                timed, last_us = 1, high << 6
        elif kind not in _EVT21_SKIPPED:
            if not reserved[0]:
                reserved[1] = i
            reserved[0] += 1
    return Evt2State(timed, high, last_us), words.size, n


@compiled
def evt4_decode(
    words: NDArray[np.uint32], state: Evt4State, out: Events, reserved: NDArray[np.int64]
) -> tuple[Evt4State, int, int]:  # pragma: no cover (machine code)
    """Decode EVT4 words until they end or `out` is full; see `evt3_decode`."""
    timed, high, last_us, pending = state
    n = 0
    if out.t.size < VECTOR_EVENTS:
        return state, 0, 0
    for i in range(words.size):
        word = signed(words[i])
        kind = word >> 28
        if pending >= 0 or kind in (_CD_OFF, _CD_ON):
            first, mask = (pending, word) if pending >= 0 else (word, 1)
            if timed and mask:
                if n > out.t.size - VECTOR_EVENTS:
                    return Evt4State(timed, high, last_us, pending), i, n
                last_us = not_before(last_us, (high << 6) + ((first >> 22) & 0x3F), EVT2_BACK_US)
                n = _spread(first, mask, last_us, out, n)
            pending = -1
        elif kind in (_VECTOR_OFF, _VECTOR_ON):
            pending = word
        elif kind == _EVT4_TIME_HIGH:
            value = word & 0xFFF_FFFF
            high = unwrapped(high, value, 1 << 28) if timed else value
            if not timed:
                timed, last_us = 1, high << 6
        elif kind not in _EVT4_SKIPPED:
            if not reserved[0]:
                reserved[1] = i
            reserved[0] += 1
    return Evt4State(timed, high, last_us, pending), words.size, n


@compiled
def _spread(word: int, mask: int, t_us: int, out: Events, n: int) -> int:  # pragma: no cover (machine code)
    """Write the events of a vector after the first n, and return the new n. Bit 28 of the word is the polarity."""
    x, y, p = (word >> 11) & 0x7FF, word & 0x7FF, (word >> 28) & 1
    while mask:
        if mask & 1:
            out.t[n], out.x[n], out.y[n], out.p[n] = t_us, x, y, p
            n += 1
        x += 1
        mask >>= 1
    return n


def evt21_triggers(words: NDArray[np.uint64], state: TriggerState) -> tuple[TriggerState, Columns]:
    """Edges on the trigger inputs in EVT2.1 words: their upper halves have the layout of EVT2."""
    return evt2_triggers((words >> _HALF).astype(np.uint32), state)


def evt4_triggers(words: NDArray[np.uint32], state: Evt4TriggerState) -> tuple[Evt4TriggerState, Columns]:
    """Edges on the trigger inputs in EVT4 words; see `evt3_triggers`."""
    kept = np.empty(words.size, np.uint32)
    pending, n = _as_evt2(words, state.pending, kept)
    edges, columns = evt2_triggers(kept[:n], state.edges)
    return Evt4TriggerState(pending, edges), columns


@compiled
def _as_evt2(
    words: NDArray[Any], pending: int, out: NDArray[Any]
) -> tuple[int, int]:  # pragma: no cover (machine code)
    """Write the words of time and of triggers as EVT2 words. Return whether a vector has begun (0 or -1), and n."""
    n = 0
    for i in range(words.size):
        word = signed(words[i])
        kind, value = word >> 28, word & 0xFFF_FFFF
        if pending >= 0:
            pending = -1
        elif kind in (_VECTOR_OFF, _VECTOR_ON):
            pending = 0
        elif kind in (_EVT4_TIME_HIGH, _EVT4_TRIGGER):
            out[n] = (TIME_HIGH if kind == _EVT4_TIME_HIGH else _EVT2_TRIGGER) << 28 | value
            n += 1
    return pending, n
