"""Which column of a table is the time, x, y and the polarity: by its name, or by a checked guess at its values."""

import re
from collections.abc import Sequence
from itertools import permutations
from typing import Any, Final, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from neurove_core.io.checked import Piece, as_recorded
from neurove_core.io.faults import Reason, Tally
from neurove_core.io.order import Where
from neurove_protocol.events import Events

MAX_T_US: Final = 1e18  # a larger time is invalid
SECONDS, MICROSECONDS = 1e6, 1.0
WORDS: Final = {"t": "the time", "x": "x", "y": "y", "p": "the polarity"}
"""The columns of an event, in the order of `Events`, for people."""

_UNITS: Final = {
    **dict.fromkeys(("s", "sec", "secs", "second", "seconds"), SECONDS),
    **dict.fromkeys(("ms", "msec", "milliseconds"), 1e3),
    **dict.fromkeys(("us", "usec", "microsecond", "microseconds"), MICROSECONDS),
    **dict.fromkeys(("ns", "nsec", "nanosecond", "nanoseconds"), 1e-3),
}
_NAMES: Final = {
    **dict.fromkeys(("t", "ts", "time", "times", "timestamp", "timestamps", "stamp"), "t"),
    **dict.fromkeys(("x", "xs", "col", "column", "x_px"), "x"),
    **dict.fromkeys(("y", "ys", "row", "y_px"), "y"),
    **dict.fromkeys(("p", "ps", "pol", "polarity", "polarities", "on", "is_on", "is_increase"), "p"),
}
_PIXEL = "is not a whole number of pixels"
_WHY: Final = {"t": "is not a valid time", "x": _PIXEL, "y": _PIXEL, "p": "is a polarity that is neither 1, 0 nor -1"}
_EXCEPTIONS = 0.01  # share of rows that may not fit a guess
_WHOLE = 16  # so many times without a fraction are not seconds


class Unclear(ValueError):
    """The columns cannot be told apart; the text names the one that is missing or not clear."""


class Columns(NamedTuple):
    """The numbers of the columns, counted from 0, and the unit of time."""

    t: int
    x: int
    y: int
    p: int
    unit_us: float | None = None  # [us] of one unit of t, or None if its name does not give it

    @property
    def order(self) -> tuple[int, int, int, int]:
        """The columns t, x, y, p."""
        return self.t, self.x, self.y, self.p


def by_name(names: Sequence[str]) -> Columns:
    """The columns with these names, such as `t`, `timestamp [us]` or `time_ns`; others are ignored.

    >>> by_name(["x", "y", "Polarity", "timestamp [us]"])
    Columns(t=3, x=0, y=1, p=2, unit_us=1.0)

    Raises:
        Unclear: a column is missing; the text names it.
    """
    found: dict[str, int] = {}
    unit_us = None
    for i, name in enumerate(names):
        kind, unit = _meaning(name)
        if kind and kind not in found:
            found[kind] = i
            unit_us = unit if kind == "t" else unit_us
    missing = [WORDS[kind] for kind in WORDS if kind not in found]
    if missing:
        shown = ", ".join(repr(name) for name in names[:12])
        raise Unclear(f"no column is named as {' or '.join(missing)}; the columns are {shown}")
    return Columns(found["t"], found["x"], found["y"], found["p"], unit_us)


def names_any(names: Sequence[str]) -> bool:
    """Whether one of these is the name of a column of events."""
    return any(_meaning(name)[0] for name in names)


def _meaning(name: str) -> tuple[str, float | None]:
    """Which column this name means, or an empty text, and the unit of time in it."""
    word = re.sub(r"[\s_]*[\[(]\s*(\w+)\s*[\])]$", r"_\1", name.strip().strip("\"'").lower().replace("\u00b5", "u"))
    word = word.replace("\u03bc", "u")
    kind = _NAMES.get(word, "")
    if kind:
        return kind, None
    stem, _, unit = word.rpartition("_")
    return ("t", _UNITS[unit]) if _NAMES.get(stem) == "t" and unit in _UNITS else ("", None)


def by_values(rows: NDArray[np.float64], noun: str = "column") -> Columns:
    """Guess the columns of a table of four numbers a row.

    The polarity is a column of 0 and 1 or of -1 and 1. The time is a column that does not decrease. The two others are
    x and y, in this order. `t x y p` is taken if it fits; otherwise one order must fit. If none fits, 1 % of the rows,
    and at least one, may be exceptions. If no column is ordered, the time is the one that has no pixels.

    Args:
        rows: (N, 4) the first rows of the table.
        noun: what a column is called.

    Raises:
        Unclear: no order fits, or several do; the text names the column.
    """
    if rows.shape[1] != 4:
        raise Unclear(f"a row has {rows.shape[1]} numbers, not t, x, y and p")
    faults = _Exceptions.of(rows)
    for allowed in (0.0, max(_EXCEPTIONS * len(rows), 1.0)):
        orders = faults.orders(allowed)
        if Columns(0, 1, 2, 3) in orders:
            return Columns(0, 1, 2, 3)
        if len(orders) == 1:
            return orders[0]
        if orders:
            raise Unclear(_several(orders, noun))
    orders = [order for order in faults.orders(allowed, ordered=False) if faults.pixel[order.t] > allowed]
    if len(orders) == 1:  # the times are not ordered, but no other column can be the time
        return orders[0]
    if min(faults.polarity) > allowed:
        raise Unclear(f"no {noun} is a polarity of 0 and 1 or of -1 and 1")
    if min(faults.time) > allowed:
        raise Unclear(f"no {noun} is a time: each of them decreases")
    raise Unclear(f"no two {noun}s are x and y: pixels are whole numbers from 0 to 65535")


class _Exceptions(NamedTuple):
    """For each column, the number of rows that speak against it."""

    time: list[int]
    pixel: list[int]
    polarity: list[int]

    @classmethod
    def of(cls, rows: NDArray[np.float64]) -> Self:
        with np.errstate(invalid="ignore"):
            time = (np.diff(rows, axis=0) < 0) | ~np.isfinite(rows[1:])
            pixel = (rows >= 0) & (rows <= 0xFFFF) & (rows == np.floor(rows))
        polarity = np.isin(rows, (-1.0, 0.0, 1.0))
        return cls(*(bad.sum(axis=0).tolist() for bad in (time, ~pixel, ~polarity)))

    def orders(self, allowed: float, *, ordered: bool = True) -> list[Columns]:
        """All orders of the columns with at most so many exceptions in each; in that of the times only if `ordered`."""
        found = []
        for t, p in permutations(range(4), 2):
            x, y = (i for i in range(4) if i not in (t, p))
            late = self.time[t] if ordered else 0
            if max(late, self.polarity[p], self.pixel[x], self.pixel[y]) <= allowed:
                found.append(Columns(t, x, y, p))
        return found


def _several(orders: list[Columns], noun: str) -> str:
    for kind in ("t", "p"):
        numbers = sorted({getattr(order, kind) + 1 for order in orders})
        if len(numbers) > 1:
            return f"{WORDS[kind]} can be {noun} {' or '.join(map(str, numbers))}"
    raise AssertionError(orders)  # t and p decide the order


def unit_of(times: NDArray[np.float64], *, floats: bool) -> float:
    """Guess the unit of times without a named one [us]: whole numbers are us, others are seconds.

    Args:
        times: (N,) the first times.
        floats: whether they are written with a decimal point or stored as floats. Then they need to be several whole
            numbers that differ, to be us.
    """
    whole = bool((times == np.floor(times)).all())
    if not floats:
        return MICROSECONDS if whole else SECONDS
    return MICROSECONDS if whole and np.unique(times).size >= _WHOLE else SECONDS


def piece(where: Where, unit_us: float, columns: Sequence[NDArray[Any]], tally: Tally) -> Piece:
    """The events of some rows for `cleaned`; rows with an invalid value are counted and left out.

    A polarity above 0 is ON; 0 or -1 is OFF.

    Args:
        where: gives the place of row i.
        unit_us: the unit of the times [us].
        columns: t, x, y, p of any number type (N,).
        tally: of this pass.
    """
    t, x, y, p = columns
    with np.errstate(all="ignore"):
        t_us = t if t.dtype.kind in "iu" and unit_us == MICROSECONDS else np.rint(t.astype(np.float64) * unit_us)
        valid = {
            "t": np.abs(t_us.astype(np.float64)) < MAX_T_US,  # in this form nan fails
            "x": _is_pixel(x),
            "y": _is_pixel(y),
            "p": (p == 0) | (p == 1) | (p == -1),
        }
    good = np.logical_and.reduce(list(valid.values()))
    if good.all():
        return where, _events(t_us, x, y, p)
    unseen = np.ones(good.shape, np.bool_)  # a row counts once
    for (name, fits), column in zip(valid.items(), columns, strict=True):
        bad = np.flatnonzero(unseen & ~fits)
        if bad.size:
            tally.add(Reason.INVALID, where(int(bad[0])), f"{name}={column[bad[0]]:g} {_WHY[name]}", bad.size)
        unseen &= fits
    rows = np.flatnonzero(good)
    return (lambda i: where(int(rows[i]))), _events(t_us[rows], x[rows], y[rows], p[rows])


def _events(t_us: NDArray[Any], x: NDArray[Any], y: NDArray[Any], p: NDArray[Any]) -> Events:
    return as_recorded(t_us.astype(np.int64), x.astype(np.int64), y.astype(np.int64), (p > 0).astype(np.uint8))


def _is_pixel(column: NDArray[Any]) -> NDArray[np.bool_]:
    """Whether these are whole numbers; `cleaned` compares them with the sensor."""
    if column.dtype.kind != "f":
        return np.ones(column.shape, np.bool_)
    return np.asarray((np.abs(column) < 1 << 31) & (column == np.floor(column)))
