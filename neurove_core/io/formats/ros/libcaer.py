"""The compressed words of ROS's libcaer driver -> events: a kernel beside its plain reference, as in `kernels`.

Little-endian words of 16 bits, the type in the upper four:

| type | meaning of the lower twelve bits |
| --- | --- |
| 0 TIME_HIGH | time since the packet's time base, in units of 4096 us |
| 1 TIME_LOW | the same, rest of it [us] |
| 2 ADDR_X | bits 0-10: column of what follows [px] |
| 3 ADDR_Y | bits 0-10: row [px], bit 11: polarity; an event |
| 4 VECT_BASE_Y | as ADDR_Y, but only the base of the vectors that follow |
| 5 VECT_8 | bits 0-7: an event in each of the 8 rows from the base on whose bit is set; the base moves on by 8 |

It is EVT3 with rows and columns exchanged. A packet carries no state into the next one but the column and the base.
Source: event_camera_codecs of ros-event-camera, where it is `libcaer_cmp`.
"""

from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from neurove_core.compiled import compiled
from neurove_core.io.formats.prophesee.evt import ILLEGAL, OK, OUTSIDE
from neurove_protocol.events import Events

WORD_EVENTS: Final = 8
"""Most events that one word makes: `out` needs this many places a word."""

_TIME_HIGH, _TIME_LOW, _ADDR_X, _ADDR_Y, _BASE_Y, _VECT_8 = range(6)


class LibcaerState(NamedTuple):
    """What goes from word to word; the default is the start of a recording or what follows a gap."""

    x: int = -1  # column [px], -1 before the first one
    base_y: int = -1  # row of the next vector [px], -1 before the first one
    p: int = 0  # polarity of the vectors
    high: int = 0  # TIME_HIGH [us]; a packet begins at 0
    low: int = 0  # TIME_LOW [us]; a packet begins at 0


@compiled
def signed(word: np.unsignedinteger[Any]) -> int:  # pragma: no cover (machine code)
    """The same number as a signed integer, which mixes with others."""
    return np.int64(word)  # type: ignore[return-value]  # int() would stay unsigned in numba, and mix to float


@compiled
def libcaer_decode(
    words: NDArray[np.uint16], state: LibcaerState, base_us: int, width: int, height: int, out: Events
) -> tuple[LibcaerState, int, int, int]:  # pragma: no cover (machine code)
    """Decode words of one packet, up to the first that can not be used.

    Args:
        words: (N,) words of the packet, all or some of them.
        state: of the words before these.
        base_us: the packet's time base [us].
        width: of the sensor [px].
        height: of the sensor [px].
        out: columns of at least WORD_EVENTS * N places to write events into; times are as the words have them.

    Returns:
        The state after the words, how many words were read, how many events lie in `out`, and kernels.OK, ILLEGAL or
        OUTSIDE; in the last case the event that is outside lies in `out`, after the good ones.
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
            return LibcaerState(x, base_y, p, high, low), i, n, ILLEGAL
        if mask and x >= 0 and y >= 0:
            while mask:
                if mask & 1:
                    out.t[n], out.x[n], out.y[n], out.p[n] = base_us + high + low, x, y, polarity
                    if x >= width or y >= height:
                        return LibcaerState(x, base_y, p, high, low), i, n, OUTSIDE
                    n += 1
                y += 1
                mask >>= 1
        if base_y >= 0 and kind == _VECT_8:
            base_y += 8
    return LibcaerState(x, base_y, p, high, low), words.size, n, OK


def libcaer_reference(
    words: NDArray[np.uint16], state: LibcaerState, base_us: int, width: int, height: int
) -> tuple[LibcaerState, int, Events, int]:
    """The plain twin of `libcaer_decode`: state, words read, events, verdict."""
    s = state._asdict()
    events: list[tuple[int, int, int, int]] = []

    def done(read: int, verdict: int) -> tuple[LibcaerState, int, Events, int]:
        return LibcaerState(**s), read, Events.from_columns(*zip(*events, strict=True) if events else [()] * 4), verdict

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
                return done(i, ILLEGAL)
        for y, p in hits if s["x"] >= 0 else []:
            if s["x"] >= width or y >= height:
                return done(i, OUTSIDE)
            events.append((base_us + s["high"] + s["low"], s["x"], y, p))
    return done(words.size, OK)
