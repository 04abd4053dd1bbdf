"""Run a model on a recording as the service does, packet by packet, and compare its estimates with the truth."""

import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from neurove_core.aided import aided
from neurove_core.estimator import Estimator, PushResult, WindowEstimate
from neurove_core.evaluation.judgement import judgement
from neurove_core.evaluation.metrics import ANGULAR_FLOOR_RAD_S, LINEAR_FLOOR_M_S, SKIP_S, figures
from neurove_core.geometry.motion import Twists
from neurove_core.inertial.state import InertialState, push
from neurove_core.io.imu_feed import ImuFeed
from neurove_core.io.packets import slices
from neurove_core.io.recording import Recording
from neurove_core.models.uncertainty import LEVEL, LEVELS, coverage
from neurove_core.networks.arrays import ArrayState, State
from neurove_protocol.camera import CameraInfo
from neurove_protocol.errors import NeuroVEError
from neurove_protocol.velocity import AXES, Source

_SAMPLES = 4  # samples of the truth per bin; the bin has their mean
_STREAM = "evaluate"


class NoTruth(NeuroVEError):
    """There is no truth to evaluate the estimates against."""

    code = "no_truth"


@dataclass(frozen=True)
class Estimates:
    """The estimates of a model for one recording; W windows of n bins."""

    name: str
    start_us: NDArray[np.int64]  # (W,) of the windows
    bin_us: int
    twists: NDArray[np.float64]  # (W, n, 6) [m/s, rad/s]
    events: NDArray[np.int64]  # (W,)
    low_activity: NDArray[np.bool_]  # (W,) flagged as in the service
    latency_ms: NDArray[np.float64]  # (W,) duration of the push that completed the window
    firing_rate: dict[
        str, float
    ]  # share of neurons that fire per step, by layer and overall; empty for a network without spikes
    scaled: bool  # the camera height is known; otherwise the linear part assumes 1 m
    sigma: NDArray[np.float64] | None = (
        None  # (W, 6) of the twists of each window; None if the model has no uncertainty
    )
    uncertain: NDArray[np.bool_] | None = None  # (W,) windows flagged as uncertain
    sources: tuple[Source, ...] = ()  # (W,) origin of the angular part of each window


@dataclass(frozen=True)
class Evaluation:
    """Estimates with their truth, bin by bin, for windows with a known truth after the first SKIP_S; N bins."""

    estimates: Estimates
    end_us: NDArray[np.int64]  # (N,) end of each bin
    truth: NDArray[np.float64]  # (N, 6)
    estimate: NDArray[np.float64]  # (N, 6)
    sigma: NDArray[np.float64] | None = None  # (N, 6), or None
    uncertain: NDArray[np.bool_] | None = None  # (N,), or None


def estimate_recording(
    estimator: Estimator,
    recording: Recording,
    camera: CameraInfo | None = None,
    on_events: Callable[[int], None] = lambda _: None,
    *,
    inertial: bool = False,
) -> Estimates:
    """Run a model on a recording, packet by packet as a driver sends it.

    Args:
        estimator: the model.
        recording: its input.
        camera: lens of the recording; by default the one that the recording gives.
        on_events: called after each packet with the number of events so far.
        inertial: use the recording's inertial samples too, as the service does.

    Raises:
        InvalidField: the lens belongs to another sensor.
    """
    camera = camera or recording.camera(_STREAM)
    state = estimator.initial_state(recording.sensor, camera)
    found: list[WindowEstimate] = []
    latencies_ms: list[float] = []
    firing_rate = _FiringRate()
    events = 0
    feed, unit = ImuFeed(recording) if inertial and "imu" in recording.streams else None, InertialState()
    for piece in slices(recording.chunks()):
        if feed is not None:
            unit, _ = push(unit, feed.until(piece.end_us))
        began = time.perf_counter()
        pushed = estimator.push(piece.events, state, piece.t0_us)
        if feed is not None:
            pushed, unit = _aided(estimator, pushed, unit, camera)
        took_ms = (time.perf_counter() - began) * 1e3
        state = pushed.state
        found += pushed.estimates
        latencies_ms += [took_ms / max(1, len(pushed.estimates))] * len(pushed.estimates)
        if pushed.estimates and state.age:
            firing_rate.add(state.network)
        events += piece.events.n
        on_events(events)
    bins = estimator.config.window.bins
    return Estimates(
        name=recording.name,
        start_us=np.array([one.start_us for one in found], np.int64),
        bin_us=estimator.config.window.bin_us,
        twists=np.stack([one.twists for one in found]) if found else np.zeros((0, bins, 6)),
        events=np.array([one.events for one in found], np.int64),
        low_activity=np.array([one.low_activity for one in found], np.bool_),
        latency_ms=np.array(latencies_ms),
        firing_rate=firing_rate.rates(),
        scaled=camera is not None and camera.height_m is not None,
        sigma=_sigmas(found),
        uncertain=None if _sigmas(found) is None else np.array([one.uncertain for one in found], np.bool_),
        sources=tuple(one.source for one in found),
    )


def _aided(
    estimator: Estimator, pushed: PushResult, unit: InertialState, camera: CameraInfo | None
) -> tuple[PushResult, InertialState]:
    found = []
    for estimate in pushed.estimates:
        one, unit = aided(estimator, estimate, unit, camera)
        found.append(one)
    return pushed._replace(estimates=found), unit


def _sigmas(found: list[WindowEstimate]) -> NDArray[np.float64] | None:
    covariances = [one.covariance for one in found if one.covariance is not None]
    return np.sqrt(np.stack([np.diagonal(one) for one in covariances])) if covariances else None


class _FiringRate:
    """Counts spikes and neurons by layer, from the state of the network."""

    def __init__(self) -> None:
        self._spikes, self._neurons = dict[str, int](), dict[str, int]()

    def add(self, state: State) -> None:
        for layer, spikes in _fired(state).items():
            self._spikes[layer] = self._spikes.get(layer, 0) + int(spikes.sum())
            self._neurons[layer] = self._neurons.get(layer, 0) + spikes.size

    def rates(self) -> dict[str, float]:
        if not self._spikes:
            return {}
        rates = {layer: spikes / self._neurons[layer] for layer, spikes in self._spikes.items()}
        return rates | {"all": sum(self._spikes.values()) / sum(self._neurons.values())}


def _fired(state: State) -> dict[str, NDArray[np.bool_]]:
    """Which neurons fired in the last step, by layer."""
    if isinstance(state, ArrayState):
        return state.fired()
    from neurove_core.networks import kinds

    return {layer: spikes.numpy() for layer, spikes in kinds.fired(state).items()}  # type: ignore[arg-type]  # of torch


def evaluate(estimates: Estimates, truth: Twists) -> Evaluation:
    """Pair each bin of the estimates with the mean truth over the bin.

    The first SKIP_S of the recording are left out, and windows that the truth does not cover completely.

    Raises:
        NoTruth: no window is left.
    """
    windows, bins = estimates.twists.shape[:2]
    offsets = (np.arange(bins * _SAMPLES) + 0.5) * (estimates.bin_us / _SAMPLES)
    t_us = (estimates.start_us[:, None] + offsets).astype(np.int64)
    true = truth.at(t_us.ravel()).reshape(windows, bins, _SAMPLES, 6).mean(axis=2)
    settled = estimates.start_us >= (estimates.start_us[0] if windows else 0) + SKIP_S * 1e6
    kept = settled & np.isfinite(true).all(axis=(1, 2))
    if not kept.any():
        spans = f"windows {_span(estimates.start_us)}, truth {_span(truth.t)} on the sensor clock"
        why = f"none of its {windows} windows lies after the first {SKIP_S:g} s and within the truth ({spans})"
        raise NoTruth(f"{estimates.name}: {why}", windows=windows)
    ends = (estimates.start_us[:, None] + estimates.bin_us * (np.arange(bins) + 1))[kept].ravel()
    sigma = None if estimates.sigma is None else np.repeat(estimates.sigma[kept], bins, axis=0)
    uncertain = None if estimates.uncertain is None else np.repeat(estimates.uncertain[kept], bins)
    return Evaluation(
        estimates, ends, true[kept].reshape(-1, 6), estimates.twists[kept].reshape(-1, 6), sigma, uncertain
    )


def _span(t_us: NDArray[np.int64]) -> str:
    return f"{t_us[0] / 1e6:.3f} to {t_us[-1] / 1e6:.3f} s" if t_us.size else "none"


def report(evaluations: list[Evaluation]) -> dict[str, Any]:
    """Compute all figures over all recordings and over each one, and those of two constant predictors.

    The predictor `zero` always gives 0. The predictor `mean` gives the mean of the truth of these recordings, which is
    the best constant. `judgement` compares the model with both in one sentence.
    """
    bins = evaluations[0].estimates.twists.shape[1]
    truth, estimate = (
        np.concatenate(parts) for parts in zip(*((one.truth, one.estimate) for one in evaluations), strict=True)
    )
    latency_ms = np.concatenate([one.estimates.latency_ms for one in evaluations])
    rates = [one.estimates.firing_rate for one in evaluations]
    every = {layer: float(np.mean([rate[layer] for rate in rates])) for layer in rates[0]}
    found = figures(truth, estimate, bins) | {
        "firing_rate": every.pop("all", None),
        "firing_rate_by_layer": every,
        "latency_ms": {f"p{q}": float(np.percentile(latency_ms, q)) for q in (50, 99)},
        "re_floors": {"v_l_m_s": LINEAR_FLOOR_M_S, "v_a_rad_s": ANGULAR_FLOOR_RAD_S},
        "skipped_s": SKIP_S,
        "scaled": all(one.estimates.scaled for one in evaluations),
        "zero": figures(truth, np.zeros_like(truth), bins),
        "mean": figures(truth, np.broadcast_to(truth.mean(0), truth.shape), bins),
        "uncertainty": reliability(evaluations),
        "source_share": _source_share(evaluations),
        "recordings": [
            {"name": one.estimates.name} | figures(one.truth, one.estimate, bins) | {"uncertainty": reliability([one])}
            for one in evaluations
        ],
    }
    return found | {"judgement": judgement(found)}


def _source_share(evaluations: list[Evaluation]) -> dict[str, float]:
    """Share of the windows by the origin of their angular part."""
    found = Counter(source for one in evaluations for source in one.estimates.sources)
    return {source: count / found.total() for source, count in sorted(found.items())}


def reliability(evaluations: list[Evaluation]) -> dict[str, Any] | None:
    """Compute how often the truth lies within the intervals of the estimates; None if some have no uncertainty.

    `coverage` has the measured share for each nominal share, by axis. `per_axis` has the measured share for LEVEL, the
    median sigma, and the root mean square of error over sigma, which is 1 if the claimed sigma is correct.
    """
    claimed = [one.sigma for one in evaluations if one.sigma is not None]
    flagged = [one.uncertain for one in evaluations if one.uncertain is not None]
    if len(claimed) < len(evaluations):
        return None
    sigma, error = np.concatenate(claimed), np.concatenate([one.estimate - one.truth for one in evaluations])
    measured = {level: coverage(error, sigma, level) for level in LEVELS}
    middle, ratio = np.median(sigma, axis=0), np.sqrt(((error / sigma) ** 2).mean(0))
    return {
        "level": LEVEL,
        "uncertain_share": float(np.concatenate(flagged).mean()),
        "coverage": {axis: {str(n): float(one[i]) for n, one in measured.items()} for i, axis in enumerate(AXES)},
        "per_axis": {
            axis: {
                "coverage": float(measured[LEVEL][i]),
                **_sigma(float(middle[i]), angular=i >= 3),
                "error_over_sigma_rms": float(ratio[i]),
            }
            for i, axis in enumerate(AXES)
        },
    }


def _sigma(sigma: float, *, angular: bool) -> dict[str, float]:
    if angular:
        return {"median_sigma_rad_s": sigma, "median_sigma_deg_s": float(np.degrees(sigma))}
    return {"median_sigma_m_s": sigma}
