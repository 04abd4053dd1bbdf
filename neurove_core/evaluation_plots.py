"""Truth and estimate over time, axis by axis, with the error below."""

from pathlib import Path

import numpy as np

from neurove_core.evaluation import Judged
from neurove_core.figures import blank_figure, save_figure
from protocol.velocity import AXES

_GAP_S = 0.2  # lines are broken where windows are missing for so long


def plot(judged: Judged, folder: Path) -> list[Path]:
    """Write a recording's figure as PNG and SVG, named after it; returns the files.

    Raises:
        MissingExtra: matplotlib is not installed. InvalidField: a file can not be written.
    """
    figure = blank_figure(14, 10)
    t_s = judged.end_us / 1e6
    holes = np.flatnonzero(np.diff(t_s) > _GAP_S) + 1
    panels = figure.subplots(6, 2, sharex=True, gridspec_kw={"width_ratios": [2, 1]})
    for i, (axis, (beside, error)) in enumerate(zip(AXES, panels, strict=True)):
        unit = "m/s" if i < 3 else "rad/s"
        for values, label, panel in (
            (judged.truth[:, i], "truth", beside),
            (judged.answer[:, i], "estimate", beside),
            (judged.answer[:, i] - judged.truth[:, i], "error", error),
        ):
            panel.plot(np.insert(t_s, holes, np.nan), np.insert(values, holes, np.nan), label=label, linewidth=0.9)
            panel.grid(visible=True, alpha=0.3)
        beside.set_ylabel(f"{axis} [{unit}]")
        error.axhline(0, color="black", linewidth=0.5)
    panels[0, 0].legend(loc="upper right")
    panels[0, 1].set_title("error")
    panels[0, 0].set_title(judged.answers.name)
    for panel in panels[-1]:
        panel.set_xlabel("sensor time [s]")
    folder.mkdir(parents=True, exist_ok=True)
    stem = "".join(c if c.isalnum() or c in "-_." else "_" for c in judged.answers.name)
    return save_figure(figure, folder / stem)
