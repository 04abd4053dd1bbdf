"""How far estimates lie from the truth: RMSE and RE as the paper defines them, per group of three and per axis.

Linear velocity in m/s; angular velocity in rad/s, and in deg/s where a name says so.
"""

from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from neurove_protocol.velocity import AXES

LINEAR, ANGULAR = slice(0, 3), slice(3, 6)

LINEAR_FLOOR_M_S: Final = 0.5
ANGULAR_FLOOR_RAD_S: Final = 0.02
"""RE counts where the truth is above these: it divides by the truth, and explodes near standstill."""

SKIP_S: Final = 0.5
"""How much of the beginning of a recording is left out: the state settles."""

Array = NDArray[np.float64]
Figures = dict[str, float | None]


def rmse(error: Array) -> float:
    """Root of the mean squared length of the errors (N, 3), or (N, 1) for one axis.

    Source: NeuroVE, Eq. (11): RMSE(x) = sqrt(1/n sum |x_gt - x|^2).

    >>> rmse(np.array([[3.0, 4.0, 0.0], [0.0, 0.0, 0.0]]))
    3.5355339059327378
    """
    return float(np.sqrt((error**2).sum(-1).mean()))


def relative_error(error: Array, truth: Array, floor: float = 0.0) -> float | None:
    """Mean of the errors' lengths over the truth's, where the truth (N, 3) is longer than `floor`; None if nowhere.

    Source: NeuroVE, Eq. (11): RE(x) = 1/n sum |x_gt - x| / x_gt.
    Differs: divides by the length of the vector x_gt, which the paper prints without its bars; counts where that is
    above a floor. With floor 0 the truths of exactly 0 alone are left out.

    >>> relative_error(np.array([[0.0, 0, 1], [9, 9, 9]]), np.array([[0.0, 0, 4], [0, 0, 0]]))
    0.25
    """
    length = np.linalg.norm(truth, axis=-1)
    counted = length > floor
    if not counted.any():
        return None
    return float((np.linalg.norm(error[counted], axis=-1) / length[counted]).mean())


def figures(truth: Array, estimate: Array, bins: int) -> dict[str, Any]:
    """All figures of some answers.

    Args:
        truth: twists (N, 6) [m/s, rad/s], one per bin; finite.
        estimate: of the same bins.
        bins: per window: N is a multiple of it.

    Returns:
        the paper's RMSE and RE for v_l and v_a, speed error and direction error apart, medians, the worst window
        (by the mean length of its errors), R2, and all that is defined for one axis, by axis.
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
    """Share of the truth's variance that the answers explain; None where the truth does not vary."""
    variance = ((truth - truth.mean(0)) ** 2).sum()
    return float(1 - ((estimate - truth) ** 2).sum() / variance) if variance > 0 else None


def direction_error_deg(truth: Array, estimate: Array, floor: float) -> float | None:
    """Median angle between the vectors [deg], where the truth is above the floor; None if nowhere."""
    lengths = np.linalg.norm(truth, axis=1), np.linalg.norm(estimate, axis=1)
    counted = (lengths[0] > floor) & (lengths[1] > 0)
    if not counted.any():
        return None
    cosine = (truth * estimate).sum(1)[counted] / (lengths[0] * lengths[1])[counted]
    return float(np.degrees(np.median(np.arccos(np.clip(cosine, -1, 1)))))


def _axis(truth: Array, estimate: Array, *, angular: bool) -> Figures:
    error = estimate - truth
    unit = "rad_s" if angular else "m_s"
    correlated = truth.std() > 0 and estimate.std() > 0
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
