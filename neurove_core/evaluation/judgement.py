"""The figures of a model in one sentence: is it better than two predictors that do not look at the events?"""

from typing import Any, Final

_GROUPS: Final = (("linear", "v_l", "m_s", "m/s"), ("angular", "v_a", "deg_s", "deg/s"))
_EVEN: Final = 0.05  # a difference in RMSE below this share decides nothing


def judgement(report: dict[str, Any]) -> str:
    """Compare the RMSE of a report with the mean of the truth, the best constant, and with zero velocity.

    Args:
        report: of `evaluate.report`, with its predictors `mean` and `zero`.

    >>> mean, zero = {"rmse_v_l_m_s": 1.0, "rmse_v_a_deg_s": 0.5}, {"rmse_v_l_m_s": 4.0, "rmse_v_a_deg_s": 1.5}
    >>> found = {"rmse_v_l_m_s": 0.25, "r2_v_l": 0.94, "rmse_v_a_deg_s": 0.7, "r2_v_a": -1.0}
    >>> print(judgement(found | {"mean": mean, "zero": zero}))
    linear velocity is better than any constant (0.25 m/s; mean of the truth 1, zero 4); \
angular velocity is worse than the mean of the truth (0.7 deg/s; mean of the truth 0.5, zero 1.5)
    """
    return "; ".join(_of_group(report, *group) for group in _GROUPS)


def _of_group(report: dict[str, Any], words: str, group: str, suffix: str, unit: str) -> str:
    rmse, mean, zero = (one[f"rmse_{group}_{suffix}"] for one in (report, report["mean"], report["zero"]))
    if report[f"r2_{group}"] is None:  # the mean of a constant truth has no error, so it says nothing
        known = f"{words} velocity has a constant truth"
        if zero <= mean + 1e-9:
            return f"{known} of zero, and is off by {rmse:.3g} {unit}"
        return f"{known}, and is {_better(rmse, zero)} zero velocity ({rmse:.3g} {unit}; zero {zero:.3g})"
    figures = f"({rmse:.3g} {unit}; mean of the truth {mean:.3g}, zero {zero:.3g})"
    if rmse < (1 - _EVEN) * min(mean, zero):
        return f"{words} velocity is better than any constant {figures}"
    worse_than, least = ("zero velocity", zero) if rmse > (1 + _EVEN) * zero else ("the mean of the truth", mean)
    return f"{words} velocity is {_better(rmse, least)} {worse_than} {figures}"


def _better(rmse: float, other: float) -> str:
    if rmse < (1 - _EVEN) * other:
        return "better than"
    return "worse than" if rmse > (1 + _EVEN) * other else "no better than"
