"""Two models on the same windows of one stream: how far apart they are, and whether the newer one may stay."""

from collections import deque
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from neurove_core.models import metadata
from neurove_core.models.bundle import Bundle

FLOOR_M_S, FLOOR_RAD_S = 0.1, 0.05
"""At rest every difference is large beside the motion: below these, it is measured against these."""

LEAST_WINDOWS = 8
"""Fewer compared windows say nothing."""

NEWEST_WINDOWS = 256
_SLOW_WINDOWS = 16
_STEADY_RATE = 0.01


class TrialLimits(NamedTuple):
    """What a model that is tried must keep to."""

    divergence: float = 1.0  # RMS difference of the estimates, in RMS of the proven model's
    rate_ratio: float = 8.0  # share of cells that fire, in that of the proven model, either way
    latency_share: float = 0.5  # median time for a window, in the window's duration
    own: metadata.BundleLimits = metadata.BundleLimits()  # what the model's bundle says of it besides, where it does

    def and_of(self, bundle: Bundle) -> "TrialLimits":
        """These, and those that a bundle sets itself: it may be stricter than the node, never laxer."""
        return self._replace(own=bundle.limits)


class Pair(NamedTuple):
    """The answers of both models to one window."""

    end_us: int
    proven: NDArray[np.float64]  # mean twist of the window (6): m/s, rad/s
    tried: NDArray[np.float64]
    proven_rate: float  # share of the estimator cells that fired in it
    tried_rate: float


class Finding(NamedTuple):
    """Why a model that is tried may not stay."""

    field: str
    value: float | str
    bound: float | str

    def __str__(self) -> str:
        value, bound = (f"{one:.3g}" if isinstance(one, float) else one for one in (self.value, self.bound))
        return f"{self.field} {value}, the bound is {bound}"


class Measured(NamedTuple):
    """What a trial on one stream has come to so far."""

    pairs: list[Pair]
    tried_ms: list[float]  # time of the newest windows [ms]
    window_ms: float
    fault: str  # what went wrong; empty where nothing did
    proven_ms: list[float] = []  # noqa: RUF012  # as tried_ms, of the proven model; never changed

    @property
    def divergence(self) -> float:
        """RMS difference of both models in RMS of the proven one, of the linear or the angular part: the larger."""
        if not self.pairs:
            return 0.0
        proven, tried = (np.array([getattr(pair, name) for pair in self.pairs]) for name in ("proven", "tried"))
        return max(
            float(_rms(tried[:, part] - proven[:, part]) / max(_rms(proven[:, part]), floor))
            for part, floor in ((slice(0, 3), FLOOR_M_S), (slice(3, 6), FLOOR_RAD_S))
        )

    def mean_difference(self, part: slice) -> float:
        """Mean length of the difference of both models [m/s or rad/s]: of the linear part 0:3, the angular part 3:6."""
        apart = [np.linalg.norm(pair.tried[part] - pair.proven[part]) for pair in self.pairs]
        return float(np.mean(apart)) if apart else 0.0

    @property
    def latency_ratio(self) -> float:
        """Median time for a window, as a multiple of the proven model's; 0 where one of both took none."""
        proven, tried = _newest_median(self.proven_ms), self.latency_ms
        return tried / proven if proven > 0 else 0.0

    @property
    def rate_ratio(self) -> float:
        """How many times more, or fewer, cells fire in the tried model."""
        means = [np.mean([getattr(one, name) for one in self.pairs]) for name in ("proven_rate", "tried_rate")]
        proven, tried = (max(float(mean), _STEADY_RATE) for mean in means)
        return max(proven / tried, tried / proven)

    @property
    def latency_ms(self) -> float:
        """Median time that the tried model takes for a window [ms]."""
        return _newest_median(self.tried_ms)

    def __str__(self) -> str:
        share = f"latency {self.latency_ms:.1f} of {self.window_ms:.0f} ms"
        return f"{len(self.pairs)} windows, divergence {self.divergence:.3g}, {share}"


def finding(measured: Measured, limits: TrialLimits, newest: int = NEWEST_WINDOWS) -> Finding | None:
    """The first limit that a trial broke, or None.

    Args:
        measured: of one stream.
        limits: to keep to.
        newest: judge so many of the newest windows.
    """
    if measured.fault:
        return Finding("fault", measured.fault, "none")
    if len(measured.tried_ms) >= LEAST_WINDOWS:
        bound_ms = limits.latency_share * measured.window_ms
        if measured.latency_ms > bound_ms:
            return Finding("latency_ms", measured.latency_ms, bound_ms)
        ratio = limits.own.latency_ratio
        if ratio is not None and len(measured.proven_ms) >= LEAST_WINDOWS and measured.latency_ratio > ratio:
            return Finding("latency_ratio", measured.latency_ratio, ratio)
    if len(measured.pairs) < LEAST_WINDOWS:
        return None
    judged = measured._replace(pairs=measured.pairs[-newest:])
    if judged.divergence > limits.divergence:
        return Finding("divergence", judged.divergence, limits.divergence)
    if judged.rate_ratio > limits.rate_ratio:
        return Finding("rate_ratio", judged.rate_ratio, limits.rate_ratio)
    for field, part in (("mean_dv_m_s", slice(0, 3)), ("mean_dw_rad_s", slice(3, 6))):
        bound = getattr(limits.own, field)
        if bound is not None and judged.mean_difference(part) > bound:
            return Finding(field, judged.mean_difference(part), bound)
    return None


class Outcome(NamedTuple):
    """One model's answer to one window, as far as it is compared."""

    end_us: int
    twist: NDArray[np.float64]
    rate: float


class Comparison:
    """Pairs the answers of two models to one stream; one of them may lag, and they may cut differently.

    The stream's worker alone writes; `measured` may be called from any thread.

    Args:
        front_is_tried: whether the model that answers is the tried one, as in probation.
        window_ms: of the tried model.
        reach_us: windows that end no further apart are compared.
    """

    def __init__(self, *, front_is_tried: bool, window_ms: float, reach_us: int) -> None:
        self.front_is_tried, self._window_ms, self._reach_us = front_is_tried, window_ms, reach_us
        self._front: deque[Outcome] = deque(maxlen=NEWEST_WINDOWS)
        self._pairs: deque[Pair] = deque(maxlen=NEWEST_WINDOWS)
        self._tried_ms: deque[float] = deque(maxlen=NEWEST_WINDOWS)
        self._proven_ms: deque[float] = deque(maxlen=NEWEST_WINDOWS)
        self.fault = ""

    def front(self, answered: Outcome, took_ms: float) -> None:
        """An answer of the model that answers the stream."""
        self._front.append(answered)
        (self._tried_ms if self.front_is_tried else self._proven_ms).append(took_ms)

    def beside(self, answered: Outcome, took_ms: float) -> None:
        """An answer of the model that runs beside it, which comes after that of the other."""
        (self._proven_ms if self.front_is_tried else self._tried_ms).append(took_ms)
        other = min(self._front, key=lambda one: abs(one.end_us - answered.end_us), default=None)
        if other is None or abs(other.end_us - answered.end_us) > self._reach_us:
            return
        proven, tried = (answered, other) if self.front_is_tried else (other, answered)
        self._pairs.append(Pair(answered.end_us, proven.twist, tried.twist, proven.rate, tried.rate))

    def measured(self) -> Measured:
        """What it has come to so far."""
        times = list(self._tried_ms), list(self._proven_ms)
        return Measured(list(self._pairs), times[0], self._window_ms, self.fault, times[1])


def _newest_median(times_ms: list[float]) -> float:
    return float(np.median(times_ms[-_SLOW_WINDOWS:])) if times_ms else 0.0


def _rms(values: NDArray[np.float64]) -> float:
    return float(np.sqrt(np.mean(values**2)))
