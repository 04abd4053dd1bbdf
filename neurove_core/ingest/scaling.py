"""Tables that only scale a sensor to the grid: the cell of a pixel by two products in place of a read of the table.

A table without a lens is a product of its rows and columns: cell = row(y) * width + column(x), both the floor of a
multiple. Two integer products give the same cells, and a processor computes eight of them at a time, while it reads a
table entry by entry.
"""

import weakref
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

SHIFT: Final = 20
"""Binary digits behind the point of a factor."""

_MOST: Final = (1 << 32 - SHIFT) - 1  # rows or columns of a grid: a product fits into 32 bits


class Scale(NamedTuple):
    """Factors of a table: its cell is (y * rows >> SHIFT) * width + (x * columns >> SHIFT)."""

    rows: int
    columns: int
    width: int  # columns of the grid; 0: the table has no such factors


NO_SCALE: Final = Scale(0, 0, 0)

_scales: dict[tuple[int, int], Scale] = {}


def scale_of(lut: NDArray[np.int32], width: int) -> Scale:
    """The factors of a table, or NO_SCALE.

    A table is examined once, and only where it is read-only, as those of `geometry.lookup_table` are: a table that may
    change has NO_SCALE.

    Args:
        lut: (sensor.height, sensor.width) cell of each pixel.
        width: columns of the grid.
    """
    if lut.flags.writeable:
        return NO_SCALE
    key = id(lut), width
    found = _scales.get(key)
    if found is None:
        found = _scales[key] = _examined(lut, width)
        weakref.finalize(lut, _scales.pop, key, None).atexit = False
    return found


def _examined(lut: NDArray[np.int32], width: int) -> Scale:
    if not lut.size or not 0 < width <= _MOST:
        return NO_SCALE
    rows, columns = lut[:, 0] // width, lut[0]
    if lut[0, 0] != 0 or not 0 <= columns.max() < width or not 0 <= rows.max() <= _MOST:
        return NO_SCALE
    found = Scale(_factor(rows), _factor(columns), width)
    return found if np.array_equal(scaled(lut.shape, found), lut) else NO_SCALE


def _factor(steps: NDArray[np.int32]) -> int:
    """The smallest factor whose multiples reach each of these steps."""
    at = np.arange(1, steps.size, dtype=np.int64)
    return int(np.max(-((-steps[1:].astype(np.int64) << SHIFT) // at), initial=0))


def scaled(shape: tuple[int, ...], scale: Scale) -> NDArray[np.int32]:
    """The table (height, width) of these factors, in plain numpy."""
    y, x = (np.arange(size, dtype=np.uint32) for size in shape)
    rows, columns = y * np.uint32(scale.rows) >> np.uint32(SHIFT), x * np.uint32(scale.columns) >> np.uint32(SHIFT)
    return (rows[:, None].astype(np.int32) * scale.width + columns.astype(np.int32)).astype(np.int32)
