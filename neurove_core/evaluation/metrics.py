"""Error figures of estimates: RMSE and RE as the paper defines them, per group of three and per axis.

Linear velocity is in m/s. Angular velocity is in rad/s, and in deg/s where a name says so.
"""

from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from neurove_protocol.velocity import AXES

LINEAR, ANGULAR = slice(0, 3), slice(3, 6)

LINEAR_FLOOR_M_S: Final = 0.5
ANGULAR_FLOOR_RAD_S: Final = 0.02
"""RE counts only truths above these floors. It divides by the truth, so it diverges near standstill."""

SKIP_S: Final = 0.5
"""Time at the beginning of a recording that is left out, because the state settles."""

_CONSTANT: Final = 1e-6  # [m/s] or [rad/s]
_CONSTANT_SHARE: Final = 1e-3  # of the length of the truth

Array = NDArray[np.float64]
Figures = dict[str, float | None]


def rmse(error: Array) -> float:
    """Root mean square of the lengths of the errors (N, 3), or (N, 1) for one axis.

    Source: NeuroVE, Eq. (11): RMSE(x) = sqrt(1/n sum |x_gt - x|^2).

    >>> rmse(np.array([[3.0, 4.0, 0.0], [0.0, 0.0, 0.0]]))
    3.5355339059327378
    """
    return float(np.sqrt((error**2).sum(-1).mean()))


def relative_error(error: Array, truth: Array, floor: float = 0.0) -> float | None:
    """Mean of |error| / |truth| where the truth (N, 3) is longer than `floor`; None if it never is.

    Source: NeuroVE, Eq. (11): RE(x) = 1/n sum |x_gt - x| / x_gt.
    Differs: divides by the length of the vector x_gt, which the paper prints without its bars, and counts only lengths
    above a floor. With floor 0 only truths of exactly 0 are left out.

    >>> relative_error(np.array([[0.0, 0, 1], [9, 9, 9]]), np.array([[0.0, 0, 4], [0, 0, 0]]))
    0.25
    """
    length = np.linalg.norm(truth, axis=-1)
    counted = length > floor
    if not counted.any():
        return None
    return float((np.linalg.norm(error[counted], axis=-1) / length[counted]).mean())


def figures(truth: Array, estimate: Array, bins: int) -> dict[str, Any]:
    """Compute all figures of some estimates.

    Args:
        truth: twists (N, 6) [m/s, rad/s], one per bin; finite.
        estimate: of the same bins.
        bins: per window; N is a multiple of it.

    Returns:
        RMSE and RE of the paper for v_l and v_a, separate errors of speed and direction, medians, the worst window (by
        the mean length of its errors), R2, and the figures of each axis.
    """
    error = estimate - truth
    found: dict[str, Any] = {"windows": len(truth) // bins}
    for group, part, unit, floor in (
        ("v_l", LINEAR, "m_s", LINEAR_FLOOR_M_S),
        ("v_a", ANGULAR, "rad_s", ANGULAR_FLOOR_RAD_S),
    ):
        e, t, a = error[:, part], truth[:, part], estimate[:, part]
        length = np.linalg.norm(e, axis=1)
        worst = length.reshape(-1, bins).mean(1)
        found |= {
            f"rmse_{group}_{unit}": rmse(e),
            f"re_{group}": relative_error(e, t, floor),
            f"re_{group}_unfloored": relative_error(e, t),
            f"median_error_{group}_{unit}": float(np.median(length)),
            f"worst_window_{group}": int(worst.argmax()),
            f"worst_window_error_{group}_{unit}": float(worst.max()),
            f"r2_{group}": r2(t, a),
            f"spread_{group}_{unit}": rmse(t - t.mean(0)),
            f"speed_rmse_{group}_{unit}": rmse((np.linalg.norm(a, axis=1) - np.linalg.norm(t, axis=1))[:, None]),
            f"median_direction_error_{group}_deg": direction_error_deg(t, a, floor),
        }
    for name in [name for name in found if name.endswith("_rad_s")]:
        found[name.removesuffix("_rad_s") + "_deg_s"] = float(np.degrees(found[name]))
    found["per_axis"] = {axis: _axis(truth[:, i], estimate[:, i], angular=i >= 3) for i, axis in enumerate(AXES)}
    return found


def r2(truth: Array, estimate: Array) -> float | None:
    """Share of the variance of the truth that the estimates explain; None if the truth is constant."""
    if is_constant(truth):
        return None
    return float(1 - ((estimate - truth) ** 2).sum() / ((truth - truth.mean(0)) ** 2).sum())


def is_constant(truth: Array) -> bool:
    """Whether a truth (N, 3) or (N, 1) varies by no more than rounding and interpolation do.

    >>> is_constant(np.full((4, 1), 0.3) + 1e-9 * np.arange(4)[:, None])
    True
    """
    return rmse(truth - truth.mean(0)) <= max(_CONSTANT, _CONSTANT_SHARE * rmse(truth))


def direction_error_deg(truth: Array, estimate: Array, floor: float) -> float | None:
    """Median angle between the vectors [deg] where the truth is above the floor; None if it never is."""
    lengths = np.linalg.norm(truth, axis=1), np.linalg.norm(estimate, axis=1)
    counted = (lengths[0] > floor) & (lengths[1] > 0)
    if not counted.any():
        return None
    cosine = (truth * estimate).sum(1)[counted] / (lengths[0] * lengths[1])[counted]
    return float(np.degrees(np.median(np.arccos(np.clip(cosine, -1, 1)))))


def _axis(truth: Array, estimate: Array, *, angular: bool) -> Figures:
    error = estimate - truth
    unit = "rad_s" if angular else "m_s"
    correlated = not is_constant(truth[:, None]) and estimate.std() > 0
    found: Figures = {
        f"rmse_{unit}": rmse(error[:, None]),
        f"median_error_{unit}": float(np.median(np.abs(error))),
        f"bias_{unit}": float(error.mean()),
        f"spread_{unit}": float(truth.std()),
        "r2": r2(truth[:, None], estimate[:, None]),
        "correlation": float(np.corrcoef(truth, estimate)[0, 1]) if correlated else None,
    }
    if angular:
        found |= {name.replace("rad_s", "deg_s"): _degrees(value) for name, value in found.items() if "rad_s" in name}
    return found


def _degrees(value: float | None) -> float | None:
    return None if value is None else float(np.degrees(value))
