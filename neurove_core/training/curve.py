"""The learning curve: live in TensorBoard, and as a figure at the end of a run."""

import logging
from pathlib import Path
from types import TracebackType
from typing import Any, Final, Self

import numpy as np
from numpy.typing import NDArray

from neurove_core.extras import MissingExtra
from neurove_core.figures import blank_figure, save_figure

TENSORBOARD: Final = "tensorboard"
"""Folder of the scalars, inside the folder of a run."""

FIGURE: Final = "curve"
"""Name of the figure's files without suffix, in the folder of the run."""

log = logging.getLogger(__name__)

_SMOOTH: Final = 10  # number of points in the running mean


class Scalars:
    """Write each point of a curve for TensorBoard. Without TensorBoard, log one warning and write nothing.

    Args:
        folder: of the run.
        after_step: the run continues from this update. TensorBoard hides points after it that an interrupted run wrote.
    """

    def __init__(self, folder: Path, after_step: int = 0) -> None:
        self._writer: Any = None
        try:
            from torch.utils.tensorboard import SummaryWriter
        except ImportError:
            log.warning("TensorBoard curve not written: %s", MissingExtra("tensorboard", "train").message)
            return
        self._writer = SummaryWriter(str(folder / TENSORBOARD), purge_step=after_step + 1)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        if self._writer is not None:
            self._writer.close()

    def add(self, point: dict[str, float]) -> None:
        """Write a point of the curve: all its values at its `step`."""
        if self._writer is None:
            return
        for name, value in point.items():
            if name != "step":
                self._writer.add_scalar(name, value, int(point["step"]))
        self._writer.flush()


def draw_curve(
    curve: list[dict[str, float]], folder: Path, title: str, validation: list[dict[str, float]] | None = None
) -> list[Path]:
    """Write curve.png and curve.svg, with both errors and the learning rate over the updates.

    The errors are those of training, and of each set of `validation`; see `validation.Point`.

    Without matplotlib, log a warning and write nothing.

    Returns:
        the files that were written.

    Raises:
        InvalidField: a file cannot be written.
    """
    try:
        figure = blank_figure(9, 6)
    except MissingExtra as missing:
        log.warning("learning curve not drawn: %s", missing.message)
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
            panel.plot(step, values, linewidth=0.6, alpha=0.5, label="training, mean since the previous point")
            panel.plot(step, smooth(values, _SMOOTH), linewidth=1.5, label=f"training, mean of {_SMOOTH} points")
            _draw_validation(panel, validation or [], name, factor)
            panel.set_yscale("log")
        panel.set_ylabel(label)
        panel.grid(visible=True, which="both", alpha=0.3)
    panels[0].legend(loc="upper right")
    panels[0].set_title(title)
    panels[-1].set_xlabel("updates of the weights")
    return save_figure(figure, folder / FIGURE)


def _draw_validation(panel: Any, validation: list[dict[str, float]], name: str, factor: float) -> None:
    for kept, style in (("recorded", "-"), ("simulated", "--")):
        points = [
            (point["step"], point[f"{kept}_{name}"] * factor) for point in validation if f"{kept}_{name}" in point
        ]
        if points:
            panel.plot(*zip(*points, strict=True), style, linewidth=1, color="black", label=f"validation, {kept}")


def smooth(values: NDArray[np.float64], points: int) -> NDArray[np.float64]:
    """Running mean of each value (N,) and the previous ones, over `points` values; fewer at the beginning.

    >>> smooth(np.array([4.0, 2.0, 0.0, 1.0]), 2).tolist()
    [4.0, 3.0, 1.0, 0.5]
    """
    sums = np.concatenate([[0.0], np.cumsum(values)])
    last = np.arange(1, values.size + 1)
    first = np.maximum(0, last - points)
    means: NDArray[np.float64] = (sums[last] - sums[first]) / (last - first)
    return means
