"""Figures: truth, estimate and error over time for each axis; reliability of the uncertainty."""

from pathlib import Path
from typing import Any

import numpy as np

from neurove_core.evaluation.evaluate import Evaluation
from neurove_core.figures import blank_figure, save_figure
from neurove_core.models.uncertainty import LEVEL, half_width
from neurove_protocol.velocity import AXES

_GAP_S = 0.2  # lines are interrupted where windows are missing for this long


def plot(evaluation: Evaluation, folder: Path) -> list[Path]:
    """Write the figure of a recording as PNG and SVG, named after the recording; return the files.

    Raises:
        MissingExtra: matplotlib is not installed. InvalidField: a file cannot be written.
    """
    figure = blank_figure(14, 10)
    t_s = evaluation.end_us / 1e6
    gaps = np.flatnonzero(np.diff(t_s) > _GAP_S) + 1
    panels = figure.subplots(6, 2, sharex=True, gridspec_kw={"width_ratios": [2, 1]})
    for i, (axis, (velocity, error)) in enumerate(zip(AXES, panels, strict=True)):
        unit = "m/s" if i < 3 else "rad/s"
        for values, label, panel in (
            (evaluation.truth[:, i], "truth", velocity),
            (evaluation.estimate[:, i], "estimate", velocity),
            (evaluation.estimate[:, i] - evaluation.truth[:, i], "error", error),
        ):
            panel.plot(np.insert(t_s, gaps, np.nan), np.insert(values, gaps, np.nan), label=label, linewidth=0.9)
            panel.grid(visible=True, alpha=0.3)
        if evaluation.sigma is not None:
            wide = half_width(LEVEL) * evaluation.sigma[:, i]
            low, high = evaluation.estimate[:, i] - wide, evaluation.estimate[:, i] + wide
            band = (np.insert(t_s, gaps, np.nan), np.insert(low, gaps, np.nan), np.insert(high, gaps, np.nan))
            velocity.fill_between(*band, alpha=0.2, color="C1", linewidth=0, label=f"{LEVEL:.0%} interval")
        velocity.set_ylabel(f"{axis} [{unit}]")
        error.axhline(0, color="black", linewidth=0.5)
    panels[0, 0].legend(loc="upper right")
    panels[0, 1].set_title("error")
    panels[0, 0].set_title(evaluation.estimates.name)
    for panel in panels[-1]:
        panel.set_xlabel("sensor time [s]")
    folder.mkdir(parents=True, exist_ok=True)
    stem = "".join(c if c.isalnum() or c in "-_." else "_" for c in evaluation.estimates.name)
    return save_figure(figure, folder / stem)


def plot_reliability(reliability: dict[str, Any], folder: Path) -> list[Path]:
    """Write `reliability.png` and `.svg`, measured over nominal coverage of each axis; return the files.

    Args:
        reliability: as `evaluate.reliability` returns it for all recordings.
        folder: for the files.

    Raises:
        MissingExtra: matplotlib is not installed. InvalidField: a file cannot be written.
    """
    figure = blank_figure(6, 6)
    panel = figure.subplots()
    panel.plot([0, 1], [0, 1], color="black", linewidth=0.8, label="as claimed")
    for axis, measured in reliability["coverage"].items():
        nominal = [float(level) for level in measured]
        panel.plot(nominal, list(measured.values()), marker="o", markersize=4, linewidth=1, label=axis)
    panel.set(xlim=(0.4, 1.01), ylim=(0.4, 1.01), xlabel="nominal coverage", ylabel="measured coverage", aspect="equal")
    panel.grid(visible=True, alpha=0.3)
    panel.legend(loc="lower right")
    folder.mkdir(parents=True, exist_ok=True)
    return save_figure(figure, folder / "reliability")
