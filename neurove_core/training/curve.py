"""The learning curve, to be looked at: live in TensorBoard, and as a figure at the end."""

import logging
from pathlib import Path
from types import TracebackType
from typing import Any, Final, Self

import numpy as np
from numpy.typing import NDArray

from neurove_core.extras import MissingExtra
from neurove_core.figures import blank_figure, save_figure

TENSORBOARD: Final = "tensorboard"
"""Folder of the scalars, within a run's."""

FIGURE: Final = "curve"
"""Stem of the figure's files, beside the run's account."""

log = logging.getLogger(__name__)

_SMOOTH: Final = 10  # points of the curve in a running mean


class Scalars:
    """Writes each point of a curve for TensorBoard; without that library it says so once, and writes nothing.

    Args:
        folder: of the run.
        after_step: the run goes on from this update: what a run that was stopped wrote after it is not shown.
    """

    def __init__(self, folder: Path, after_step: int = 0) -> None:
        self._writer: Any = None
        try:
            from torch.utils.tensorboard import SummaryWriter
        except ImportError:
            log.warning("no curve for TensorBoard: %s", MissingExtra("tensorboard", "train").message)
            return
        self._writer = SummaryWriter(str(folder / TENSORBOARD), purge_step=after_step + 1)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        if self._writer is not None:
            self._writer.close()

    def add(self, point: dict[str, float]) -> None:
        """A point of the curve: all its values over its `step`."""
        if self._writer is None:
            return
        for name, value in point.items():
            if name != "step":
                self._writer.add_scalar(name, value, int(point["step"]))
        self._writer.flush()


def draw_curve(curve: list[dict[str, float]], folder: Path, title: str) -> list[Path]:
    """Write curve.png and curve.svg: both errors over the updates, and the learning rate; returns the files.

    Without matplotlib it says so, and writes nothing.

    Raises:
        InvalidField: a file can not be written.
    """
    try:
        figure = blank_figure(9, 6)
    except MissingExtra as missing:
        log.warning("no figure of the curve: %s", missing.message)
        return []
    step = np.array([point["step"] for point in curve])
    rows = (
        ("linear_error_m_s", 1.0, "linear error [m/s]"),
        ("angular_error_rad_s", np.rad2deg(1), "angular error [deg/s]"),
        ("learning_rate", 1.0, "learning rate"),
    )
    panels = figure.subplots(3, 1, sharex=True, gridspec_kw={"height_ratios": [3, 3, 1]})
    for panel, (name, factor, label) in zip(panels, rows, strict=True):
        values = np.array([point[name] for point in curve]) * factor
        if panel is panels[-1]:
            panel.plot(step, values, linewidth=1)
        else:
            panel.plot(step, values, linewidth=0.6, alpha=0.5, label="mean since the point before")
            panel.plot(step, smooth(values, _SMOOTH), linewidth=1.5, label=f"mean of {_SMOOTH} points")
            panel.set_yscale("log")
        panel.set_ylabel(label)
        panel.grid(visible=True, which="both", alpha=0.3)
    panels[0].legend(loc="upper right")
    panels[0].set_title(title)
    panels[-1].set_xlabel("updates of the weights")
    return save_figure(figure, folder / FIGURE)


def smooth(values: NDArray[np.float64], points: int) -> NDArray[np.float64]:
    """The mean of each value (N,) and the ones before it, `points` in all; fewer at the beginning.

    >>> smooth(np.array([4.0, 2.0, 0.0, 1.0]), 2).tolist()
    [4.0, 3.0, 1.0, 0.5]
    """
    sums = np.concatenate([[0.0], np.cumsum(values)])
    last = np.arange(1, values.size + 1)
    first = np.maximum(0, last - points)
    means: NDArray[np.float64] = (sums[last] - sums[first]) / (last - first)
    return means
