"""Figures without a display: an empty figure to draw into, and its files."""

from pathlib import Path
from typing import TYPE_CHECKING

from neurove_core.extras import MissingExtra
from neurove_core.files import atomic_path
from neurove_protocol.errors import InvalidField

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def blank_figure(width_in: float, height_in: float) -> "Figure":
    """An empty figure of this size [inch], drawn without a display.

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
    """Write `stem`.png and `stem`.svg, with the same bytes for the same figure, and return both paths.

    Raises:
        InvalidField: a file cannot be written.
    """
    import matplotlib as mpl

    files = [stem.with_suffix(".png"), stem.with_suffix(".svg")]
    with mpl.rc_context({"svg.hashsalt": stem.name}):  # otherwise the SVG's ids are random
        for file in files:
            try:
                write_figure(figure, file)
            except OSError as error:
                raise unwritable(file, error) from None
    return files


def write_figure(figure: "Figure", file: Path, dpi: int = 150) -> None:
    """Write a figure atomically, as SVG for the suffix .svg, otherwise as PNG.

    Raises:
        OSError: the file cannot be written.
    """
    kind = "svg" if file.suffix.lower() == ".svg" else "png"
    with atomic_path(file) as part:
        figure.savefig(part, format=kind, dpi=dpi, metadata={"Date": None} if kind == "svg" else None)


def unwritable(file: Path, error: OSError) -> InvalidField:
    """The error for a result that cannot be written."""
    return InvalidField("reproduce", "out", str(file), error.strerror or str(error))
