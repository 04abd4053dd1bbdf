"""Plot of a recording: its events on the sensor, their rate over time, and the ground truth of the motion."""

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from neurove_core.figures import blank_figure, write_figure
from neurove_core.io.summary import SLICE_US, Survey
from neurove_protocol.errors import InvalidField

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_SUFFIXES = (".png", ".svg")
_MOST_POINTS = 4000  # of a curve: a reader cannot see more


def draw(survey: Survey, file: Path) -> None:
    """Draw a survey. The file is written atomically.

    Args:
        survey: result of `neurove_core.io.summary.survey`.
        file: PNG or SVG file; its suffix selects the format.

    Raises:
        InvalidField: the file has another suffix or cannot be written. MissingExtra: matplotlib is not installed.
    """
    if file.suffix.lower() not in _SUFFIXES:
        raise InvalidField("info", "plot", str(file), f"the suffix must be {' or '.join(_SUFFIXES)}")
    figure = _figure(survey)
    try:
        write_figure(figure, file)
    except OSError as error:
        raise InvalidField("info", "plot", str(file), error.strerror or str(error)) from None


def _figure(survey: Survey) -> "Figure":
    rows = 1 if survey.twists is None else 3
    figure = blank_figure(11.0, 4.6 if rows == 1 else 6.4)
    grid = figure.add_gridspec(rows, 2, width_ratios=(1.0, 1.3))
    _draw_events(figure.add_subplot(grid[:, 0]), survey)
    start_us = int(survey.rate_t_us[0])
    rate = figure.add_subplot(grid[0, 1])
    rate.stairs(survey.rate_hz / 1e3, (survey.rate_t_us - start_us) / 1e6, fill=True, color="0.4")
    rate.set_ylabel("kev/s")
    if survey.twists is not None and survey.twists.t.size:
        start_us = start_us if survey.summary.events else int(survey.twists.t[0])
        rate.sharex(linear := figure.add_subplot(grid[1, 1]))
        angular = figure.add_subplot(grid[2, 1], sharex=linear)
        stride = -(-survey.twists.t.size // _MOST_POINTS)
        t_s = (survey.twists.t[::stride] - start_us) / 1e6
        for axis, first, unit in ((linear, 0, "m/s"), (angular, 3, "rad/s")):
            for k, colour in enumerate(("C3", "C2", "C0")):
                name = f"{'v' if first == 0 else 'w'}{'xyz'[k]}"
                axis.plot(t_s, survey.twists.twist[::stride, first + k], color=colour, linewidth=0.9, label=name)
            axis.set_ylabel(unit)
            axis.legend(loc="upper right", fontsize="small", ncols=3, frameon=False)
    figure.axes[-1].set_xlabel("s since the first event")
    return figure


def _draw_events(axis: Any, survey: Survey) -> None:
    """Draw ON in red and OFF in blue. The 1% of the pixels with the most events are the brightest."""
    summary = survey.summary
    axis.imshow(_image(survey.counts), interpolation="nearest")
    axis.set_title(f"{summary.name}: {summary.events:,} events, {summary.duration_s:.3f} s", fontsize="medium")
    at_s = (survey.counts_start_us - (summary.first_us or 0)) / 1e6
    axis.set_xlabel(f"{SLICE_US // 1000} ms from {at_s:.3f} s; ON red, OFF blue")


def _image(counts: NDArray[np.int64]) -> NDArray[np.float64]:
    """RGB image (H, W, 3) of counts (2, H, W)."""
    active = counts.sum(axis=0)
    full = float(np.percentile(active[active > 0], 99)) if active.any() else 1.0
    off, on = np.sqrt(np.minimum(counts / max(full, 1.0), 1.0))
    return np.stack([on, 0.35 * (on + off).clip(0, 1), off], axis=-1)
