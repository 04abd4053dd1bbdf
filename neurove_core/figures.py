"""Figures without a screen: an empty one to draw into, and its files."""

from pathlib import Path
from typing import TYPE_CHECKING

from neurove_core.extras import MissingExtra
from protocol.errors import InvalidField

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def blank_figure(width_in: float, height_in: float) -> "Figure":
    """An empty figure of this size [inch], drawn without a screen.

    Raises:
        MissingExtra: matplotlib is not installed.
    """
    try:
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure
    except ImportError:
        raise MissingExtra("matplotlib") from None
    figure = Figure(figsize=(width_in, height_in), layout="constrained")
    FigureCanvasAgg(figure)
    return figure


def save_figure(figure: "Figure", stem: Path) -> list[Path]:
    """Write `stem`.png and `stem`.svg, the same bytes for the same figure; returns both paths.

    Raises:
        InvalidField: a file cannot be written.
    """
    import matplotlib as mpl

    files = [stem.with_suffix(".png"), stem.with_suffix(".svg")]
    with mpl.rc_context({"svg.hashsalt": stem.name}):  # else the SVG's ids are random
        for file in files:
            try:
                figure.savefig(file, dpi=150, metadata={"Date": None} if file.suffix == ".svg" else None)
            except OSError as error:
                raise unwritable(file, error) from None
    return files


def unwritable(file: Path, error: OSError) -> InvalidField:
    """The error to raise where a result cannot be written."""
    return InvalidField("reproduce", "out", str(file), error.strerror or str(error))
