"""Unwrap clocks that have few bits."""

import numpy as np
from numpy.typing import NDArray

_PERIOD_US = 1 << 32


def unwrap_times(t: NDArray[np.uint32], before_us: int | None) -> tuple[NDArray[np.int64], int | None]:
    """Unwrap the times of a 32-bit clock; see `unwraps`.

    >>> unwrap_times(np.array([(1 << 32) - 1, 3], np.uint32), None)[1]
    4294967299

    Args:
        t: (N,) values of the clock [us].
        before_us: the unwrapped time before these [us]; None at the beginning.

    Returns:
        The unwrapped times (N,) [us] and the last of them [us], which is `before_us` if there are none.
    """
    if not t.size:
        return t.astype(np.int64), before_us
    turn, before = divmod(int(t[0]) if before_us is None else before_us, _PERIOD_US)
    clock = np.concatenate([[before], t.astype(np.int64)])
    unwrapped: NDArray[np.int64] = (clock + (turn + unwraps(clock, _PERIOD_US)) * _PERIOD_US)[1:]
    return unwrapped, int(unwrapped[-1])


def unwraps(clock: NDArray[np.int64], period: int) -> NDArray[np.int64]:
    """Number of wraps of a counter before each of its values, from 0 for the first.

    A wrap comes from the top quarter of the range to the bottom quarter. A step in the other direction, of a value that
    is late, takes one back. Any other step is not a wrap: the clock of the recording has changed.

    >>> unwraps(np.array([90, 99, 3, 98, 4, 70, 2]), 100)
    array([0, 0, 1, 0, 1, 1, 1])

    Args:
        clock: (N,) values from 0 up to, and without, the period.
        period: of the counter.
    """
    top, bottom = clock >= period - period // 4, clock < period // 4
    steps = np.zeros(clock.size, np.int64)
    steps[1:] = (top[:-1] & bottom[1:]).astype(np.int64) - (bottom[:-1] & top[1:])
    return np.cumsum(steps)
