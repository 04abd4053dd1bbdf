"""The comparison of two models on the held-out pieces of the recordings of one robot."""

from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from neurove_core.adaptation.pieces import Span, inside_any
from neurove_core.evaluation.estimates import Estimates
from neurove_core.evaluation.metrics import ANGULAR_FLOOR_RAD_S, LINEAR_FLOOR_M_S, relative_error, rmse
from neurove_core.geometry.motion import Twists
from neurove_core.models.uncertainty import LEVEL, coverage, half_width
from neurove_protocol.velocity import AXES

LEAST_GAIN: Final = 0.03
"""An adapted model is better if the RMSE of a part falls by at least this share, and that of no part rises by it."""

_SAMPLES: Final = 4  # samples of the truth per bin; the bin has their mean
_PARTS: Final = (("v_l", slice(0, 3), LINEAR_FLOOR_M_S), ("v_a", slice(3, 6), ANGULAR_FLOOR_RAD_S))
_BOUNDS: Final = (1.0, 4.0)  # of the factor of sigma: a short piece does not show that intervals are too wide

_PRIOR: Final = 0.1  # weight of a gain of 1, as a share of the recording
_GAINS: Final = (0.5, 2.0)

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Paired:
    """Estimates with their truth, bin by bin, within some spans; N bins."""

    truth: Array  # (N, 6); nan: unknown
    estimate: Array  # (N, 6)
    sigma: Array | None  # (N, 6); None without an uncertainty


def pair(estimates: Estimates, truth: Twists, spans: tuple[Span, ...]) -> Paired:
    """Pair the windows of some spans with the mean truth of each bin."""
    bins = estimates.twists.shape[1]
    kept = inside_any(estimates.start_us, estimates.start_us + bins * estimates.bin_us, spans)
    offsets = (np.arange(bins * _SAMPLES) + 0.5) * (estimates.bin_us / _SAMPLES)
    t_us = (estimates.start_us[kept][:, None] + offsets).astype(np.int64)
    true = truth.at(t_us.ravel()).reshape(-1, _SAMPLES, 6).mean(axis=1)
    sigma = None if estimates.sigma is None else np.repeat(estimates.sigma[kept], bins, axis=0)
    return Paired(true, estimates.twists[kept].reshape(-1, 6), sigma)


def joined(parts: list[Paired]) -> Paired:
    """The bins of several recordings one after the other."""
    sigmas = [one.sigma for one in parts if one.sigma is not None]
    return Paired(
        np.concatenate([one.truth for one in parts]),
        np.concatenate([one.estimate for one in parts]),
        np.concatenate(sigmas) if len(sigmas) == len(parts) else None,
    )


def figures(found: Paired) -> dict[str, Any]:
    """RE and RMSE of both parts over their known axes, and RMSE and coverage of each axis; None where unknown."""
    report: dict[str, Any] = {"bins": len(found.truth)}
    for name, part, floor in _PARTS:
        axes = np.arange(6)[part][np.isfinite(found.truth[:, part]).any(0)]
        known = np.isfinite(found.truth[:, axes]).all(1) & (len(axes) > 0)
        error, true = (found.estimate - found.truth)[known][:, axes], found.truth[known][:, axes]
        report[name] = {
            "re": relative_error(error, true, floor) if len(true) else None,
            "rmse": rmse(error) if len(true) else None,
        }
    report["axes"] = {axis: _axis(found, i) for i, axis in enumerate(AXES)}
    return report


def sigma_factor(found: Paired) -> Array:
    """Factors (6) of sigma by which the intervals of LEVEL would hold that share of the errors; 1 where unknown."""
    factor = np.ones(6)
    if found.sigma is None:
        return factor
    for axis in range(6):
        known = np.isfinite(found.truth[:, axis])
        if known.any():
            ratio = np.abs(found.estimate - found.truth)[known, axis] / found.sigma[known, axis]
            factor[axis] = np.clip(np.quantile(ratio, LEVEL) / half_width(LEVEL), *_BOUNDS)
    return factor


def gains(found: Paired) -> Array:
    """Gain (6) of each axis that brings its estimates closest to the truth; 1 where it is unknown.

    It has no offset, so that a stationary robot stays stationary. It is drawn towards 1, and bounded: an axis that the
    model does not see would else get a gain of 0.
    """
    gain = np.ones(6)
    for axis in range(6):
        known = np.isfinite(found.truth[:, axis])
        estimate, true = found.estimate[known, axis], found.truth[known, axis]
        power = float(estimate @ estimate)
        if power > 0:
            gain[axis] = np.clip((estimate @ true + _PRIOR * power) / ((1 + _PRIOR) * power), *_GAINS)
    return gain


def score(found: Paired) -> float:
    """Product of the RMSE of the known parts; smaller is better."""
    report = figures(found)
    return float(np.prod([report[name]["rmse"] for name, _, _ in _PARTS if report[name]["rmse"] is not None]))


def verdict(before: dict[str, Any], after: dict[str, Any]) -> tuple[bool, str]:
    """Whether the model after is better than the one before, and one sentence that says why."""
    changes = {
        name: after[name]["rmse"] / max(before[name]["rmse"], 1e-9) - 1
        for name, _, _ in _PARTS
        if before[name]["rmse"] is not None and after[name]["rmse"] is not None
    }
    said = " and ".join(
        f"the RMSE of {name} {'falls' if by < 0 else 'rises'} by {abs(by):.0%}" for name, by in changes.items()
    )
    if not changes:
        return False, "not better: no part of the truth is known on the held-out pieces"
    better = min(changes.values()) <= -LEAST_GAIN and max(changes.values()) < LEAST_GAIN
    return better, f"{'better' if better else 'not better'}: on the held-out pieces {said}"


def _axis(found: Paired, axis: int) -> dict[str, float | None]:
    known = np.isfinite(found.truth[:, axis])
    if not known.any():
        return {"rmse": None, "coverage": None}
    error = (found.estimate - found.truth)[known, axis]
    covered = None
    if found.sigma is not None:
        covered = float(coverage(error[:, None], found.sigma[known, axis][:, None], LEVEL)[0])
    return {"rmse": rmse(error[:, None]), "coverage": covered}
