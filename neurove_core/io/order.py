"""Order: a filter that keeps the samples of a stream ordered by time, whatever the recording's clock did."""

from collections.abc import Callable, Iterator
from itertools import pairwise
from typing import Any, Final, Generic, Protocol, TypeVar, cast

import numpy as np
from numpy.typing import NDArray

from neurove_core.io.faults import Reason, Tally

MAX_GAP_US: Final = 10_000_000
"""A longer span without samples is reported as a gap, and is skipped in playback."""

RESTART_US: Final = 1_000_000
"""A step back by more than this can be a restart of the clock. A smaller one makes samples late."""

CONFIRM: Final = 256
"""Samples that must follow a step of the clock before it is believed."""

LAST_CONFIRM: Final = 16
"""The same at the end of the recording."""


class Rows(Protocol):
    """A NamedTuple of columns of equal length, the times [us] first, such as Events or Imu."""

    @property
    def t(self) -> NDArray[np.int64]:
        """Times [us]."""

    def __iter__(self) -> Iterator[Any]: ...


T = TypeVar("T", bound=Rows)

Where = Callable[[int], str]
"""Gives the place in the recording of sample number i of a piece."""

_AHEAD, _BACK = "ahead", "back"


def span(rows: T, first: int, stop: int) -> T:
    """Rows [first, stop) of all columns, as views."""
    return cast("T", cast("Any", type(rows))(*(column[first:stop] for column in rows)))


class Order(Generic[T]):
    """Lets samples pass whose times do not decrease, and decides for the others what the clock did.

    - A sample that is earlier than the one before it by up to RESTART_US is late: it is discarded. So is one that is
      earlier by more, unless CONFIRM samples stay there.
    - If they stay there, the clock has begun anew. If fewer than CONFIRM samples came before, those are old samples
      from a buffer: they are discarded, and the recording begins with the new clock. Otherwise the times of the new
      clock continue RESTART_US after the last sample.
    - After a step ahead by more than MAX_GAP_US the samples wait until CONFIRM of them have come. If the times return
      before, the samples are discarded. Otherwise the step is a gap.

    Args:
        tally: counts what is discarded.
        restart: whether a new clock continues. If not, everything after it is discarded: the samples of a stream other
            than the events would not match the events any more.
    """

    def __init__(self, tally: Tally, *, restart: bool = True) -> None:
        self._tally, self._restart = tally, restart
        self._last: int | None = None  # time of the newest sample that is believed
        self._believed = 0  # number of these samples
        self._start: list[tuple[T, Where]] = []  # the first of them, up to CONFIRM: they have not passed yet
        self._shift = 0  # added to the times
        self._kind = ""  # why samples wait; empty: none wait
        self._held: list[tuple[T, Where]] = []
        self._held_n, self._held_last = 0, 0

    def is_plain(self, rows: T) -> bool:
        """Whether these rows can pass as they are."""
        t = rows.t
        if self._kind or self._shift or self._last is None or self._start or not t.size:
            return False
        if t[0] < self._last or t[0] - self._last > MAX_GAP_US:
            return False
        steps = np.diff(t)
        return not steps.size or (int(steps.min()) >= 0 and int(steps.max()) <= MAX_GAP_US)

    def passed(self, rows: T) -> None:
        """Note that plain rows passed."""
        self._last = int(rows.t[-1])
        self._believed += rows.t.size

    def push(self, rows: T, where: Where) -> Iterator[T]:
        """The rows that can pass now, in order.

        Args:
            rows: the next rows of the recording.
            where: gives their places.
        """
        t = rows.t
        if not t.size:
            return
        if self.is_plain(rows):
            self.passed(rows)
            yield rows
            return
        steps = np.diff(t)
        breaks = np.flatnonzero((steps < 0) | (steps > MAX_GAP_US)) + 1
        for first, stop in pairwise([0, *breaks.tolist(), t.size]):
            run = span(rows, first, stop)
            yield from self._take(_shifted(run, self._shift) if self._shift else run, _after(where, first))

    def finish(self) -> Iterator[T]:
        """The rows that still wait at the end of the recording and can pass."""
        if self._kind == _BACK and self._held_n < min(LAST_CONFIRM, self._believed):
            self._discard(Reason.LATE)
        elif self._kind:
            yield from self._confirm()
        yield from self._flush()

    def _take(self, run: T, where: Where) -> Iterator[T]:
        """One run of ordered times without a long gap in it."""
        first = int(run.t[0])
        if self._kind:
            yield from self._take_waiting(run, where)
        elif self._last is None:
            yield from self._believe(run, where)
        elif first - self._last > MAX_GAP_US:
            yield from self._hold(_AHEAD, run, where)
        elif first < self._last - RESTART_US:
            yield from self._hold(_BACK, run, where)
        else:
            late = self._late_rows(run, where, self._last)
            if late < run.t.size:
                yield from self._believe(span(run, late, run.t.size), _after(where, late))

    def _take_waiting(self, run: T, where: Where) -> Iterator[T]:
        """As `_take`, while earlier rows wait."""
        first = int(run.t[0])
        if self._kind == _BACK and self._last is not None and first >= self._last:  # back at the level before
            self._discard(Reason.LATE)
            yield from self._take(run, where)
        elif first >= self._held_last - RESTART_US:
            late = self._late_rows(run, where, self._held_last)
            if late < run.t.size:
                yield from self._hold(self._kind, span(run, late, run.t.size), _after(where, late))
        else:
            self._discard(Reason.TIME_JUMP if self._kind == _AHEAD else Reason.LATE)
            yield from self._take(run, where)

    def _hold(self, kind: str, run: T, where: Where) -> Iterator[T]:
        """Let a run wait; the rows that pass after it, if it is the last one needed."""
        low = int(run.t.searchsorted(self._last)) if kind == _BACK and self._last is not None else run.t.size
        rest = span(run, low, run.t.size)
        if low:
            self._kind = kind
            self._held.append((span(run, 0, low), where))
            self._held_n += low
            self._held_last = int(run.t[low - 1])
        if self._held_n >= CONFIRM:
            shift = self._shift
            yield from self._confirm()
            rest = _shifted(rest, self._shift - shift)
        if rest.t.size:
            yield from self._take(rest, _after(where, low))

    def _confirm(self) -> Iterator[T]:
        """Believe the rows that wait."""
        kind, held, n = self._kind, self._held, self._held_n
        self._clear()
        shift = 0
        if kind == _BACK and self._last is not None:
            (run, where), last = held[0], self._last
            first = int(run.t[0])
            if self._start:
                before, place = self._start[0]
                why = f"t={int(before.t[0])} us comes before t={first} us, where the recording begins"
                self._tally.add(Reason.STALE_START, place(0), why, self._believed)
                self._start, self._last, self._believed = [], None, 0
            elif not self._restart:
                self._tally.add(Reason.LATE, where(0), _late(first, last), n)
                return
            else:
                why = f"t={first - self._shift} us comes after t={last - self._shift} us and stays"
                self._tally.add(Reason.NEW_CLOCK, where(0), why)
                shift = last + RESTART_US - first
                self._shift += shift
        for run, where in held:
            yield from self._believe(_shifted(run, shift) if shift else run, where)

    def _believe(self, run: T, where: Where) -> Iterator[T]:
        """Let rows pass that are in order, and report a gap before them. The first rows wait until there are enough."""
        first = int(run.t[0])
        if self._last is not None and first - self._last > MAX_GAP_US:
            why = f"nothing for {(first - self._last) / 1e6:,.1f} s, from t={self._last} us to t={first} us"
            self._tally.add(Reason.GAP, where(0), why)
        start = self._believed < CONFIRM
        self.passed(run)
        if start:
            self._start.append((run, where))
            if self._believed >= CONFIRM:
                yield from self._flush()
        else:
            yield run

    def _flush(self) -> Iterator[T]:
        start, self._start = self._start, []
        for run, _ in start:
            yield run

    def _late_rows(self, run: T, where: Where, last_us: int) -> int:
        """Count the rows that are earlier than `last_us`, and return how many they are."""
        late = int(run.t.searchsorted(last_us))
        self._tally.add(Reason.LATE, where(0), _late(int(run.t[0]), last_us), late)
        return late

    def _discard(self, reason: Reason) -> None:
        """Count the rows that wait."""
        run, where = self._held[0]
        first = int(run.t[0])
        why = _late(first, self._last)
        if reason is Reason.TIME_JUMP:
            why = f"t={first} us comes after t={self._last} us, and the times do not stay there"
        self._tally.add(reason, where(0), why, self._held_n)
        self._clear()

    def _clear(self) -> None:
        self._kind, self._held, self._held_n = "", [], 0


def _late(t_us: int, last_us: int | None) -> str:
    return f"t={t_us} us comes after t={last_us} us: time runs backwards"


def _shifted(run: T, shift_us: int) -> T:
    t, *others = run
    return cast("T", cast("Any", type(run))(t + shift_us, *others))


def _after(where: Where, first: int) -> Where:
    return where if not first else lambda i: where(first + i)
