"""How certain an answer over the ground is, by how much the answers of its stream scatter.

The curvature of a search says how sharp the best motion is. It does not say how well the plane, the walls and the
constant motion explain the events. Answers whose spans share no events show it: their differences have the errors of
both, and what the motion changed between them, which the answers follow late. So sigma is a share of that of
`errors.of_ground`, the root mean square difference, and what such differences do not show: an error of the pitch lasts,
and makes part of the speed ahead a speed into the ground. Sigma is never larger than that of `errors.of_ground`.

The rules of the refinement and the filter of a gyroscope's bias compare covariances without this. The constants make
90 % intervals hold on own sequences; see decision 177.
"""

from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from neurove_protocol import CameraInfo

Array = NDArray[np.float64]

LAG: Final = 4
"""Windows from one answer to the next that shares no events with it, in a span of 200 ms."""

KEPT: Final = 20
"""Windows whose differences count in full; the weight of older ones falls."""

BELIEVED: Final = 3
"""After so many windows a quarter of what is known is still the sigma of `errors.of_ground`."""

SEARCH: Final = np.array([0.15, 0.15, 0.1, 0.4, 0.15, 0.2])
"""Share of that sigma."""

DIFFERENCE: Final = np.array([0.95, 0.7, 0.85, 0.75, 1.1, 1.0])
"""Share of the root mean square difference."""

SPEED: Final = np.array([0.002, 0.011, 0.015, 0.0014, 0.0008, 0.0011])
"""Error by the speed that lasts: a share of it in the linear part, an angular velocity by it in the other [rad/m]."""

FAST_M_S: Final = 4.0
"""From this speed on; a slower vehicle hardly pitches, so that the error falls with the square of the speed."""

LEAST: Final = np.array([0.0, 0.008, 0.012, 0.0, 0.0, 0.0])
"""Least share of the speed: an error of the pitch that a slow vehicle has from the start of its stream lasts too."""

NARROW: Final = np.array([0.0, 0.04, 0.2, 0.0, 0.0, 0.0])
"""The same, at each speed, for a lens that shows little of the ground, by 1 / (tangent of half its vertical view) above
WIDE: there pitch and speed look alike."""

WIDE: Final = 1.7
"""The usual lenses have 1.7 and less."""


class Scatter(NamedTuple):
    """What the answers of a stream have shown; arrays are never changed in place."""

    recent: Array = np.empty((0, 6))  # (K, 6) newest answers in a row, oldest first, at most LAG
    square: Array = np.zeros(6)  # (6,) mean square difference of answers LAG windows apart
    windows: int = 0  # that have shown one, at most KEPT
    end_us: int = 0  # of the newest window with an answer


def answered(scatter: Scatter, twist: Array, start_us: int, end_us: int) -> Scatter:
    """What is known after an answer over the ground.

    Args:
        scatter: what was known before; after a window without an answer, the answers before it are not compared.
        twist: (6,) of the answer [m/s, rad/s].
        start_us: of its window.
        end_us: of its window.
    """
    before = scatter.recent if scatter.end_us == start_us else scatter.recent[:0]
    recent = np.concatenate([before, twist[None]])
    if len(recent) <= LAG:
        return scatter._replace(recent=recent, end_us=end_us)
    windows = min(scatter.windows + 1, KEPT)
    square = scatter.square + (np.square(twist - recent[0]) - scatter.square) / windows
    return Scatter(recent[1:], square, windows, end_us)


def shares(scatter: Scatter, sigma: Array, speed_m_s: float, narrow: float) -> Array:
    """The share (6,) of sigma that an answer has, by what its stream has shown.

    Args:
        scatter: after the answer.
        sigma: (6,) by `errors.of_ground`.
        speed_m_s: of the answer.
        narrow: 1 / (tangent of half the vertical view of the lens).
    """
    by_speed = np.maximum(SPEED * min(1.0, speed_m_s / FAST_M_S), LEAST) * speed_m_s
    lasting = np.square(by_speed) + np.square(NARROW * max(narrow - WIDE, 0.0) * speed_m_s)
    known = np.square(SEARCH * sigma) + np.square(DIFFERENCE) * scatter.square + lasting
    unseen = (BELIEVED / (scatter.windows + BELIEVED)) ** 2
    variance = (1 - unseen) * np.minimum(known, np.square(sigma)) + unseen * np.square(sigma)
    return np.asarray(np.sqrt(variance) / sigma)


def narrowed(covariance: Array, scatter: Scatter, speed_m_s: float, camera: CameraInfo) -> Array:
    """The covariance (6, 6) of an answer with these shares of its sigma; its correlations stay.

    Args:
        covariance: by `errors.of_ground`.
        scatter: after the answer.
        speed_m_s: of the answer.
        camera: its lens.
    """
    narrow = camera.fy / max(camera.cy, camera.height - camera.cy)
    share = shares(scatter, np.sqrt(np.diagonal(covariance)), speed_m_s, narrow)
    return covariance * np.outer(share, share)
