"""Compare the estimates of a model with the truth, see `estimates`."""

from collections import Counter
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from neurove_core.evaluation.estimates import Estimates
from neurove_core.evaluation.judgement import judgement
from neurove_core.evaluation.metrics import ANGULAR_FLOOR_RAD_S, LINEAR_FLOOR_M_S, SKIP_S, figures
from neurove_core.geometry.motion import Twists
from neurove_core.models.uncertainty import LEVEL, LEVELS, coverage
from neurove_protocol.errors import NeuroVEError
from neurove_protocol.velocity import AXES

_SAMPLES = 4  # samples of the truth per bin; the bin has their mean


class NoTruth(NeuroVEError):
    """There is no truth to evaluate the estimates against."""

    code = "no_truth"


@dataclass(frozen=True)
class Evaluation:
    """Estimates with their truth, bin by bin, for windows with a known truth after the first SKIP_S; N bins."""

    estimates: Estimates
    end_us: NDArray[np.int64]  # (N,) end of each bin
    truth: NDArray[np.float64]  # (N, 6)
    estimate: NDArray[np.float64]  # (N, 6)
    sigma: NDArray[np.float64] | None = None  # (N, 6), or None
    uncertain: NDArray[np.bool_] | None = None  # (N,), or None


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
