"""Error of the first estimates after a model swap, for several start states of the new model.

The start state is cold (the zero state), carried (the state of the old model), or primed (N windows replayed from the
zero state). N affects only the error of the first estimate after these N windows (decision 29). This experiment is not
in the paper.

The reference is a run of the new model that was never swapped, on streets that the default model has not seen. Errors
against it are given in standard deviations of the estimates of that run, per axis. The old model is the new one with
every weight shifted by 2 %, which is about the difference between two trainings of one model. The errors against the
ground truth are given too, because they are what a robot experiences.
"""

import json
from collections.abc import Callable, Iterable
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from neurove_core import models
from neurove_core.estimator import Estimator
from neurove_core.experiments import save_text
from neurove_core.figures import blank_figure, save_figure
from neurove_core.ingest.windows import Window, WindowsState, push
from neurove_core.models.bundle import Bundle, from_bytes
from neurove_core.sim.simulate import Simulation
from neurove_core.sim.source import simulation_of
from neurove_core.spiking.layers import require
from neurove_core.stream_state import StreamState
from neurove_core.training.data import true_twists
from neurove_protocol import Sensor

if TYPE_CHECKING:
    from matplotlib.figure import Figure

PRIMED = (8, 16, 32, 64)
SETTLED = 0.02  # largest error of a settled estimate [standard deviations]
SHIFT = 0.02  # relative shift of each weight between the old and the new model
FIRST_SEED = 5000  # the default model was trained on no street of these seeds
AFTER = 48  # evaluated windows after a swap
CAMERA = "davis346-half"
SWAPS = 4  # per street
SWAP_INTERVAL = 12  # windows between swaps
NEVER = "never swapped"

Array = NDArray[np.float64]


class Results(NamedTuple):
    """Errors of the windows after a swap, by start state; in standard deviations, except `off_truth`."""

    model: str
    digest: str
    streets: int
    swaps: int
    seconds: float
    errors: dict[str, list[float]]  # RMS over axes, bins and swaps, for each window after the swap
    worst: dict[str, list[float]]  # the same for the worst axis, RMS over bins and swaps
    off_truth: dict[str, dict[str, list[float]]]  # by "m/s" and "deg/s", then start state or NEVER: RMSE per window
    least_primed: int | None  # least N whose first estimate is within SETTLED; None if there is none


class _StreetEstimates(NamedTuple):
    """The estimates on one street."""

    variance: Array  # (6) of the estimates of the run that was never swapped
    by_start: dict[str, list[Array]]  # by start state or NEVER: twists (AFTER, n, 6) after each swap


def run(
    model: str = models.DEFAULT,
    streets: int = 6,
    primed: Iterable[int] = PRIMED,
    progress: Callable[[str], None] = lambda _: None,
) -> Results:
    """Swap to a model on some streets from every start state and measure the errors of its estimates.

    Args:
        model: name of a built-in model, or the file of a bundle.
        streets: number of held-out streets, with seeds from FIRST_SEED.
        primed: numbers of windows to replay.
        progress: is called with the name of each finished street.

    Raises:
        InvalidField: there is no street or no number of windows. BadModel: the model cannot be loaded.
    """
    replayed = sorted(set(primed))
    require(streets >= 1, "reprime", "streets", streets, "must be at least 1")
    require(bool(replayed) and replayed[0] >= 1, "reprime", "primed", replayed, "must be numbers of windows above 0")
    bundle = models.find(model)
    new, old = Estimator(bundle), Estimator(shifted(bundle))
    swaps_at = [replayed[-1] + 16 + i * SWAP_INTERVAL for i in range(SWAPS)]
    windows = swaps_at[-1] + AFTER
    seconds = windows * bundle.config.window.duration_us / 1e6
    swap_errors: dict[str, list[Array]] = {}
    truth_errors: dict[str, list[Array]] = {}
    for street in range(streets):
        simulation = simulation_of(f"sim://street?seed={FIRST_SEED + street}&camera={CAMERA}&seconds={seconds + 0.1:g}")
        estimates = _estimates_on_street(new, old, windows_of(simulation, new)[:windows], swaps_at, replayed)
        truth = true_twists(simulation.trajectory, windows, new.config)
        units = np.array([simulation.lens.height_m] * 3 + [1.0] * 3)  # the estimates are for a camera height of 1 m
        for start, runs in estimates.by_start.items():
            for at, estimate, never in zip(swaps_at, runs, estimates.by_start[NEVER], strict=True):
                swap_errors.setdefault(start, []).append(((estimate - never) ** 2).mean(axis=1) / estimates.variance)
                truth_errors.setdefault(start, []).append(
                    ((estimate * units - truth[at : at + AFTER]) ** 2).mean(axis=1)
                )
        progress(simulation.name)
    del swap_errors[NEVER]
    means = {start: np.mean(errors, axis=0) for start, errors in swap_errors.items()}  # (AFTER, 6)
    rms = {start: np.sqrt(mean.mean(axis=1)).tolist() for start, mean in means.items()}
    settled = [n for n in replayed if rms[_name(n)][0] <= SETTLED]
    return Results(
        model=bundle.name,
        digest=bundle.digest,
        streets=streets,
        swaps=streets * SWAPS,
        seconds=seconds,
        errors=rms,
        worst={start: np.sqrt(mean.max(axis=1)).tolist() for start, mean in means.items()},
        off_truth={
            "m/s": _lengths(truth_errors, slice(0, 3), 1.0),
            "deg/s": _lengths(truth_errors, slice(3, 6), 180 / np.pi),
        },
        least_primed=settled[0] if settled else None,
    )


def _lengths(truth_errors: dict[str, list[Array]], axes: slice, unit: float) -> dict[str, list[float]]:
    """RMS length of the error over some axes, by start state and window, times a unit factor."""
    return {
        start: (unit * np.sqrt(np.mean(one, axis=0)[:, axes].sum(axis=1))).tolist()
        for start, one in truth_errors.items()
    }


def shifted(bundle: Bundle, share: float = SHIFT) -> Bundle:
    """A copy of a model with every weight shifted by a normal random share of itself, of this standard deviation."""
    draw = torch.Generator().manual_seed(0)
    moved = from_bytes(bundle.to_bytes(), bundle.name)
    with torch.no_grad():
        for parameter in moved.network.parameters():
            parameter.mul_(1 + share * torch.randn(parameter.shape, generator=draw))
    return replace(moved, name=f"{bundle.name}-shifted").with_digest()


def windows_of(simulation: Simulation, estimator: Estimator) -> list[Window]:
    """The windows of a simulation, split as the service splits them for a model."""
    state, windows = estimator.initial_state(simulation.sensor, simulation.lens.info), []
    window_state = WindowsState()
    for step in simulation.steps():
        config = estimator.config
        pushed = push(step.events, step.stop_us, window_state, state.lut, config.window, config.canonical)
        window_state = pushed.state
        windows += pushed.windows
    return windows


def _estimates_on_street(
    new: Estimator, old: Estimator, windows: list[Window], swaps_at: list[int], primed: list[int]
) -> _StreetEstimates:
    """Run one street from every start state at every swap."""
    never, _ = _estimates(new, windows, _zero_state(new))
    variance = never.reshape(-1, 6).var(axis=0)
    carried = _zero_state(old)
    found: dict[str, list[Array]] = {NEVER: [never[at : at + AFTER] for at in swaps_at]}
    done = 0
    for at in swaps_at:
        _, carried = _estimates(old, windows[done:at], carried)
        done = at
        starts = {"cold": _zero_state(new), "carried": carried}
        starts |= {_name(n): _estimates(new, windows[at - n : at], _zero_state(new))[1] for n in primed}
        for start, state in starts.items():
            estimate, _ = _estimates(new, windows[at : at + AFTER], state)
            found.setdefault(start, []).append(estimate)
    return _StreetEstimates(variance, found)


def _estimates(estimator: Estimator, windows: list[Window], state: StreamState) -> tuple[Array, StreamState]:
    """Twists (W, n, 6) for W windows, and the state after them."""
    estimates, state = estimator.follow(windows, state)
    return np.array([one.twists for one in estimates]), state


def _zero_state(estimator: Estimator) -> StreamState:
    grid = estimator.config.canonical
    return estimator.initial_state(Sensor(grid.width, grid.height))


def _name(primed: int) -> str:
    return f"primed {primed}"


def to_json(results: Results) -> str:
    """The results as JSON."""
    about: dict[str, Any] = results._asdict()
    about |= {"errors": _rounded(results.errors), "worst": _rounded(results.worst)}
    about["off_truth"] = {unit: _rounded(by_start) for unit, by_start in results.off_truth.items()}
    return json.dumps(about) + "\n"


def _rounded(by_start: dict[str, list[float]]) -> dict[str, list[float]]:
    return {start: [round(one, 5) for one in errors] for start, errors in by_start.items()}


def to_markdown(results: Results) -> str:
    """The results as Markdown tables, with the windows after the swap in the columns."""
    shown = [0, 1, 4, 8, 16, 32]
    lines = [
        f"Model {results.model} ({results.digest[:12]}), {results.swaps} swaps on {results.streets} held-out "
        "streets. Error of the estimates after a swap against a run that was never swapped, RMS in standard "
        "deviations.",
        "",
        "| start | "
        + " | ".join("first" if i == 0 else f"{i} windows later" for i in shown)
        + " | first, worst axis |",
        "| --- |" + " --- |" * (len(shown) + 1),
    ]
    for start, errors in results.errors.items():
        cells = [f"{errors[i]:.4f}" for i in shown if i < len(errors)]
        lines.append(f"| {start} | {' | '.join(cells)} | {results.worst[start][0]:.4f} |")
    least = "no N of these" if results.least_primed is None else f"N = {results.least_primed}"
    lines += ["", f"Least N whose first estimate is within {100 * SETTLED:g} % of the standard deviation: {least}.", ""]
    lines += ["RMSE of the same estimates against the truth, linear [m/s] / angular [deg/s].", ""]
    lines += ["| start | " + " | ".join("first" if i == 0 else f"{i} windows later" for i in shown) + " | all |"]
    lines += ["| --- |" + " --- |" * (len(shown) + 1)]
    for start, linear in results.off_truth["m/s"].items():
        both = linear, results.off_truth["deg/s"][start]
        cells = [" / ".join(f"{one[i]:.2f}" for one in both) for i in shown if i < len(linear)]
        cells.append(" / ".join(f"{np.sqrt(np.mean(np.square(one))):.2f}" for one in both))
        lines.append(f"| {start} | {' | '.join(cells)} |")
    return "\n".join(lines) + "\n"


def draw(results: Results) -> "Figure":
    """Plot the error of the windows after a swap, by start state.

    Raises:
        MissingExtra: matplotlib is not installed.
    """
    figure = blank_figure(7.0, 4.0)
    axes = figure.subplots()
    for start, errors in results.errors.items():
        axes.semilogy(np.arange(len(errors)), np.maximum(errors, 1e-7), label=start, lw=1.5)
    axes.axhline(SETTLED, color="black", lw=0.8, ls="--", label=f"{100 * SETTLED:g} %")
    axes.set_xlabel("windows after the model swap")
    axes.set_ylabel("error [standard deviations]")
    axes.legend(ncols=2, fontsize=8)
    axes.grid(visible=True, alpha=0.3)
    return figure


def save(results: Results, folder: Path) -> list[Path]:
    """Write repriming.json, repriming.md, repriming.png and repriming.svg.

    Raises:
        InvalidField: a file cannot be written. MissingExtra: matplotlib is not installed.
    """
    files = [save_text(to_json(results), folder / "repriming.json")]
    files.append(save_text(to_markdown(results), folder / "repriming.md"))
    return files + save_figure(draw(results), folder / "repriming")
