"""Compressed words of the ROS libcaer driver -> events: a compiled decoder and its reference implementation.

The words are little-endian and have 16 bits. The upper four bits are the type:

| type | meaning of the lower twelve bits |
| --- | --- |
| 0 TIME_HIGH | time since the packet's time base, in units of 4096 us |
| 1 TIME_LOW | the same time modulo 4096 us [us] |
| 2 ADDR_X | bits 0-10: column of the next events [px] |
| 3 ADDR_Y | an event; bits 0-10: row [px], bit 11: polarity |
| 4 VECT_BASE_Y | no event; base row and polarity of the next vectors, bits as in ADDR_Y |
| 5 VECT_8 | bits 0-7: an event for each set bit, in the 8 rows from the base; then the base increases by 8 |

The format is EVT3 with rows and columns exchanged. Only the column and the base (row and polarity) carry over from one
packet to the next. Source: event_camera_codecs of ros-event-camera, encoding `libcaer_cmp`.
"""

from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from neurove_core.compiled import compiled
from neurove_protocol.events import Events

WORD_EVENTS: Final = 8
"""Maximum events of one word: `out` needs this many rows for each word."""

_TIME_HIGH, _TIME_LOW, _ADDR_X, _ADDR_Y, _BASE_Y, _VECT_8 = range(6)


class LibcaerState(NamedTuple):
    """State between words. The default applies at the start of a recording and after a gap."""

    x: int = -1  # column [px], -1 before the first word that sets it
    base_y: int = -1  # row of the next vector [px], -1 before the first word that sets it
    p: int = 0  # polarity of the next vectors
    high: int = 0  # TIME_HIGH [us]; 0 at the start of a packet
    low: int = 0  # TIME_LOW [us]; 0 at the start of a packet


@compiled
def signed(word: np.unsignedinteger[Any]) -> int:  # pragma: no cover (machine code)
    """Return the number as a signed integer, which other integers can be combined with."""
    return np.int64(word)  # type: ignore[return-value]  # numba keeps int() unsigned, and mixes it to float


@compiled
def libcaer_decode(
    words: NDArray[np.uint16], state: LibcaerState, base_us: int, out: Events, reserved: NDArray[np.int64]
) -> tuple[LibcaerState, int]:  # pragma: no cover (machine code)
    """Decode words of one packet. Words of a reserved type are skipped.

    Args:
        words: (N,) uint16; all words of the packet or some of them.
        state: state after the words before these.
        base_us: the packet's time base [us].
        out: output columns with at least WORD_EVENTS * N rows; neither times nor coordinates are checked.
        reserved: (2,) number of reserved words and index of the first one, as in `evt3_decode`.

    Returns:
        State after the words, and number of events in `out`.
    """
    x, base_y, p, high, low = state
    n = 0
    for i in range(words.size):
        word = signed(words[i])
        kind, value = word >> 12, word & 0xFFF
        y, mask, polarity = base_y, 0, p
        if kind == _ADDR_Y:
            y, mask, polarity = value & 0x7FF, 1, value >> 11
        elif kind == _VECT_8:
            mask = value & 0xFF
        elif kind == _ADDR_X:
            x = value & 0x7FF
        elif kind == _TIME_LOW:
            low = value
        elif kind == _TIME_HIGH:
            high = value << 12
        elif kind == _BASE_Y:
            base_y, p = value & 0x7FF, value >> 11
        else:
            if not reserved[0]:
                reserved[1] = i
            reserved[0] += 1
        if mask and x >= 0 and y >= 0:
            while mask:
                if mask & 1:
                    out.t[n], out.x[n], out.y[n], out.p[n] = base_us + high + low, x, y, polarity
                    n += 1
                y += 1
                mask >>= 1
        if base_y >= 0 and kind == _VECT_8:
            base_y += 8
    return LibcaerState(x, base_y, p, high, low), n


def libcaer_reference(
    words: NDArray[np.uint16], state: LibcaerState, base_us: int
) -> tuple[LibcaerState, Events, list[int]]:
    """Reference implementation of `libcaer_decode`: state, events, indices of reserved words."""
    s = state._asdict()
    events: list[tuple[int, int, int, int]] = []
    reserved: list[int] = []
    for i, word in enumerate(words.tolist()):
        value, hits = word & 0xFFF, []
        match word >> 12:
            case 0:
                s["high"] = value << 12
            case 1:
                s["low"] = value
            case 2:
                s["x"] = value & 0x7FF
            case 3:
                hits = [(value & 0x7FF, value >> 11)]
            case 4:
                s["base_y"], s["p"] = value & 0x7FF, value >> 11
            case 5:
                if s["base_y"] >= 0:
                    hits = [(s["base_y"] + k, s["p"]) for k in range(8) if value >> k & 1]
                    s["base_y"] += 8
            case _:
                reserved.append(i)
        if s["x"] >= 0:
            events += [(base_us + s["high"] + s["low"], s["x"], y, p) for y, p in hits]
    columns = zip(*events, strict=True) if events else [()] * 4
    return LibcaerState(**s), Events.from_columns(*columns), reserved
