"""Evaluate a model on all sets of the motion experiment, by the Estimator as the service uses it."""

import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from neurove_core.estimator import Estimator
from neurove_core.evaluation.estimates import estimate_recordings
from neurove_core.evaluation.evaluate import Evaluation, evaluate, reliability
from neurove_core.evaluation.metrics import figures, relative_error
from neurove_core.experiments import real, save_text
from neurove_core.experiments.motion import goals, sets
from neurove_core.experiments.motion.goals import Goal, row
from neurove_core.experiments.motion.kept import fill, kept
from neurove_core.tasks import HERE, Pool
from neurove_protocol.velocity import AXES

Show = Callable[[str, int, int, str], None]
"""Reports progress: the task, the steps done, the steps in total, and a detail."""

SLOW_FLOOR_M_S: Final = 0.1
"""The relative error of slow drives counts speeds above this; elsewhere it is 0.5 m/s."""

Found = dict[str, list[tuple[str, Evaluation]]]
"""By set: names of recordings with the estimates and the truth."""


def run(
    estimator: Estimator,
    groups: Sequence[str],
    recordings: Path | None,
    data: Path,
    show: Show,
    *,
    quick: bool = False,
    pool: Pool = HERE,
    at_once: int = 1,
) -> dict[str, Any]:
    """Evaluate a model.

    Args:
        estimator: runs the model, with or without its refinement.
        groups: names of sets.GROUPS, or sets.REAL.
        recordings: folder of real recordings and trajectories, or None.
        data: folder for the simulated events.
        show: receives the progress.
        quick: see `sets.items`.
        pool: where the simulations run; the model runs in this process.
        at_once: recordings of a batch, see `estimate_recordings`.

    Returns:
        `rows` as of `goals.row`; `coverage` and `uncertain_share` by set, None for a model without uncertainty; and
        `recordings`, the figures of each simulated recording.

    Raises:
        InvalidField: a set is unknown, or the folder cannot be written.
    """
    items = sets.items(groups, recordings, quick=quick)
    if pool is not HERE:
        for done, name in enumerate(fill(items, data, pool), 1):
            show("simulated ahead", done, len(items), name)
    found: Found = {}
    recordings_of = []
    for done, item in enumerate(items, 1):
        show("simulated", done, len(items), f"{item.group}: {item.name}")
        recordings_of.append(kept(item, data))
        if len(recordings_of) < at_once and done < len(items):
            continue
        estimates = estimate_recordings(estimator, recordings_of, inertial=True, at_once=at_once)
        for own, recording, one in zip(items[done - len(recordings_of) : done], recordings_of, estimates, strict=True):
            truth = recording.twists()
            assert truth is not None  # a simulation with an end has its truth
            found.setdefault(own.group, []).append((own.name, evaluate(one, truth)))
        recordings_of = []
    rows = simulated_rows(found, groups)
    if sets.REAL in groups:
        rows += _real_rows(estimator, recordings)
    unsure = {group: reliability([one for _, one in own]) for group, own in found.items()}
    return {
        "rows": rows,
        "coverage": {
            group: one and {axis: one["per_axis"][axis]["coverage"] for axis in AXES} for group, one in unsure.items()
        },
        "uncertain_share": {group: one and one["uncertain_share"] for group, one in unsure.items()},
        "recordings": {f"{group}: {name}": _figures(group, [one]) for group, own in found.items() for name, one in own},
    }


def simulated_rows(found: Found, groups: Sequence[str]) -> list[dict[str, Any]]:
    """The rows of the simulated sets.

    Args:
        found: estimates and truth.
        groups: the sets that were asked for; one without recordings is skipped with the reason.
    """
    cost = [row(goals.COST, [_cost_ms(found)])] if found else []
    return [*_pooled_rows(found, groups), *_constant_rows(found), *cost]


def _figures(group: str, own: list[Evaluation]) -> dict[str, float | None]:
    """The figures that some goal names, over some recordings together."""
    truth, estimate = (np.concatenate(parts) for parts in zip(*((one.truth, one.estimate) for one in own), strict=True))
    made = figures(truth, estimate, own[0].estimates.twists.shape[1])
    slow = relative_error((estimate - truth)[:, :3], truth[:, :3], SLOW_FLOOR_M_S)
    return {
        "v_l RE": slow if group == "slow" else made["re_v_l"],
        "v_l RMSE [m/s]": made["rmse_v_l_m_s"],
        "v_a RE": made["re_v_a"],
        "v_a RMSE [deg/s]": made["rmse_v_a_deg_s"],
        "pitch rate, correlation": made["per_axis"]["wx"]["correlation"],
        "yaw rate, correlation": made["per_axis"]["wy"]["correlation"],
        "roll rate, correlation": made["per_axis"]["wz"]["correlation"],
    }


def _pooled_rows(found: Found, groups: Sequence[str]) -> list[dict[str, Any]]:
    rows = []
    for goal in goals.GOALS:
        if goal.group not in groups:
            continue
        if goal.group not in found:
            rows.append(row(goal, None, "its files are missing: --recordings DIR"))
            continue
        value = _figures(goal.group, [one for _, one in found[goal.group]])[goal.what]
        rows.append(row(goal, None, "the truth is too small") if value is None else row(goal, [value]))
    return rows


def _constant_rows(found: Found) -> list[dict[str, Any]]:
    """Constant speeds and turning in place."""
    rows = []
    forward = {name: _medians(one) for name, one in found.get("forward", [])}
    for goal, height in zip(
        goals.forward_goals(sets.FORWARD_HEIGHTS_M, sets.SPEEDS_M_S), sets.FORWARD_HEIGHTS_M, strict=True
    ):
        names = [f"{speed:g} m/s at {height:g} m" for speed in sets.SPEEDS_M_S]
        if all(name in forward for name in names):
            rows.append(row(goal, [float(forward[name][2]) for name in names]))
    flags = [one.uncertain for _, one in found.get("forward", []) if one.uncertain is not None]
    if flags:
        rows.append(row(goals.UNCERTAIN, [float(np.concatenate(flags).mean())]))
    turning = [one for _, one in found.get("turning", [])]
    if turning:
        speeds = [float(np.median(np.linalg.norm(one.estimate[:, :3], axis=1))) for one in turning]
        off = [abs(float(_medians(one)[4] / one.truth[0, 4]) - 1) for one in turning]
        rows += [row(goals.PHANTOM_SPEED, [max(speeds)]), row(goals.RATE, [max(off)])]
    return rows


def _medians(one: Evaluation) -> NDArray[np.float64]:
    return np.median(one.estimate, axis=0)


def _cost_ms(found: Found) -> float:
    return float(np.median(np.concatenate([one.estimates.latency_ms for own in found.values() for _, one in own])))


def _real_rows(estimator: Estimator, recordings: Path | None) -> list[dict[str, Any]]:
    """What the checks of `reproduce real` measure, against the goals of this table."""
    asked: dict[tuple[str, str], Goal] = goals.REAL_GOALS
    stationary = (goals.STATIONARY_SPEED, goals.STATIONARY_RATE)
    if recordings is None:
        return [row(goal, None, "--recordings DIR is not given") for goal in (*asked.values(), *stationary)]
    checks = {(one["recording"], one["what"]): one for one in real.run(estimator, recordings)}
    rows = []
    for key, goal in asked.items():
        value, skipped = checks[key]["value"], checks[key]["skipped"]
        rows.append(row(goal, None if value is None else [value], skipped))
    still = [one for one in checks.values() if one["what"] in real.STATIONARY_CHECKS]
    skipped = next((one["skipped"] for one in still if one["skipped"]), None)
    if skipped:
        return [*rows, *(row(goal, None, skipped) for goal in stationary)]
    speeds = [one["made_of"].get("speed at 1 m [m/s]", one["value"]) for one in still]
    rates = [one["made_of"].get("turning [rad/s]", one["value"]) for one in still]
    return [*rows, *(row(goal, [max(values)]) for goal, values in zip(stationary, (speeds, rates), strict=True))]


def markdown(results: dict[str, Any]) -> str:
    """The rows and the coverage as tables in Markdown."""
    lines = [
        f"Accuracy by kind of motion, {real.title(results)}",
        "",
        "| set | figure | must | goal | found | reached |",
        "| --- | --- | --- | --- | --- | --- |",
    ]
    for one in results["rows"]:
        found = f"skipped: {one['skipped']}" if one["found"] is None else ", ".join(f"{v:.3g}" for v in one["found"])
        cells = (one["group"], one["what"], one["must"], one["goal"], found, one["reached"] or "")
        lines.append(f"| {' | '.join(cells)} |")
    lines += [
        "",
        f"Share of the truth within the 90 % intervals; asked: {goals.COVERAGE[0]:g} to {goals.COVERAGE[1]:g}",
        "",
    ]
    lines += [f"| set | {' | '.join(AXES)} | uncertain |", f"| --- |{' --- |' * 7}"]
    for group, coverage in results["coverage"].items():
        shares = [] if coverage is None else [*coverage.values(), results["uncertain_share"][group]]
        lines.append(f"| {' | '.join([group, *(f'{share:.2f}' for share in shares)])} |")
    return "\n".join([*lines, "", *(f"- {group}: {sets.GROUPS[group]}" for group in results["coverage"])]) + "\n"


def save(results: dict[str, Any], out: Path) -> list[Path]:
    """Write motion.json and motion.md into a folder and return their paths.

    Raises:
        InvalidField: a file cannot be written.
    """
    text = json.dumps(results, indent=1) + "\n"
    return [save_text(text, out / "motion.json"), save_text(markdown(results), out / "motion.md")]
