"""The plots of the velocity experiment: truth and estimate over time, errors by method, learning curves."""

import statistics
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from neurove_core.experiments.velocity.report import methods_of, over_seeds
from neurove_core.experiments.velocity.tracks import Track
from neurove_core.figures import blank_figure, save_figure

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_SHOWN: Final = ((2, "vz [m/s]"), (4, "wy [rad/s]"))
_GROUPS: Final = ("mvsec", "driving", "hand-held")


def save(results: dict[str, Any], tracks: dict[str, list[Track]], out: Path) -> list[Path]:
    """Write all plots as PNG and SVG, and return their paths.

    Args:
        results: of the experiment.
        tracks: of the first seed, by method.
        out: folder, created if missing.

    Raises:
        MissingExtra: matplotlib is not installed. InvalidField: a file cannot be written.
    """
    out.mkdir(parents=True, exist_ok=True)
    stem = "velocity-quick" if results["quick"] else "velocity"
    drawn = {"tracks": draw_tracks(tracks), "errors": draw_errors(results), "curves": draw_curves(results)}
    return [file for name, figure in drawn.items() for file in save_figure(figure, out / f"{stem}-{name}")]


def draw_tracks(tracks: dict[str, list[Track]]) -> "Figure":
    """Plot truth and estimates of each method on the first scenario of some groups."""
    some = next(iter(tracks.values()))
    firsts = [next((n for n, one in enumerate(some) if one.group == group), None) for group in _GROUPS]
    chosen = [number for number in firsts if number is not None]
    figure = blank_figure(12, 2.6 * len(chosen) * len(_SHOWN) / 2 + 1)
    panels = figure.subplots(len(chosen), len(_SHOWN), squeeze=False)
    for row, number in zip(panels, chosen, strict=True):
        for panel, (axis, label) in zip(row, _SHOWN, strict=True):
            panel.plot(some[number].t_s, some[number].truth[:, axis], color="black", linewidth=1.4, label="truth")
            for method, own in tracks.items():
                panel.plot(own[number].t_s, own[number].estimate[:, axis], linewidth=0.8, label=method)
            panel.set_ylabel(label)
            panel.set_title(f"{some[number].group}: {some[number].name}", fontsize=9)
            panel.grid(visible=True, alpha=0.3)
    for panel in panels[-1]:
        panel.set_xlabel("time [s]")
    panels[0, 0].legend(fontsize=7)
    return figure


def draw_errors(results: dict[str, Any]) -> "Figure":
    """Plot the RMSE of each method on each group, with the spread between seeds."""
    methods, groups = methods_of(results), list(results["groups"])
    figure = blank_figure(12, 6)
    panels = figure.subplots(2, 1, sharex=True)
    wide = 0.8 / len(methods)
    for panel, (name, label) in zip(
        panels, (("rmse_v_l_m_s", "v_l RMSE [m/s]"), ("rmse_v_a_deg_s", "v_a RMSE [deg/s]")), strict=True
    ):
        for number, method in enumerate(methods):
            found = [over_seeds(results, method, group, name) for group in groups]
            at = [place + number * wide for place, values in enumerate(found) if values]
            means = [statistics.mean(values) for values in found if values]
            spreads = [statistics.stdev(values) if len(values) > 1 else 0.0 for values in found if values]
            panel.bar(at, means, wide, yerr=spreads, label=method, color=f"C{number}", capsize=2)
        panel.set_ylabel(label)
        panel.set_yscale("log")
        panel.grid(visible=True, axis="y", alpha=0.3)
    panels[1].set_xticks([place + 0.4 - wide / 2 for place in range(len(groups))], groups)
    panels[1].legend(fontsize=8, ncols=len(methods), loc="upper center", bbox_to_anchor=(0.5, -0.12))
    return figure


def draw_curves(results: dict[str, Any]) -> "Figure":
    """Plot the mean error of the training batches over the updates, one line per seed."""
    figure = blank_figure(12, 4)
    panels = figure.subplots(1, 2)
    methods = list(dict.fromkeys(run["method"] for run in results["runs"]))
    for panel, (name, label) in zip(
        panels,
        (("linear_error_m_s", "linear error [m/s]"), ("angular_error_rad_s", "angular error [rad/s]")),
        strict=True,
    ):
        for number, method in enumerate(methods):
            runs = [run for run in results["runs"] if run["method"] == method]
            for first, run in enumerate(runs):
                steps, values = ([point[key] for point in run["curve"]] for key in ("step", name))
                panel.plot(steps, values, color=f"C{number}", linewidth=1, label=None if first else method)
        panel.set_yscale("log")
        panel.set_xlabel("updates")
        panel.set_ylabel(label)
        panel.grid(visible=True, which="both", alpha=0.3)
    panels[0].legend(fontsize=8)
    return figure
