"""What a model sees: its estimates where the times of the events are shuffled, reversed or run faster.

Within each window the times are dealt out anew (shuffled), or run backwards (reversed). A model that measures motion by
the order of events within a window then gives nothing, or the opposite. A model that sees more keeps some of it. With a
faster clock the same events hold more motion per window, and the truth is scaled alike; a model that is right at 4x and
wrong at 1x cannot see slow motion, and the look of the events is not the cause.
"""

import json
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from neurove_core import models
from neurove_core.estimator import Estimator
from neurove_core.evaluation.estimates import Estimates, estimate_recording
from neurove_core.evaluation.evaluate import NoTruth
from neurove_core.evaluation.metrics import SKIP_S
from neurove_core.experiments import real, save_text
from neurove_core.figures import blank_figure, save_figure
from neurove_core.geometry.motion import Twists
from neurove_core.io.recording import EventsOnly, in_chunks
from neurove_core.sources import open_source
from neurove_protocol import CameraInfo, Events, Sensor

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Array = NDArray[np.float64]

CLOCKS: Final = (1, 2, 4, 8)
AS_IS, SHUFFLED, REVERSED = "as recorded", "shuffled", "reversed"
CHANGES: Final = (AS_IS, SHUFFLED, REVERSED, *(f"{clock}x" for clock in CLOCKS[1:]))
"""The experiments, in the order of the columns."""

DRIVES: Final = 3  # of heldout.txt, their first seconds
DRIVE_S: Final = 6.0
_CRAWL: Final = "sim://street?seed=5150&seconds=4&height=1&trajectory=slider?vz=0.5"
_QUICK: Final = "sim://street?seed=5001&seconds=2&height=0.55&camera=pinhole:86x65:75"

_LEAST_YAW_RAD_S: Final = 0.05  # a drive that turns less is not compared in yaw
_LEAST_WINDOWS: Final = 2
_LITTLE, _OPPOSITE = 0.25, -0.4
"""A share of the motion below this is little; a share below that is the opposite."""


class Case(NamedTuple):
    """Events with their truth, and the axes to compare."""

    name: str
    events: Events
    camera: CameraInfo
    truth: Twists
    axes: tuple[int, ...]  # of vx vy vz wx wy wz
    slow: bool  # so slow that a faster clock may help


class Sight(NamedTuple):
    """The answer of a model to one experiment."""

    share: float | None  # of the true motion: the slope of the estimate over the truth through the origin
    correlation: float | None  # None if the truth is constant
    windows: int


@dataclass(frozen=True)
class _Changed(EventsOnly):
    """Events of one experiment; see `Recording`."""

    name: str
    events: Events
    lens: CameraInfo

    @property
    def sensor(self) -> Sensor:
        return self.lens.sensor

    @property
    def endless(self) -> bool:
        return False

    def camera(self, stream: str) -> CameraInfo:
        return self.lens.model_copy(update={"stream": stream})

    def chunks(self) -> Iterator[Events]:
        return in_chunks(self.events)


def shuffled(events: Events, window_us: int, seed: int = 0) -> Events:
    """Deal out the times of each window anew, so that the order of its events means nothing.

    >>> found = shuffled(Events.from_columns([1, 2, 3, 50], [1, 2, 3, 4], [0] * 4, [0] * 4), 50)
    >>> found.t.tolist(), sorted(found.x[:3].tolist()), found.x[3].item()
    ([1, 2, 3, 50], [1, 2, 3], 4)
    """
    order = np.lexsort((np.random.default_rng(seed).random(events.n), events.t // window_us))
    return Events(events.t, events.x[order], events.y[order], events.p[order])


def backwards(events: Events, window_us: int) -> Events:
    """Let the time run backwards within each window.

    >>> found = backwards(Events.from_columns([1, 2, 30, 55], [1, 2, 3, 4], [0] * 4, [0] * 4), 50)
    >>> found.t.tolist(), found.x.tolist()
    ([19, 47, 48, 94], [3, 2, 1, 4])
    """
    start = events.t // window_us * window_us
    t = 2 * start + window_us - 1 - events.t
    order = np.argsort(t, kind="stable")
    return Events(t[order], events.x[order], events.y[order], events.p[order])


def faster(events: Events, truth: Twists, clock: int) -> tuple[Events, Twists]:
    """Let the clock run so many times as fast: events, and their truth, which is as many times as large."""
    return events._replace(t=events.t // clock), Twists(truth.t // clock, truth.twist * clock)


def see(estimator: Estimator, case: Case, change: str) -> Sight:
    """Run one experiment.

    Args:
        estimator: runs the model.
        case: events and truth.
        change: one of CHANGES.
    """
    window_us = estimator.config.window.duration_us
    events, truth, clock = case.events, case.truth, 1
    if change == SHUFFLED:
        events = shuffled(events, window_us)
    elif change == REVERSED:
        events = backwards(events, window_us)
    elif change != AS_IS:
        clock = int(change.removesuffix("x"))
        events, truth = faster(events, truth, clock)
    found = estimate_recording(estimator, _Changed(case.name, events, case.camera))
    return _compared(found, truth, case.axes, SKIP_S / clock, (int(events.t[0]), int(events.t[-1])))


def _compared(found: Estimates, truth: Twists, axes: tuple[int, ...], skip_s: float, span_us: tuple[int, int]) -> Sight:
    """Compare the means over complete windows that the truth covers, after the skipped time."""
    bins = found.twists.shape[1]
    middles = (np.arange(4 * bins) + 0.5) * found.bin_us / 4
    t_us = (found.start_us[:, None] + middles).astype(np.int64)
    true = truth.at(t_us.ravel()).reshape(*t_us.shape, 6).mean(axis=1)[:, axes]
    kept = (found.start_us >= span_us[0] + skip_s * 1e6) & (found.start_us + bins * found.bin_us <= span_us[1])
    kept &= np.isfinite(true).all(axis=1)
    if kept.sum() < _LEAST_WINDOWS:
        return Sight(None, None, int(kept.sum()))
    estimate, true = found.twists.mean(axis=1)[kept][:, axes], true[kept]
    share = float((estimate * true).sum() / max(float((true**2).sum()), 1e-12))
    a, b = estimate - estimate.mean(axis=0), true - true.mean(axis=0)
    lengths = math.sqrt(float((a**2).sum() * (b**2).sum()))
    constant = (b**2).sum() < 1e-3 * (true**2).sum() or int(kept.sum()) < 3
    return Sight(share, None if constant else float((a * b).sum()) / max(lengths, 1e-12), int(kept.sum()))


def cases(recordings: Path | None, *, quick: bool = False) -> Iterator[Case]:
    """Held-out drives and a crawling one, and the real recordings of turning cameras where they exist.

    Args:
        recordings: folder of the recordings of `reproduce real`, or None.
        quick: one short drive through a small camera instead of the drives.
    """
    if quick:
        yield from _simulated("drive", _QUICK)
        yield from _simulated("0.5 m/s", f"{_CRAWL}&camera=pinhole:86x65:75", slow=True)
    else:
        heldout = (Path(models.__file__).parent / "heldout.txt").read_text().split()
        for number, url in enumerate(heldout[:DRIVES], 1):
            yield from _simulated(f"drive {number}", url.replace("seconds=24", f"seconds={DRIVE_S:g}"))
        yield from _simulated("0.5 m/s", _CRAWL, slow=True)
    if recordings is not None:
        for one in real.turning_recordings(recordings):
            yield Case(one.name, one.events, one.camera, one.truth, (one.axis,), slow=True)


def _simulated(name: str, url: str, *, slow: bool = False) -> Iterator[Case]:
    recording = open_source(url)
    camera, truth = recording.camera("sight"), recording.twists()
    if camera is None or truth is None:
        raise NoTruth(f"{url}: it has no lens or no truth")
    events = Events.join([Events.empty(), *recording.chunks()])
    yield Case(f"{name}, v", events, camera, truth, (0, 1, 2), slow)
    if np.sqrt((truth.twist[:, 4] ** 2).mean()) > _LEAST_YAW_RAD_S:
        yield Case(f"{name}, yaw", events, camera, truth, (4,), slow)


def run(estimator: Estimator, recordings: Path | None, *, quick: bool = False) -> Iterator[dict[str, Any]]:
    """Run all experiments of a model.

    Yields:
        one row per case: case, slow, and for each of CHANGES the share, correlation and windows of `Sight`.
    """
    for case in cases(recordings, quick=quick):
        yield {"case": case.name, "slow": case.slow} | {
            change: see(estimator, case, change)._asdict() for change in CHANGES
        }


def sentence(rows: Sequence[dict[str, Any]]) -> str:
    """What the model sees, in one sentence."""
    moving = [row for row in rows if (row[AS_IS]["share"] or 0) > 0.3]  # only there can something be lost
    moving = [row for row in moving if not row["slow"]] or moving
    if not moving:
        return "The model sees none of these motions as recorded, so nothing can be said about what it uses."
    kept, turned = (
        float(np.median([row[change]["share"] / row[AS_IS]["share"] for row in moving]))
        for change in (SHUFFLED, REVERSED)
    )
    figures = f"shuffled times leave {kept:.0%} of the motion, reversed times {turned:.0%}"
    if abs(kept) < _LITTLE and turned < _OPPOSITE:
        seen = f"The model sees the order of the events within a window and little else: {figures}"
    elif abs(kept) < _LITTLE:
        seen = f"The model needs the times of the events within a window, and sees more than their order: {figures}"
    elif kept > 1 - _LITTLE and turned > 1 - _LITTLE:
        seen = f"The model does not use the times of the events within a window: {figures}"
    else:
        seen = f"The model uses the times of the events within a window in part: {figures}"
    slow = [row for row in rows if row["slow"] and None not in (row[AS_IS]["share"], row["4x"]["share"])]
    if not slow:
        return f"{seen}."
    errors = [np.median([abs(row[change]["share"] - 1) for row in slow]) for change in (AS_IS, "4x")]
    return (
        f"{seen}; slow motion is off by {errors[0]:.0%}, and by {errors[1]:.0%} with the clock run four times as fast."
    )


def markdown(rows: Sequence[dict[str, Any]], title: str) -> str:
    """The sentence, and a table of the shares of the true motion, with correlations in brackets."""
    lines = [
        f"What {title} sees",
        "",
        sentence(rows),
        "",
        "Share of the true motion (correlation where it varies):",
        "",
    ]
    lines += [f"| | {' | '.join(CHANGES)} |", f"| --- |{' --- |' * len(CHANGES)}"]
    for row in rows:
        lines.append(f"| {row['case']} | {' | '.join(_cell(row[change]) for change in CHANGES)} |")
    return "\n".join(lines) + "\n"


def _cell(found: dict[str, Any]) -> str:
    if found["share"] is None:
        return "-"
    return f"{found['share']:.2f}" + ("" if found["correlation"] is None else f" ({found['correlation']:.2f})")


def draw(rows: Sequence[dict[str, Any]]) -> "Figure":
    """The shares as bars, one group for each experiment.

    Raises:
        MissingExtra: matplotlib is not installed.
    """
    figure = blank_figure(11, 5)
    panel = figure.subplots()
    wide = 0.8 / max(1, len(rows))
    for number, row in enumerate(rows):
        shares = [row[change]["share"] for change in CHANGES]
        at = [place + number * wide for place, share in enumerate(shares) if share is not None]
        panel.bar(at, [share for share in shares if share is not None], wide, label=row["case"])
    for level, style in ((1.0, "--"), (0.0, "-"), (-1.0, ":")):
        panel.axhline(level, color="black", linewidth=0.8, linestyle=style)
    panel.set_xticks([place + 0.4 - wide / 2 for place in range(len(CHANGES))], CHANGES)
    panel.set_ylim(-2, 3)
    panel.set_ylabel("estimated over true motion")
    panel.grid(visible=True, axis="y", alpha=0.3)
    panel.legend(fontsize=7, ncols=2)
    return figure


def save(rows: Sequence[dict[str, Any]], about: dict[str, Any], out: Path) -> list[Path]:
    """Write sight.json, sight.md and the figure into a folder and return their paths.

    Raises:
        MissingExtra: matplotlib is not installed. InvalidField: a file cannot be written.
    """
    text = json.dumps(about | {"sentence": sentence(rows), "cases": rows}, indent=1) + "\n"
    texts = [save_text(text, out / "sight.json"), save_text(markdown(rows, real.title(about)), out / "sight.md")]
    return [*texts, *save_figure(draw(rows), out / "sight")]
