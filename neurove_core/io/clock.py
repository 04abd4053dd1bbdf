"""Clocks of few bits, counted on over their wraps."""

import numpy as np
from numpy.typing import NDArray

_WRAP_US = 1 << 32


def count_on(t: NDArray[np.uint32], before_us: int) -> tuple[NDArray[np.int64], int]:
    """Times of a 32-bit clock counted on over its wraps, and the last of them: falling by more than half is a wrap.

    >>> count_on(np.array([7, (1 << 32) - 1, 3], np.uint32), 0)[1]
    4294967299

    Args:
        t: (N,) what the clock showed [us].
        before_us: the counted time before these.
    """
    if not t.size:
        return t.astype(np.int64), before_us
    shown = np.concatenate([[before_us % _WRAP_US], t.astype(np.int64)])
    wraps = before_us // _WRAP_US + np.cumsum(np.diff(shown) < -_WRAP_US // 2)
    counted = shown[1:] + wraps * _WRAP_US
    return counted, int(counted[-1])
