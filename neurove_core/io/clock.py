"""Unwrap clocks that have few bits."""

import numpy as np
from numpy.typing import NDArray

_WRAP_US = 1 << 32


def unwrap_times(t: NDArray[np.uint32], before_us: int) -> tuple[NDArray[np.int64], int]:
    """Unwrap the times of a 32-bit clock. A decrease by more than half of its range is a wrap.

    >>> unwrap_times(np.array([7, (1 << 32) - 1, 3], np.uint32), 0)[1]
    4294967299

    Args:
        t: (N,) values of the clock [us].
        before_us: the unwrapped time before these [us].

    Returns:
        The unwrapped times (N,) [us] and the last of them [us], which is `before_us` if there are none.
    """
    if not t.size:
        return t.astype(np.int64), before_us
    clock = np.concatenate([[before_us % _WRAP_US], t.astype(np.int64)])
    wraps = before_us // _WRAP_US + np.cumsum(np.diff(clock) < -_WRAP_US // 2)
    unwrapped = clock[1:] + wraps * _WRAP_US
    return unwrapped, int(unwrapped[-1])
