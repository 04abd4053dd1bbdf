"""Comparison of two models on the same windows of one stream: how far they differ, and whether the tried one may stay.

The tried model is the new one. The proven model is the one that served before it.
"""

from collections import deque
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from neurove_core.models import metadata
from neurove_core.models.bundle import Bundle

FLOOR_M_S, FLOOR_RAD_S = 0.1, 0.05
"""Lower bounds of the motion that a difference is divided by: a stationary camera has almost no motion of its own."""

MIN_WINDOWS = 8
"""With fewer compared windows no limit is checked."""

NEWEST_WINDOWS = 256
_LATENCY_WINDOWS = 16
_RATE_FLOOR = 0.01

MAX_M_S, MAX_RAD_S = 200.0, 100.0
"""RMS speeds that no camera of ours has: a model that estimates more is wrong without any comparison."""


class TrialLimits(NamedTuple):
    """The limits of a tried model."""

    divergence: float = 1.0  # RMS difference of the estimates, divided by the RMS of the proven model's
    rate_ratio: float = 8.0  # ratio of the firing rates of both models, in either direction
    latency_share: float = 0.5  # median time for a window, as a share of the window's duration
    own: metadata.BundleLimits = metadata.BundleLimits()  # further limits that the model's bundle sets
    compared: bool = True  # whether differences from the other model count; without them the model is judged alone

    def and_of(self, bundle: Bundle) -> "TrialLimits":
        """These limits together with those of a bundle, which may be stricter than the node but not laxer."""
        return self._replace(own=bundle.limits)


class WindowResult(NamedTuple):
    """The part of one model's answer to one window that is compared."""

    end_us: int
    twist: NDArray[np.float64]  # mean twist of the window (6): m/s, rad/s
    rate: float  # share of the estimator's cells that fired


class Pair(NamedTuple):
    """The answers of both models to one window."""

    end_us: int
    proven: NDArray[np.float64]  # mean twist of the window (6): m/s, rad/s
    tried: NDArray[np.float64]
    proven_rate: float  # share of the estimator's cells that fired
    tried_rate: float


class Violation(NamedTuple):
    """A limit that a tried model broke."""

    field: str
    value: float | str
    bound: float | str

    def __str__(self) -> str:
        value, bound = (f"{one:.3g}" if isinstance(one, float) else one for one in (self.value, self.bound))
        return f"{self.field} {value}, the bound is {bound}"


class TrialFigures(NamedTuple):
    """The figures of a trial on one stream so far."""

    pairs: list[Pair]
    tried_ms: list[float]  # times of the newest windows [ms]
    window_ms: float
    fault: str  # why the trial failed; empty if it did not
    proven_ms: list[float] = []  # noqa: RUF012  # as tried_ms, of the proven model; never changed

    @property
    def divergence(self) -> float:
        """RMS difference of both models in RMS of the proven one: the larger value of the linear and angular part."""
        if not self.pairs:
            return 0.0
        proven, tried = (np.array([getattr(pair, name) for pair in self.pairs]) for name in ("proven", "tried"))
        return max(
            float(_rms(tried[:, part] - proven[:, part]) / max(_rms(proven[:, part]), floor))
            for part, floor in ((slice(0, 3), FLOOR_M_S), (slice(3, 6), FLOOR_RAD_S))
        )

    def mean_difference(self, part: slice) -> float:
        """Mean length of the difference of both models: the linear part 0:3 [m/s] or the angular part 3:6 [rad/s]."""
        apart = [np.linalg.norm(pair.tried[part] - pair.proven[part]) for pair in self.pairs]
        return float(np.mean(apart)) if apart else 0.0

    def speed(self, part: slice) -> float:
        """RMS speed of the tried model: the linear part 0:3 [m/s] or the angular part 3:6 [rad/s]."""
        rows = np.array([pair.tried[part] for pair in self.pairs])
        return float(np.sqrt(np.mean((rows**2).sum(axis=1)))) if len(rows) else 0.0

    @property
    def latency_ratio(self) -> float:
        """Median time for a window, as a multiple of the proven model's; 0 if either model has no time yet."""
        proven, tried = _newest_median(self.proven_ms), self.latency_ms
        return tried / proven if proven > 0 else 0.0

    @property
    def rate_ratio(self) -> float:
        """The larger firing rate of both models divided by the smaller one."""
        means = [np.mean([getattr(one, name) for one in self.pairs]) for name in ("proven_rate", "tried_rate")]
        proven, tried = (max(float(mean), _RATE_FLOOR) for mean in means)
        return max(proven / tried, tried / proven)

    @property
    def latency_ms(self) -> float:
        """Median time that the tried model takes for a window [ms]."""
        return _newest_median(self.tried_ms)

    def __str__(self) -> str:
        share = f"latency {self.latency_ms:.1f} of {self.window_ms:.0f} ms"
        return f"{len(self.pairs)} windows, divergence {self.divergence:.3g}, {share}"


def violation(figures: TrialFigures, limits: TrialLimits, newest: int = NEWEST_WINDOWS) -> Violation | None:
    """The first limit that a trial broke, or None.

    Args:
        figures: of one stream.
        limits: the limits of the tried model.
        newest: number of newest windows that are evaluated.
    """
    if figures.fault:
        return Violation("fault", figures.fault, "none")
    if len(figures.tried_ms) >= MIN_WINDOWS:
        bound_ms = limits.latency_share * figures.window_ms
        if figures.latency_ms > bound_ms:
            return Violation("latency_ms", figures.latency_ms, bound_ms)
        ratio = limits.own.latency_ratio if limits.compared else None
        if ratio is not None and len(figures.proven_ms) >= MIN_WINDOWS and figures.latency_ratio > ratio:
            return Violation("latency_ratio", figures.latency_ratio, ratio)
    if len(figures.pairs) < MIN_WINDOWS:
        return None
    recent = figures._replace(pairs=figures.pairs[-newest:])
    for field, part, most in (("speed_m_s", slice(0, 3), MAX_M_S), ("speed_rad_s", slice(3, 6), MAX_RAD_S)):
        if recent.speed(part) > most:
            return Violation(field, recent.speed(part), most)
    if not limits.compared:
        return None
    if recent.divergence > limits.divergence:
        return Violation("divergence", recent.divergence, limits.divergence)
    if recent.rate_ratio > limits.rate_ratio:
        return Violation("rate_ratio", recent.rate_ratio, limits.rate_ratio)
    for field, part in (("mean_dv_m_s", slice(0, 3)), ("mean_dw_rad_s", slice(3, 6))):
        bound = getattr(limits.own, field)
        if bound is not None and recent.mean_difference(part) > bound:
            return Violation(field, recent.mean_difference(part), bound)
    return None


class Comparison:
    """Pairs the answers of two models to one stream; the standby model may lag, and the windows may differ.

    Only the worker of the stream writes; any thread may call `figures`.

    Args:
        serving_is_tried: whether the serving model is the tried one, as in probation.
        window_ms: window duration of the tried model [ms].
        reach_us: windows whose ends are at most this far apart are compared [us].
    """

    def __init__(self, *, serving_is_tried: bool, window_ms: float, reach_us: int) -> None:
        self.serving_is_tried, self._window_ms, self._reach_us = serving_is_tried, window_ms, reach_us
        self._serving: deque[WindowResult] = deque(maxlen=NEWEST_WINDOWS)
        self._pairs: deque[Pair] = deque(maxlen=NEWEST_WINDOWS)
        self._tried_ms: deque[float] = deque(maxlen=NEWEST_WINDOWS)
        self._proven_ms: deque[float] = deque(maxlen=NEWEST_WINDOWS)
        self.fault = ""

    def add_serving(self, result: WindowResult, took_ms: float) -> None:
        """Add an answer of the serving model."""
        self._serving.append(result)
        (self._tried_ms if self.serving_is_tried else self._proven_ms).append(took_ms)

    def add_standby(self, result: WindowResult, took_ms: float) -> None:
        """Add an answer of the standby model, after that of the serving model."""
        (self._proven_ms if self.serving_is_tried else self._tried_ms).append(took_ms)
        other = min(self._serving, key=lambda one: abs(one.end_us - result.end_us), default=None)
        if other is None or abs(other.end_us - result.end_us) > self._reach_us:
            return
        proven, tried = (result, other) if self.serving_is_tried else (other, result)
        self._pairs.append(Pair(result.end_us, proven.twist, tried.twist, proven.rate, tried.rate))

    def figures(self) -> TrialFigures:
        """The figures so far."""
        times = list(self._tried_ms), list(self._proven_ms)
        return TrialFigures(list(self._pairs), times[0], self._window_ms, self.fault, times[1])


def _newest_median(times_ms: list[float]) -> float:
    return float(np.median(times_ms[-_LATENCY_WINDOWS:])) if times_ms else 0.0


def _rms(values: NDArray[np.float64]) -> float:
    return float(np.sqrt(np.mean(values**2)))
