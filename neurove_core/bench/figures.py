"""The table of speed figures: what is wanted on a processor with AVX2, and what one run measured."""

from collections.abc import Sequence
from typing import Final, Literal, NamedTuple

from neurove_core.bench import Row

BENCHMARKS: Final = ("ingest", "window", "served", "end-to-end", "train", "wire", "streams")
"""The benchmarks that the table needs."""


class Figure(NamedTuple):
    """One line of the table."""

    what: str
    row: str  # `name` of a row of a benchmark
    peers: tuple[str, ...]  # `peer` of that row; the first that was measured
    must: float
    goal: float
    kind: Literal["ratio", "share", "cost"] = "ratio"  # cost: our time over the peer's, less is better


_SPIKINGJELLY: Final = ("spikingjelly", "PyTorch, plain")  # both take about as long
_COUNTED: Final = ("dv-processing", "numpy")

FIGURES: Final = (
    Figure("window, reference, float32", "window reference, T=8", _SPIKINGJELLY, 3, 4),
    Figure("window, shipped, as served", "window shipped, as served", _SPIKINGJELLY, 5, 8),
    Figure("int8 over own float32, reference", "window reference, as served, int8", ("ours, float32",), 1.5, 2),
    Figure("int8 over own float32, shipped", "window shipped, as served, int8", ("ours, float32",), 1, 1.2),
    Figure(
        "events to estimate, shipped",
        "events to estimate, 1e+05 events, shipped",
        ("numpy and spikingjelly", "numpy and PyTorch, plain"),
        8,
        10,
    ),
    Figure("events to estimate, shipped", "events to estimate, 1e+05 events, shipped", ("tonic and snnTorch",), 20, 30),
    Figure("ingest, share of bare increments, 1e5", "ingest 1e+05 events, 346x260, n=10", _COUNTED, 0.55, 0.7, "share"),
    Figure("ingest, share of bare increments, 1e6", "ingest 1e+06 events, 346x260, n=10", _COUNTED, 0.55, 0.7, "share"),
    Figure("training step, reference", "training step reference, T=8, batch 4", _SPIKINGJELLY, 1.6, 2.5),
    Figure("training step, shipped", "training step shipped, T=16, batch 4", _SPIKINGJELLY, 2, 2.5),
    Figure("wire to window", "wire to window, packets of 10000 events", ("receive and frombuffer",), 1.4, 1.2, "cost"),
    Figure("8 streams per core", "8 streams in turn, shipped, per window", ("one stream",), 0.95, 1),
)


def table(measured: Sequence[Row]) -> str:
    """The figures of one run as a Markdown table; a figure whose benchmark or peer is missing is `not measured`."""
    found = {(row.name, row.peer): row for row in measured}
    lines = ["| what | against | measured | must, AVX2 | goal | reached |", "|---|---|---|---|---|---|"]
    for figure in FIGURES:
        peer = next((peer for peer in figure.peers if (figure.row, peer) in found), None)
        value = None if peer is None else _value(found[figure.row, peer], figure)
        against = "bare increments" if figure.kind == "share" else peer or figure.peers[0]
        wanted = f"{_text(figure.must, figure)} | {_text(figure.goal, figure)}"
        shown = "not measured | " + wanted + " | " if value is None else _judged(value, wanted, figure)
        lines.append(f"| {figure.what} | {against} | {shown} |")
    return "\n".join(lines)


def _value(row: Row, figure: Figure) -> float | None:
    if figure.kind == "share":
        return row.share_of_limit
    return 1 / row.ratio if figure.kind == "cost" else row.ratio


def _judged(value: float, wanted: str, figure: Figure) -> str:
    sign = -1 if figure.kind == "cost" else 1
    reached = [name for name, bound in (("goal", figure.goal), ("must", figure.must)) if sign * value >= sign * bound]
    return f"{_text(value, figure)} | {wanted} | {reached[0] if reached else 'no'}"


def _text(value: float, figure: Figure) -> str:
    if figure.kind == "share":
        return f"{value:.0%}"
    return f"{value:.3g} times the floor" if figure.kind == "cost" else f"{value:.3g}"
