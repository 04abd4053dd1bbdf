"""The tables of the velocity experiment, from its results: the stand-ins of Tables III and IV, and further tables."""

import json
import statistics
from pathlib import Path
from typing import Any, Final

from neurove_core.evaluation.metrics import ANGULAR_FLOOR_RAD_S, LINEAR_FLOOR_M_S, SKIP_S
from neurove_core.experiments import save_text
from neurove_core.experiments.velocity.held_out import GROUPS
from neurove_core.experiments.velocity.tracks import MIN_RATE_DEG_S

PaperFigures = dict[str, tuple[float, float, float, float]]

PAPER_TABLE_3: Final[PaperFigures] = {
    "snn-ang": (0.91, 1.63, 0.7, 0.45),
    "nve-wo": (0.64, 0.89, 0.3, 0.22),
    "nve": (0.11, 0.15, 0.12, 0.10),
}
PAPER_TABLE_4: Final[dict[str, PaperFigures]] = {
    "town 1": {
        "snn-ang": (5.77, 1.84, 0.75, 0.91),
        "nve-wo": (5.37, 1.02, 0.30, 0.34),
        "nve": (3.56, 0.73, 0.28, 0.32),
    },
    "town 2": {
        "snn-ang": (4.41, 1.92, 0.99, 0.92),
        "nve-wo": (3.82, 1.14, 0.38, 0.38),
        "nve": (3.37, 1.01, 0.35, 0.31),
    },
}
"""As printed: RMSE* of v_a (deg/s, according to the paper times 100), RE of v_a, RMSE* of v_l [m/s], RE of v_l."""

SIMULATED: Final = (
    "The events are simulated, ours and not the paper's: its figures stand beside ours and are not of the same data."
)

_NAMES: Final = {
    "shipped": "NeuroVE as shipped",
    "nve": "NeuroVE",
    "nve-wo": "NeuroVE w/o",
    "ann": "equal-size ANN",
    "snn-ang": "SNN-ANG",
    "contrast maximisation": "contrast maximisation",
    "mean": "the mean of this truth",
    "zero": "zero",
}
_LEARNED: Final = ("nve", "nve-wo", "ann", "snn-ang")
_COLUMNS: Final = ("rmse_v_a_deg_s", "re_v_a", "rmse_v_l_m_s", "re_v_l")

Results = dict[str, Any]


def markdown(results: Results) -> str:
    """All tables of some results in Markdown."""
    drives, seeds = results["drives"], sorted({run["seed"] for run in results["runs"]})
    updates, recipe = results["runs"][0]["updates"], results["config"]["recipe"]
    parts = [
        f"{updates} updates of {recipe['batch']} x {recipe['chunk_windows']} windows each, on "
        f"{results['config']['data']['sequences']} simulated sequences of {results['config']['data']['seconds']:g} s"
        f"{f' and {drives} along real drives of MVSEC' if drives else ''}; "
        f"{_plural(len(seeds), 'seed')}{', mean ± spread between seeds' if len(seeds) > 1 else ''}. "
        f"RE counts |v| > {LINEAR_FLOOR_M_S:g} m/s and |w| > {ANGULAR_FLOOR_RAD_S:g} rad/s; without these floors it is "
        f"in brackets. The first {SKIP_S:g} s are left out.",
    ]
    if results["shipped"]:
        made = f"`{results['shipped']['program']}`, {results['shipped']['updates']} updates"
        parts.append(f"NeuroVE as shipped is the default model ({made}): one seed, none of MVSEC's ways.")
    if results["quick"]:
        parts.append("A quick run: it shows that everything works, and its figures mean nothing.")
    parts += [
        _table_3(results),
        _table_4(results),
        _by_group(results),
        _ratios(results),
        _gehrig(results),
        _sizes(results),
    ]
    return "\n\n".join(parts) + "\n"


def save(results: Results, out: Path) -> list[Path]:
    """Write velocity.json and velocity.md into a folder and return their paths.

    Raises:
        InvalidField: a file cannot be written.
    """
    stem = "velocity-quick" if results["quick"] else "velocity"
    text = json.dumps(results, indent=1) + "\n"
    return [save_text(text, out / f"{stem}.json"), save_text(markdown(results), out / f"{stem}.md")]


def methods_of(results: Results) -> list[str]:
    """The learned methods in the order of the tables, then the predictors that are not learned."""
    learned = {run["method"] for run in results["runs"]} | ({"shipped"} if results["shipped"] else set())
    return [name for name in _NAMES if name in learned or name in results["blind"]]


def over_seeds(results: Results, method: str, group: str, figure: str) -> list[float]:
    """A figure of a method on a group, one value per seed; empty if there is none."""
    rows = [run["groups"] for run in results["runs"] if run["method"] == method]
    rows += [results["blind"][method]] if method in results["blind"] else []
    rows += [results["shipped"]["groups"]] if method == "shipped" and results["shipped"] else []
    found = [row[group][figure] for row in rows if group in row]
    return [value for value in found if value is not None]


def _cell(results: Results, method: str, group: str, figure: str, digits: str = ".3g") -> str:
    values = over_seeds(results, method, group, figure)
    if not values:
        return "-"
    spread = f" ± {statistics.stdev(values):.1g}" if len(values) > 1 else ""
    return f"{statistics.mean(values):{digits}}{spread}"


def _table(columns: list[str], rows: list[list[str]]) -> str:
    lines = [columns, ["---"] * len(columns), *rows]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def _paper_rows(results: Results, group: str, paper: PaperFigures) -> list[list[str]]:
    """Rows of a table of the paper: the method, our four figures with the unfloored RE, and the paper's four."""
    rows = []
    for method in methods_of(results):
        cells = [_cell(results, method, group, figure) for figure in _COLUMNS]
        for place, figure in ((1, "re_v_a_unfloored"), (3, "re_v_l_unfloored")):
            if cells[place] != "-":
                cells[place] += f" ({_cell(results, method, group, figure, '.2g')})"
        theirs = " / ".join(f"{value:g}" for value in paper[method]) if method in paper else "-"
        rows.append([_NAMES[method], *cells, theirs])
    return rows


_PAPER_COLUMNS: Final = [
    "",
    "v_a RMSE [deg/s]",
    "v_a RE",
    "v_l RMSE [m/s]",
    "v_l RE",
    "the paper: RMSE* v_a / RE / RMSE* v_l / RE",
]


def _table_3(results: Results) -> str:
    title = "**Table III's stand-in**: MVSEC's outdoor_day1, the part that is not learned from."
    if "mvsec" not in results["groups"]:
        return f"{title} Left out: {results['no_mvsec']}."
    how = (
        "Its real way drives the simulator with the DAVIS346's equidistant lens; learned from are day 2 and the first "
        f"part of day 1. {SIMULATED}"
    )
    return f"{title} {how}\n\n{_table(_PAPER_COLUMNS, _paper_rows(results, 'mvsec', PAPER_TABLE_3))}"


def _table_4(results: Results) -> str:
    parts = [f"**Table IV's stand-in**: two unseen simulated towns. {SIMULATED}"]
    parts += [
        f"{GROUPS[town]}:\n\n{_table(_PAPER_COLUMNS, _paper_rows(results, town, paper))}"
        for town, paper in PAPER_TABLE_4.items()
    ]
    return "\n\n".join(parts)


def _by_group(results: Results) -> str:
    methods = methods_of(results)
    groups = [group for group in GROUPS if group in results["groups"]]
    parts = []
    for title, (error, unit), ratio in (
        ("Linear velocity", ("rmse_v_l_m_s", "m/s"), "re_v_l"),
        ("Angular velocity", ("rmse_v_a_deg_s", "deg/s"), "re_v_a"),
    ):
        rows = []
        for group in groups:
            windows, items = results["groups"][group]["windows"], results["groups"][group]["items"]
            cells = [
                f"{_cell(results, method, group, ratio, '.2f')} / {_cell(results, method, group, error)}"
                for method in methods
            ]
            about = f"{group}: {GROUPS[group]} ({_plural(items, 'recording')}, {windows} windows)"
            rows.append([about, *(cell.replace("- / -", "-") for cell in cells)])
        heading = f"**{title}**, RE / RMSE [{unit}]"
        parts.append(f"{heading}\n\n{_table(['', *(_NAMES[method] for method in methods)], rows)}")
    note = (
        "Contrast maximisation takes it that the camera only turns, and is asked at a few instants of each recording; "
        "the mean is that of the judged truth itself."
    )
    return "\n\n".join([*parts, note])


def _ratios(results: Results) -> str:
    """Ratios of NeuroVE to each learned baseline on unseen drives, seed by seed."""
    rows = []
    for method in _LEARNED[1:]:
        cells = []
        for figure in ("re_v_l", "rmse_v_l_m_s", "re_v_a", "rmse_v_a_deg_s"):
            ours, theirs = (over_seeds(results, one, "driving", figure) for one in ("nve", method))
            ratios = [a / b for a, b in zip(ours, theirs, strict=False) if b]
            spread = f" ± {statistics.stdev(ratios):.1g}" if len(ratios) > 1 else ""
            cells.append(f"{statistics.mean(ratios):.2f}{spread}" if ratios else "-")
        if any(cell != "-" for cell in cells):
            rows.append([_NAMES[method], *cells])
    if not rows:
        return "**NeuroVE over its baselines**: it needs NeuroVE and another method."
    columns = ["", "v_l RE", "v_l RMSE", "v_a RE", "v_a RMSE"]
    return f"**NeuroVE over its baselines**, driving; below 1 NeuroVE is better\n\n{_table(columns, rows)}"


def _gehrig(results: Results) -> str:
    """The two figures of Gehrig 2020, whose `RMSE` is not a root mean square."""
    groups = [group for group in ("driving", "hand-held", "mvsec") if group in results["groups"]]
    rows = []
    for method in methods_of(results):
        ratios = [_cell(results, method, group, "gehrig_median_re", ".2f") for group in groups]
        errors = [_cell(results, method, group, "gehrig_mean_error_deg_s") for group in groups]
        rows.append([_NAMES[method], *(f"{a} / {b}" for a, b in zip(ratios, errors, strict=True))])
    what = (
        "**As Gehrig 2020 counts angular velocity**: median RE of truths above "
        f"{MIN_RATE_DEG_S:g} deg/s / mean length of the error [deg/s], which that paper calls RMSE"
    )
    return f"{what}\n\n{_table(['', *groups], rows)}"


def _sizes(results: Results) -> str:
    rows = []
    for method in _LEARNED:
        runs = [run for run in results["runs"] if run["method"] == method]
        if runs:
            rate = runs[0]["firing_rate"]
            cost = statistics.mean(run["cost"] for run in runs) if all(run["cost"] for run in runs) else None
            cells = [f"{runs[0]['parameters']:,}", "-" if rate is None else f"{100 * rate:.1f} %"]
            rows.append([_NAMES[method], *cells, "-" if cost is None else f"{cost:.2f}"])
    columns = ["", "parameters", "neurons that fire per step", "CPU time of an update over NeuroVE's"]
    return f"**What they are**\n\n{_table(columns, rows)}"


def _plural(count: int, what: str) -> str:
    return f"{count} {what}{'' if count == 1 else 's'}"
