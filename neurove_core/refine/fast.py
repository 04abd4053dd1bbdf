"""Fast turns: the angular velocity of a window in which the image moves by tens of pixels.

Over a whole window such a motion has three faults: its maximum of the alignment is too narrow to be found from a slow
guess, its speed changes within the window, and many events leave the image. All three shrink with the duration. So the
search begins in the middle quarter of the window, where the same rate moves the image by a quarter and is found from
guesses in all directions. Halves or quarters of the window follow, each from the rate of its neighbour. Their mean is
the angular velocity of the window.

A fast turn makes the events far sharper than no motion, which no slow motion does. So it needs no network that agrees.
"""

from typing import Final, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from neurove_core.refine.alignment import Grid, Rays
from neurove_core.refine.search import Found, Gaussian, agreement, measure, search

Array = NDArray[np.float64]

MIN_RAD_S: Final = 1.5
"""A slower turn is not fast."""

MIN_SHARPER: Final = 0.25
"""Least gain of the alignment over that without motion, as a share, over all parts. A fast drive along walls gains up
to 0.22 by a wrong turn (seed 20105). Turns above 1.5 rad/s in front of few edges gain 0.35 and more (20131 to 20135).
"""

MAX_SHIFT: Final = 1.2
"""Largest translation over depth [1/s], of each part: with a larger one, near and far things move differently."""

MAX_APART: Final = 2.0
MIN_SHARP: Final = 0.8
MIN_INSIDE: Final = 0.8
"""Of each part, as in `rotation`."""

QUARTERS_RAD: Final = 0.25
"""A window in which the camera turns further has four parts, else two."""

MIN_EVENTS: Final = 200
"""Of each part."""

_FIRST_LEVELS: Final = (4, 2)
_LEVELS: Final = (1,)
_MIDDLE: Final = 4  # the search begins in this share of the window
_GUESS_RAD: Final = 0.06  # of a turn within it, to both sides of each axis
_TURN_SIGMA: Final = 6.0  # of the prior [rad/s]
_SHIFT_SIGMA: Final = 0.3  # of the translation over depth [1/s]
_DISPERSION: Final = 4.0  # variance of the events' gradient over that of independent events
_SHARE: Final = 0.03  # standard deviation of the rate as a share of it

Reason = Literal["", "slow", "few events", "no maximum", "disagreeing", "out of range", "no gain"]


class Turn(NamedTuple):
    """A fast turn."""

    w_rad_s: Array  # (3,) mean of the window
    covariance: Array  # (3, 3)
    newest_rad_s: Array  # (3,) of the last part
    change_rad_s: Array  # (3,) of the rate from the start of the window to its end


def fast_turn(rays: Rays, grid: Grid, seconds: float, guesses: list[Array]) -> tuple[Turn | None, Reason]:
    """The angular velocity of a window in which the camera turns fast; None and the reason if it does not.

    Args:
        rays: the events of the window.
        grid: the finest image.
        seconds: length of the window.
        guesses: angular velocities (3,) in addition to those in all directions.
    """
    middle = _part(rays, 0.0, 1 / _MIDDLE)
    if middle.x.size < MIN_EVENTS:
        return None, "few events"
    length = seconds / _MIDDLE
    around = [np.zeros(3), *np.eye(3) * _GUESS_RAD, *np.eye(3) * -_GUESS_RAD, *(guess * length for guess in guesses)]
    starts = [np.append(turn, np.zeros(3)) for turn in around]
    rate = search(middle, grid, _prior(length), starts, _FIRST_LEVELS).motion / length
    if np.linalg.norm(rate[:3]) < 0.8 * MIN_RAD_S:
        return None, "slow"
    parts = _followed(rays, grid, seconds, rate)
    return (None, "few events") if parts is None else _judged(parts, seconds)


class _Part(NamedTuple):
    rays: Rays
    found: Found


def _followed(rays: Rays, grid: Grid, seconds: float, rate: Array) -> list[_Part] | None:
    """The motion of each part of the window, from the rate in the middle (6,)."""
    count = 4 if float(np.linalg.norm(rate[:3])) * seconds > QUARTERS_RAD else 2
    length = seconds / count
    found: dict[int, _Part] = {}
    for order in (range(count // 2, count), range(count // 2 - 1, -1, -1)):
        motion = rate * length
        for number in order:
            some = _part(rays, (number + 0.5) / count - 0.5, 1 / count)
            if some.x.size < MIN_EVENTS:
                return None
            found[number] = _Part(some, search(some, grid, _prior(length), [motion], _LEVELS))
            motion = found[number].found.motion
    return [found[number] for number in range(count)]


def _judged(parts: list[_Part], seconds: float) -> tuple[Turn | None, Reason]:
    length = seconds / len(parts)
    rates = np.array([part.found.motion[:3] for part in parts]) / length
    w = rates.mean(0)
    if np.linalg.norm(w) < MIN_RAD_S:
        return None, "slow"
    covariance = np.eye(3) * (_SHARE * float(np.linalg.norm(w))) ** 2
    for some, found in parts:
        posterior = found.information / _DISPERSION + _prior(length).information
        if not np.linalg.eigvalsh(posterior)[0] > 0:
            return None, "no maximum"
        covariance += np.linalg.inv(posterior)[:3, :3] / (len(parts) * length) ** 2
        outside = float(found.tiles.events.sum()) < MIN_INSIDE * some.x.size
        if outside or np.linalg.norm(found.motion[3:]) > MAX_SHIFT * length:
            return None, "out of range"
        agreed = agreement(found)
        if agreed.apart > MAX_APART * agreed.noise or agreed.sharp < MIN_SHARP:
            return None, "disagreeing"
    with_it = sum(float(part.found.tiles.value.sum()) for part in parts)
    without = sum(float(measure(part.rays, part.found.grid, np.zeros(6)).value.sum()) for part in parts)
    if with_it < (1 + MIN_SHARPER) * without:
        return None, "no gain"
    change = (rates[-1] - rates[0]) * len(rates) / (len(rates) - 1)
    return Turn(w, covariance, rates[-1], change), ""


def _part(rays: Rays, middle: float, share: float) -> Rays:
    """The events around a time of the window, with times from there in units of the part's length."""
    first, stop = np.searchsorted(rays.time, [middle - share / 2, middle + share / 2])
    time = ((rays.time[first:stop] - np.float32(middle)) / np.float32(share)).astype(np.float32)
    x, y, near = (np.ascontiguousarray(column[first:stop]) for column in (rays.x, rays.y, rays.near))
    return Rays(x, y, time, near)


def _prior(length_s: float) -> Gaussian:
    """Of the motion over a part: nothing but that it is no stranger than that of a hand."""
    sigma = np.array([_TURN_SIGMA] * 3 + [_SHIFT_SIGMA] * 3) * length_s
    return Gaussian(np.zeros(6), np.diag(1 / sigma**2))
