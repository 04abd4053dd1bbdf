"""How much a camera in the air trembles within a window, by how unevenly its rates change from window to window.

A refined rate is the mean of a window and changes evenly within it. A hand that moves smoothly is off it by .01 rad/s,
one that jerks by a share of what its rates show from window to window. The constants make 90 % intervals hold on own
sequences; see decision 177.
"""

from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from neurove_core.refine.errors import TREMBLE_RAD_S

Array = NDArray[np.float64]

KEPT: Final = 10
"""Windows whose second differences count in full; the weight of older ones falls."""

SHARE: Final = 0.4
"""Error of a rate, as a share of the root mean square second difference of rates."""

LEAST_RAD_S: Final = 0.01
"""Least error of a rate."""


class Trembling(NamedTuple):
    """What the rates of a stream have shown; arrays are never changed in place."""

    recent: Array = np.empty((0, 3))  # (K, 3) newest rates in a row, oldest first, at most 2
    square: Array = np.zeros(3)  # (3,) mean square second difference
    windows: int = 0  # that have shown one, at most KEPT
    end_us: int = 0  # of the newest window with a rate


def turned(before: Trembling, w_rad_s: Array, start_us: int, end_us: int) -> Trembling:
    """What is known after an accepted rate.

    Args:
        before: what was known; after a window without such a rate, the rates before it are not compared.
        w_rad_s: (3,) the rate.
        start_us: of its window.
        end_us: of its window.
    """
    recent = np.concatenate([before.recent if before.end_us == start_us else before.recent[:0], w_rad_s[None]])
    if len(recent) < 3:
        return before._replace(recent=recent, end_us=end_us)
    windows = min(before.windows + 1, KEPT)
    square = before.square + (np.square(recent[0] - 2 * recent[1] + recent[2]) - before.square) / windows
    return Trembling(recent[1:], square, windows, end_us)


def trembled(covariance: Array, known: Trembling, *, assumed: bool) -> Array:
    """The covariance (3, 3) of a rate with what the camera trembles, in place of TREMBLE_RAD_S.

    Args:
        covariance: of the rate.
        known: after it.
        assumed: whether the covariance has TREMBLE_RAD_S already. It stays until the rates show something.
    """
    if not known.windows:
        return covariance
    shown = np.maximum(SHARE**2 * known.square, LEAST_RAD_S**2)
    more: Array = np.diag(shown - TREMBLE_RAD_S**2 if assumed else shown)
    return covariance + more
