"""A tiny writer of Prophesee words: events -> EVT2 or EVT3, and after how many words each event is complete."""

from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from neurove_protocol import Events

ADDR_Y, ADDR_X, BASE_X, VECT_12, VECT_8, TIME_LOW, TIME_HIGH = 0, 2, 3, 4, 5, 6, 8
TRIGGER, OTHERS = 0xA, 0xE

HEADER_EVT2 = b"% date 2020-09-25 07:48:31\n% evt 2.0\n% geometry 64x48\n"
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
