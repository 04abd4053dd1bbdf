"""Refinement of the angular velocity of one window: a stage after the network.

It combines three sources: the network's answer, the refined motion of the window before (a Kalman filter whose
prediction is that the motion goes on), and the events themselves, by contrast maximisation. The first two are the prior
of the search, so its result is the most probable motion given all three, and its covariance is that of the posterior.

The motion has a part of three numbers for the translation over the depth of the scene. It keeps a translation from
being taken for a rotation where the depths differ little. Where they differ much, the parts of the image disagree with
every motion, and the refinement is not accepted.

The refined motion is accepted if
- the window is not flagged `low_activity` and has at least MIN_EVENTS events in the view;
- the events are spread over the image: MIN_SPREAD;
- the parts of the image agree: their motions differ by at most MAX_APART times what noise explains, and the alignment
  is at a maximum for MIN_SHARP of the events;
- the events stay in the image, and the motion is at most MAX_TURN_RAD and MAX_SHIFT over the window;
- the network does not contradict it: MAX_SIGMAS;
- the network is not certain that the camera moves fast, which moves near and far things differently: MAX_SPEED;
- the search ends at a maximum, and the result is more certain than the network;
- the network sees a turn of STILL_RAD_S, or the alignment is better than without motion by MIN_SHARPER.
Else the network's answer stands.

A turn and a translation across the optical axis look nearly alike. The translation has a narrow prior until the events
of the newest windows show one (`_aside`). Otherwise the network, which does not see a slow turn, would leave it to the
translation.

Two things outweigh the network:
- A motion that goes on: for MAX_AGAINST windows in a row, an answer that continues the windows before (MAX_OFF) is
  accepted although the network contradicts it or sees the camera move fast.
- A fast turn, see `fast`: it is looked for where the rules above fail as they do in fast turns.
"""

from typing import Final, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from neurove_core.ingest.sample import Sample
from neurove_core.refine import errors
from neurove_core.refine.alignment import Grid, Rays
from neurove_core.refine.fast import fast_turn
from neurove_core.refine.search import Found, Gaussian, agreement, measure, search
from neurove_core.refine.view import View

Array = NDArray[np.float64]

Outcome = Literal[
    "accepted",
    "few events",
    "narrow",
    "disagreeing",
    "out of range",
    "contradicted",
    "moving",
    "no gain",
    "no maximum",
    "still",
]

_PERHAPS_FAST: Final = ("disagreeing", "out of range", "contradicted", "no maximum")
"""A fast turn looks so to the search over the whole window."""

SURELY_FAST_RAD_S: Final = 3.0
"""After a faster turn, a fast one is looked for first."""

MAX_AGAINST: Final = 3
"""Windows in a row in which a motion that goes on outweighs a network that contradicts it, or sees a fast camera."""

MAX_OFF: Final = 3.0
"""A motion goes on if it is within so many sigmas of the one before."""

MOVING_EVERY: Final = 4
"""While the network sees the camera move fast, only each fourth window is searched for a fast turn."""

MIN_EVENTS: Final = 500
MIN_SPREAD: Final = 0.04
"""Effective share of 16 x 16 tiles of the view that hold the events: (sum n)^2 / (256 sum n^2)."""

MAX_APART: Final = 2.0
MIN_SHARP: Final = 0.8
MIN_INSIDE: Final = 0.8
MAX_TURN_RAD: Final = 0.4
MAX_SHIFT: Final = 0.1
STILL_RAD_S: Final = 0.03
"""The network says less of a stationary camera: at most 0.01 rad/s."""

MIN_SHARPER: Final = 0.02
"""Least gain of the alignment over that without motion, as a share. A turn of 0.1 rad/s gains 0.009 to 0.018, one of
0.2 rad/s 0.045 (simulated, seeds 20200 to 20204), the noise of a stationary DVXplorer up to 0.019."""

MAX_SIGMAS: Final = 5.0
"""Of the network's covariance, with the floor _NETWORK_FLOOR."""

MAX_SPEED: Final = 0.3
"""Largest linear velocity over the height of the camera [1/s], where it is above _CERTAIN times its sigma."""

_CERTAIN: Final = 1.0
_NETWORK_SCALE: Final = (
    1.2  # of the network's sigma in the prior: its errors have heavier tails than a normal distribution
)
_REPEATED: Final = 3.0
"""Factor of the network's sigma while the filter runs: errors of the network last for many windows, and the filter has
the earlier answers already."""

_NETWORK_FLOOR: Final = 0.02  # [rad/s]
_SHIFT_SIGMA: Final = 0.05  # of the translation over depth, when nothing is known [1/s]
_SHIFT_KEPT: Final = 0.95  # share of it that goes on to the next window
_TURN_NOISE: Final = 0.1  # growth of sigma of the angular velocity per window [rad/s]
_TURN_NOISE_SHARE: Final = 0.3  # the same, as a share of the angular velocity
_SHIFT_NOISE: Final = 0.016  # growth of sigma of the translation over depth [1/s]
_DISPERSION: Final = 2.0  # variance of the events' gradient over that of independent events
_CHANGE_GAIN: Final = 0.8  # of the change within a window over that since the window before
_CHANGE_ERROR: Final = 0.12  # error of pitch and yaw rate, as a share of the change of the rate since the last window
_SHIFT_ERROR: Final = 0.7  # the same by the square of the translation over depth [s]: depths differ
_ROLL_SCALE: Final = 0.75  # of the sigma of the roll rate, which no translation resembles
_ROLL_SHARE: Final = 0.4  # of the other errors
_NOT_ASIDE: Final = 0.03  # sigma of the translation over depth across the optical axis, where none is shown [1/s]
_ODDS_KEPT: Final = 0.8  # share of the log odds of such a translation that goes on to the next window
_NOISE_GAIN: Final = 1.0  # of the log of the likelihood by a free translation across the axis, where there is none
_MAX_ODDS: Final = 8.0
_LOST_SIGMA: Final = 0.5  # the filter begins again above this [rad/s]


class Rate(NamedTuple):
    """An angular velocity with its covariance."""

    w_rad_s: Array  # (3,)
    covariance: Array  # (3, 3)


class Filter(NamedTuple):
    """State of the Kalman filter of one stream."""

    motion: Array  # (6,) angular velocity [rad/s], and translation over depth [1/s]
    covariance: Array  # (6, 6)
    end_us: int  # end of its newest window
    against: int = 0  # newest windows in a row that were accepted against the network
    aside: float = 0.0  # log odds that the camera moves across its optical axis, see _aside


class Given(NamedTuple):
    """What is known about one window."""

    start_us: int
    window_us: int
    sample: Sample
    view: View
    twist: Array  # (6,) the network's, mean of the window [m/s, rad/s]
    covariance: Array  # (6, 6)
    low_activity: bool
    before: Filter | None
    height_m: float = 1.0  # of the camera, or what the linear part assumes
    knows_height: bool = True  # whether it is that of the camera


class Refined(NamedTuple):
    """The angular velocity of one window."""

    rate: Rate  # mean of the window
    outcome: Outcome
    filter: Filter | None  # for the next window
    change_rad_s: Array = np.zeros(3)  # (3,) of the rate from the start of the window to its end
    sigma_rad_s: Array | None = (
        None  # (3,) of the rate, if the scene has one depth; None if the network's answer stands
    )
    errors: Array | None = None  # (3, 3) covariance of the rate with the terms of `errors`; None where they are unknown
    shift: float = 0.0  # translation over depth [1/s]
    motion: Array | None = None  # (6,) what the search found, also where it is not accepted: see Filter.motion


def refine(given: Given) -> Refined:
    """Refine the angular velocity of a window; if it is not accepted, it is the network's."""
    known = Rate(given.twist[3:], floored(given.covariance[3:, 3:]))
    before = _predicted(given.before, given.start_us, given.window_us)
    not_accepted = Rate(known.w_rad_s, given.covariance[3:, 3:])
    rays = given.view.rays_of(given.sample, given.window_us)
    if given.low_activity or rays.x.size < MIN_EVENTS:
        return Refined(not_accepted, "few events", before)
    if spread(rays, given.view.grid) < MIN_SPREAD:
        return Refined(not_accepted, "narrow", before)
    try:
        return _slow_or_fast(given, known, before, not_accepted, rays)
    except np.linalg.LinAlgError:  # events that make no finite Hessian
        return Refined(not_accepted, "few events", None)


def drives(given: Given) -> bool:
    """Whether the network is certain that the camera moves fast."""
    speed, sigma = np.linalg.norm(given.twist[:3]), np.sqrt(np.trace(given.covariance[:3, :3]))
    return bool(speed > MAX_SPEED * given.height_m and speed > _CERTAIN * sigma)


def _slow_or_fast(given: Given, known: Rate, before: Filter | None, not_accepted: Rate, rays: Rays) -> Refined:
    moving = drives(given)
    fast = before is not None and float(np.linalg.norm(before.motion[:3])) >= SURELY_FAST_RAD_S
    found = _turned_fast(given, known, before, rays) if fast else None
    if found is not None:
        return found
    steady = before is not None and before.against < MAX_AGAINST
    if moving and not steady:
        found = Refined(not_accepted, "moving", before)
        seldom = given.start_us // given.window_us % MOVING_EVERY == 0
        return found if fast or not seldom else _turned_fast(given, known, before, rays) or found
    found = _searched(given, known, before, not_accepted, rays)
    if found.outcome == "accepted" and found.filter is not None:
        against = moving or _contradicted(found.rate.w_rad_s, known)
        found = found._replace(filter=found.filter._replace(against=before.against + 1 if before and against else 0))
    if found.outcome in _PERHAPS_FAST and not fast:
        return _turned_fast(given, known, before, rays) or found
    return found


def _turned_fast(given: Given, known: Rate, before: Filter | None, rays: Rays) -> Refined | None:
    """A fast turn; None if there is none."""
    seconds = given.window_us / 1e6
    guesses = [known.w_rad_s] if before is None else [known.w_rad_s, before.motion[:3]]
    turn, _ = fast_turn(rays, given.view.grid, seconds, guesses)
    if turn is None:
        return None
    motion, covariance = np.append(turn.newest_rad_s, np.zeros(3)), np.eye(6) * _SHIFT_SIGMA**2
    covariance[:3, :3] = turn.covariance
    filtered = Filter(motion, covariance, given.start_us + given.window_us)
    sigma = np.sqrt(np.diagonal(turn.covariance))
    return Refined(Rate(turn.w_rad_s, turn.covariance), "accepted", filtered, turn.change_rad_s, sigma, motion=motion)


def _searched(given: Given, known: Rate, before: Filter | None, not_accepted: Rate, rays: Rays) -> Refined:
    seconds = given.window_us / 1e6
    prior = _prior(known, before, seconds)
    found = search(rays, given.view.grid, prior, _guesses(known, before, seconds))
    aside = _aside(found, prior, before)
    if before is not None and before.aside < 0 <= aside:  # such a translation begins
        before = _freed(before)
        prior = _prior(known, before, seconds)
        found = search(rays, given.view.grid, prior, [*_guesses(known, before, seconds), found.motion])
    posterior = found.information / _DISPERSION + prior.information
    if not np.linalg.eigvalsh(posterior)[0] > 0:
        return Refined(not_accepted, "no maximum", before, motion=found.motion / seconds)
    covariance = np.asarray(np.linalg.inv(posterior) / seconds**2, np.float64)
    steady = before is not None and _goes_on(found.motion / seconds, covariance, before)
    outcome = _outcome(found, rays, known, covariance, seconds, steady=steady)
    if outcome != "accepted":
        return Refined(not_accepted, outcome, before, motion=found.motion / seconds)
    motion, end_us = found.motion / seconds, given.start_us + given.window_us
    change = np.zeros(3) if before is None else _CHANGE_GAIN * (motion[:3] - before.motion[:3])
    rate = Rate(motion[:3], _honest(motion, covariance, before))
    sigma, shift = np.sqrt(np.diagonal(covariance)[:3]), float(np.linalg.norm(motion[3:]))
    wider = errors.of_rotation(motion, covariance, motion if before is None else before.motion, known.w_rad_s)
    filtered = Filter(motion, covariance, end_us, aside=aside)
    return Refined(rate, outcome, filtered, change, sigma, wider, shift, motion)


def _honest(motion: Array, covariance: Array, before: Filter | None) -> Array:
    """Covariance (3, 3) of the angular velocity that other answers are compared with.

    Args:
        motion: (6,) angular velocity, and translation over depth.
        covariance: (6, 6) of it, if the rate is constant in the window and the scene has one depth.
        before: the filter, if it runs.
    """
    size = float(np.linalg.norm(motion[:3]))
    usual = _TURN_NOISE + _TURN_NOISE_SHARE * size
    change = usual if before is None else float(np.linalg.norm(motion[:3] - before.motion[:3]))
    more = (_CHANGE_ERROR * change) ** 2 + (_SHIFT_ERROR * float(motion[3:] @ motion[3:])) ** 2
    scale = np.array([1.0, 1.0, _ROLL_SCALE])
    return covariance[:3, :3] * np.outer(scale, scale) + np.diag(more * np.array([1.0, 1.0, _ROLL_SHARE**2]))


def with_rate(twists: Array, covariance: Array, rate: Rate, change_rad_s: Array) -> tuple[Array, Array]:
    """Twists (n, 6) and covariance (6, 6) with another angular part, which does not correlate with the linear part.

    The angular part changes by `change_rad_s` (3,) within the window.
    """
    twists, joint = twists.copy(), np.zeros((6, 6))
    twists[:, 3:] = rate.w_rad_s + np.outer((np.arange(len(twists)) + 0.5) / len(twists) - 0.5, change_rad_s)
    joint[:3, :3], joint[3:, 3:] = covariance[:3, :3], (rate.covariance + rate.covariance.T) / 2
    return twists, joint


def spread(rays: Rays, grid: Grid) -> float:
    """Effective share of 16 x 16 tiles of the image that hold the events."""
    column = ((rays.x - grid.left) * (16 * grid.focal / grid.width)).astype(np.int64).clip(0, 15)
    row = ((rays.y - grid.top) * (16 * grid.focal / grid.height)).astype(np.int64).clip(0, 15)
    counts = np.bincount(row * 16 + column, minlength=256).astype(np.float64)
    return float(counts.sum() ** 2 / (256 * (counts**2).sum()))


def floored(covariance: Array) -> Array:
    """Covariance of the network's angular velocity, with the heavier tails of its errors."""
    return covariance * _NETWORK_SCALE**2 + np.eye(3) * _NETWORK_FLOOR**2


def _predicted(before: Filter | None, start_us: int, window_us: int) -> Filter | None:
    """The filter at the next window: less certain by each window since its newest one; None where it is lost."""
    if before is None or before.end_us > start_us:
        return None
    windows = 1 + (start_us - before.end_us) // window_us
    turn = _TURN_NOISE + _TURN_NOISE_SHARE * float(np.linalg.norm(before.motion[:3]))
    growth = np.array([turn**2] * 3 + [_SHIFT_NOISE**2] * 3) * windows
    kept = np.array([1.0] * 3 + [_SHIFT_KEPT**windows] * 3)
    covariance = before.covariance * np.outer(kept, kept) + np.diag(growth)
    if turn * np.sqrt(windows) > max(_LOST_SIGMA, 2 * turn):
        return None
    return Filter(before.motion * kept, covariance, start_us, before.against, before.aside)


def _prior(known: Rate, before: Filter | None, seconds: float) -> Gaussian:
    """The prior of the motion over the window: the product of the network's and the filter's."""
    information, scale = np.zeros((6, 6)), 1.0 if before is None else _REPEATED**2
    information[:3, :3] = np.linalg.inv(known.covariance * scale)
    weighted = np.concatenate([information[:3, :3] @ known.w_rad_s, np.zeros(3)])
    information[3:, 3:] = np.eye(3) / _SHIFT_SIGMA**2
    if before is not None:
        information[3:, 3:] = 0.0
        more = np.linalg.inv(before.covariance)
        information, weighted = information + more, weighted + more @ before.motion
        if before.aside < 0:
            information[[3, 4], [3, 4]] += 1 / _NOT_ASIDE**2
    return Gaussian(np.linalg.solve(information, weighted) * seconds, information / seconds**2)


def _aside(found: Found, prior: Gaussian, before: Filter | None) -> float:
    """Log odds that the camera moves across its optical axis, after a search.

    The likelihood of the events is taken for a quadratic around the maximum that the search found. What a free
    translation across the axis adds to its logarithm over none counts, less what it adds by noise alone.
    """
    odds = 0.0 if before is None else before.aside
    by_events = found.information + 1e-3 * prior.information
    best = found.motion + np.linalg.solve(by_events, prior.information @ (found.motion - prior.mean))
    weight = np.linalg.inv(np.linalg.inv(by_events)[3:5, 3:5])  # whatever the other unknowns are
    gain = float(best[3:5] @ weight @ best[3:5]) / 2
    return float(np.clip(_ODDS_KEPT * odds + max(gain, 0.0) / _DISPERSION - _NOISE_GAIN, -_MAX_ODDS, _MAX_ODDS))


def _freed(before: Filter) -> Filter:
    """The filter without what it knows of the translation."""
    covariance = before.covariance.copy()
    covariance[3:, :3], covariance[:3, 3:], covariance[3:, 3:] = 0.0, 0.0, np.eye(3) * _SHIFT_SIGMA**2
    return before._replace(covariance=covariance, motion=before.motion * np.repeat([1.0, 0.0], 3), aside=0.0)


def _guesses(known: Rate, before: Filter | None, seconds: float) -> list[Array]:
    """Where the search begins: the network, twice its rate (it is often low), and the last motion."""
    guesses = [np.concatenate([rate, np.zeros(3)]) * seconds for rate in (known.w_rad_s, 2 * known.w_rad_s)]
    return guesses if before is None else [*guesses, before.motion * seconds]


def _contradicted(w_rad_s: Array, known: Rate) -> bool:
    off = w_rad_s - known.w_rad_s
    return float(off @ np.linalg.solve(known.covariance, off)) > MAX_SIGMAS**2


def _goes_on(motion: Array, covariance: Array, before: Filter) -> bool:
    """Whether a motion continues that of the windows before, which is known well enough to outweigh the network."""
    off = motion - before.motion
    likely = float(off[:3] @ np.linalg.solve((covariance + before.covariance)[:3, :3], off[:3])) <= MAX_OFF**2
    return likely and before.against < MAX_AGAINST


def _outcome(found: Found, rays: Rays, known: Rate, covariance: Array, seconds: float, *, steady: bool) -> Outcome:
    parts = agreement(found)
    turn, shift = float(np.linalg.norm(found.motion[:3])), float(np.linalg.norm(found.motion[3:]))
    inside = float(found.tiles.events.sum()) / rays.x.size
    if turn > MAX_TURN_RAD or shift > MAX_SHIFT or inside < MIN_INSIDE:
        return "out of range"
    if parts.apart > MAX_APART * parts.noise or parts.sharp < MIN_SHARP:
        return "disagreeing"
    if np.trace(covariance[:3, :3]) > np.trace(known.covariance):
        return "no gain"
    if not steady and _contradicted(found.motion[:3] / seconds, known):
        return "contradicted"
    if float(np.linalg.norm(known.w_rad_s)) >= STILL_RAD_S:
        return "accepted"
    without = float(measure(rays, found.grid, np.zeros(6)).value.sum())
    if float(found.tiles.value.sum()) < (1 + MIN_SHARPER) * without:
        return "still"
    return "accepted"
