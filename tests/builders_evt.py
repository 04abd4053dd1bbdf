"""A tiny writer of EVT2, EVT2.1, EVT3 and EVT4: events -> words, and after how many words each event is complete."""

from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from neurove_protocol import Events

ADDR_Y, ADDR_X, BASE_X, VECT_12, VECT_8, TIME_LOW, TIME_HIGH = 0, 2, 3, 4, 5, 6, 8
TRIGGER, OTHERS = 0xA, 0xE

HEADER_EVT2 = b"% date 2020-09-25 07:48:31\n% evt 2.0\n% geometry 64x48\n"
HEADER_EVT21 = b"% camera_integrator_name Prophesee\n% format EVT21;height=48;width=64\n"
HEADER_EVT4 = b"% format EVT4;height=48;width=64\n% geometry 64x48\n% end\n"
HEADER_EVT3 = b"% evt 3.0\n% format EVT3;height=48;width=64\n% end\n"


class Written(NamedTuple):
    words: NDArray[np.unsignedinteger]
    ends: NDArray[np.intp]  # (N,) number of words after which event i is complete

    def complete(self, words: int) -> int:
        """How many events the first `words` words hold."""
        return int(np.searchsorted(self.ends, words, "right"))


def evt3(*words: tuple[int, int]) -> NDArray[np.uint16]:
    """Words from (type, value) pairs."""
    return np.array([kind << 12 | value for kind, value in words], np.uint16)


def evt2(*words: tuple[int, int]) -> NDArray[np.uint32]:
    """Words from (type, value) pairs."""
    return np.array([kind << 28 | value for kind, value in words], np.uint32)


def cd(t6: int, x: int, y: int) -> int:
    """The value of an EVT2 event word."""
    return t6 << 22 | x << 11 | y


def highs(before: int | None, after: int, period: int) -> list[int]:
    """The TIME_HIGH values that a camera shows between two moments, none of them a step that could be a glitch."""
    if before is None:
        return [after % period]
    return [high % period for high in (*range(before, after, period // 8), after)[1:]]


def write_evt3(events: Events) -> Written:
    """Rows of equal time, row and polarity become vectors (8 wide where that is enough), single events addresses."""
    words: list[tuple[int, int]] = []
    ends: list[int] = []
    high = low = row = None
    columns = list(zip(*(column.tolist() for column in events), strict=True))
    starts = [0] + [i for i in range(1, len(columns)) if not _continues(columns[i - 1], columns[i])]
    for first, stop in pairwise([*starts, len(columns)] if columns else []):
        t, x, y, p = columns[first]
        if t >> 12 != high:
            words += [(TIME_HIGH, value) for value in highs(high, t >> 12, 1 << 12)]
            high, low = t >> 12, None
        if t & 0xFFF != low:
            low = t & 0xFFF
            words += [(TIME_LOW, low), (TRIGGER, 1)]
        if y != row:
            row = y
            words += [(ADDR_Y, y)]
        if stop - first == 1:
            words += [(ADDR_X, p << 11 | x)]
            ends.append(len(words))
            continue
        words += [(BASE_X, p << 11 | x)]
        xs = [column[1] - x for column in columns[first:stop]]
        base = 0
        while xs:
            kind, width = (VECT_8, 8) if xs[-1] - base < 8 else (VECT_12, 12)
            now, xs = [k for k in xs if k < base + width], [k for k in xs if k >= base + width]
            words += [(kind, sum(1 << (k - base) for k in now))]
            ends += [len(words)] * len(now)
            base += width
    return Written(evt3(*words), np.array(ends, np.intp))


def _continues(a: tuple[int, int, int, int], b: tuple[int, int, int, int]) -> bool:
    return (a[0], a[2], a[3]) == (b[0], b[2], b[3]) and a[1] < b[1]


def write_evt2(events: Events) -> Written:
    words: list[tuple[int, int]] = []
    ends: list[int] = []
    high = None
    for t, x, y, p in zip(*(column.tolist() for column in events), strict=True):
        if t >> 6 != high:
            words += [(TIME_HIGH, value) for value in highs(high, t >> 6, 1 << 28)] + [(OTHERS, 7)]
            high = t >> 6
        words.append((p, cd(t & 0x3F, x, y)))
        ends.append(len(words))
    return Written(evt2(*words), np.array(ends, np.intp))


def _vectors(events: Events) -> list[tuple[int, int, int, int, int]]:
    """Time, first column, row, polarity and mask of up to 32 neighbours that follow each other."""
    found: list[tuple[int, int, int, int, int]] = []
    before = None
    for t, x, y, p in zip(*(column.tolist() for column in events), strict=True):
        same = before is not None and _continues(before, (t, x, y, p)) and x - found[-1][1] < 32
        if same:
            t0, x0, *others, mask = found.pop()
            found.append((t0, x0, *others, mask | 1 << x - x0))
        else:
            found.append((t, x, y, p, 1))
        before = (t, x, y, p)
    return found


def write_evt21(events: Events) -> Written:
    """Words with the upper half in the upper 32 bits."""
    words: list[int] = []
    ends: list[int] = []
    high = None
    for t, x, y, p, mask in _vectors(events):
        if t >> 6 != high:
            words += [(TIME_HIGH << 28 | value) << 32 for value in highs(high, t >> 6, 1 << 28)]
            words.append((OTHERS << 28 | 7) << 32 | 0xFFFF_FFFF)
            high = t >> 6
        words.append((p << 28 | cd(t & 0x3F, x, y)) << 32 | mask)
        ends += [len(words)] * mask.bit_count()
    return Written(np.array(words, np.uint64), np.array(ends, np.intp))


def legacy(words: NDArray[np.uint64]) -> NDArray[np.uint64]:
    """EVT2.1 words as an IMX636 sends them."""
    return words.view(np.uint32).reshape(-1, 2)[:, ::-1].copy().view(np.uint64).ravel()


def write_evt4(events: Events) -> Written:
    """Single events as one word, the others as a vector of two words."""
    words: list[int] = []
    ends: list[int] = []
    high = None
    for t, x, y, p, mask in _vectors(events):
        if t >> 6 != high:
            words += [0xE << 28 | value for value in highs(high, t >> 6, 1 << 28)]
            words += [0xFFFF_FFFF, 0x6 << 28 | 0x14, 0x7 << 28 | 3]  # PADDING, OTHERS, CONTINUED
            high = t >> 6
        words += [(0xA | p) << 28 | cd(t & 0x3F, x, y)] if mask == 1 else [(0xC | p) << 28 | cd(t & 0x3F, x, y), mask]
        ends += [len(words)] * mask.bit_count()
    return Written(np.array(words, np.uint32), np.array(ends, np.intp))
