"""A bar chart of benchmark rows: the speed relative to each peer."""

from collections.abc import Sequence
from pathlib import Path

from neurove_core.bench import Row
from neurove_core.figures import blank_figure, save_figure


def save(rows: Sequence[Row], stamp: str, file: Path) -> list[Path]:
    """Write one bar per row on a logarithmic axis, as PNG and SVG, and return both paths.

    Raises:
        MissingExtra: matplotlib is not installed.
        InvalidField: a file cannot be written.
    """
    figure = blank_figure(10, 1.5 + 0.32 * len(rows))
    axes = figure.add_subplot()
    labels = [f"{row.name}\nagainst {row.peer}" for row in rows]
    bars = axes.barh(range(len(rows)), [row.ratio for row in rows], color="#4477aa")
    axes.bar_label(bars, [f" {row.ratio:.2f}" for row in rows], fontsize=7)
    axes.set_yticks(range(len(rows)), labels, fontsize=6)
    axes.invert_yaxis()
    axes.set_xscale("log")
    axes.axvline(1, color="black", linewidth=0.8)
    axes.set_xlabel("times as fast, medians of CPU time of one thread, interleaved in one run")
    figure.suptitle(stamp, fontsize=6)
    return save_figure(figure, file.with_suffix(""))
