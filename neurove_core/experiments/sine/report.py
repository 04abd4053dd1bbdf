"""Tables I and II of the paper and its regression figure, from trained networks: `neurove reproduce sine`."""

import importlib.util
import json
import math
import statistics
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import safetensors.numpy
from pydantic import ValidationError

from neurove_core.experiments import save_text
from neurove_core.experiments.sine.data import LENGTH, SKIP, VALIDATION, Recipe, evaluate, waves
from neurove_core.experiments.sine.training import Trained, train
from neurove_core.extras import MissingExtra
from neurove_core.figures import blank_figure, save_figure
from neurove_core.spiking.fused.recurrence import Array
from neurove_core.tasks import HERE, Pool
from neurove_protocol.errors import InvalidField
from neurove_protocol.fields import WrongField

if TYPE_CHECKING:
    from matplotlib.figure import Figure

RECIPES = {
    "aslstm": Recipe(model="aslstm", closed_share=0.3),
    "aslstm-spiking": Recipe(
        model="aslstm", v_th=0.6, alpha=0.1, damping=0.1, rate=0.012, updates=4000, fine_updates=3000
    ),
    "aslstm-wo": Recipe(model="aslstm-wo", v_th=0.3, width=1.0),
    "slstm": Recipe(model="slstm", v_th=0.1),
    "ltc": Recipe(model="ltc", v_th=0.1, width=0.5),
}
"""The recipes. The paper's four models share one budget: the updates, batches and learning rates of Recipe.

Threshold, surrogate and the share of closed loops are the best found for each model. `aslstm-spiking` is our own
variant and takes twice as many updates.
"""

PAPER_REGRESSION_X1000 = {
    "aslstm": (0.31, 0.30, 0.31),
    "slstm": (0.86, 0.84, 0.87),
    "ltc": (3.16, 3.67, 3.92),
    "aslstm-wo": None,  # "failed"
}
"""Table I, three sequences."""

PAPER_FORECAST = {
    "aslstm": (0.02, 0.07, 0.11),
    "slstm": (0.50, 0.88, 0.95),
    "ltc": (0.53, 0.86, 1.04),
    "aslstm-wo": None,
}
"""Table II, three sequences."""

QUICK = {"updates": 60, "fine_updates": 10}

Progress = Callable[[str, int, int, int, float], None]
"""model, seed, update, updates, mean square error."""


class SineRun(NamedTuple):
    """One model, trained from one seed and evaluated."""

    model: str
    seed: int
    recipe: Recipe
    trained: Trained
    answers: Array  # predictions (1999, VALIDATION)
    figures: dict[str, Any]


def reproduce(
    models: Sequence[str],
    seeds: Sequence[int],
    *,
    changes: Mapping[str, str] | None = None,
    quick: bool = False,
    progress: Progress | None = None,
    pool: Pool = HERE,
) -> Iterator[SineRun]:
    """Train and evaluate every model from every seed.

    Args:
        models: keys of RECIPES.
        seeds: of weights and batches.
        changes: fields of Recipe to change from RECIPES, as texts, for a trial.
        quick: train for a few updates only, to test that everything runs.
        progress: is called after each update of a training in this process.
        pool: where the trainings run.

    Yields:
        the runs, all seeds of the first model first.

    Raises:
        InvalidField: a model, or a field of `changes` or its value, is unknown. MissingExtra: scipy is not installed.
    """
    if importlib.util.find_spec("scipy") is None:
        raise MissingExtra("scipy")
    for model in models:
        if model not in RECIPES:
            raise InvalidField("reproduce sine", "models", model, f"known are {', '.join(RECIPES)}")
    recipes = {model: changed(RECIPES[model], changes or {}) for model in models}
    made = {model: recipe.model_copy(update=QUICK) if quick else recipe for model, recipe in recipes.items()}
    wanted = {f"{model} seed {seed}": (model, seed, recipe) for model, recipe in made.items() for seed in seeds}
    if pool is HERE:
        for one in wanted.values():
            yield _run(*one, progress)
        return
    done: dict[str, SineRun] = {}
    order = iter(wanted)
    awaited = next(order, None)
    for name, run in pool.run(_run_of, wanted):
        done[name] = run
        while awaited in done:
            yield done[awaited]
            awaited = next(order, None)


def _run_of(job: tuple[str, int, Recipe]) -> SineRun:
    return _run(*job, None)


def changed(recipe: Recipe, changes: Mapping[str, str]) -> Recipe:
    """The recipe with some fields set from their texts.

    >>> changed(RECIPES["aslstm"], {"v_th": "0.5", "learn_v_th": "true"}).v_th
    0.5

    Raises:
        InvalidField: a field is unknown, or its value is invalid.
    """
    try:
        return Recipe.model_validate(recipe.model_dump() | dict(changes))
    except ValidationError as error:
        wrong = WrongField.of(error)
        why = f"known are {', '.join(Recipe.model_fields)}" if wrong.kind == "extra_forbidden" else wrong.why
        raise InvalidField("recipe", wrong.name or "set", wrong.value, why) from None


def _run(model: str, seed: int, recipe: Recipe, progress: Progress | None) -> SineRun:
    updates = recipe.updates + recipe.fine_updates

    def report(update: int, mse: float) -> None:
        if progress is not None:
            progress(model, seed, update + 1, updates, mse)

    trained = train(recipe, seed, report)
    evaluation, answers = evaluate(trained.network)
    thresholds = np.concatenate([layer.v_th for layer in trained.network.weights[:2]])
    figures = {
        "model": model,
        "seed": seed,
        "regression_rmse_x1000": evaluation.regression_rmse_x1000,
        "regression_rmse_x1000_from_100": evaluation.regression_rmse_x1000_from_100,
        "forecast_rmse": evaluation.forecast_rmse,
        "spike_rate": evaluation.spike_rate,
        "v_th": sorted({round(float(value), 4) for value in thresholds}),
        "updates": trained.updates,
        "skipped_updates": trained.skipped_updates,
        "cpu_s": round(trained.cpu_s, 1),
        "parameters": int(trained.network.learned.sum()),
    }
    return SineRun(model, seed, recipe, trained, answers, figures)


def save_run(runs: list[SineRun], out: Path, *, command: str, commit: str) -> list[Path]:
    """Write the network of the last run and the figures of all runs, so that an interrupted command loses nothing.

    Args:
        runs: the finished runs.
        out: folder, created if missing.
        command: that made the runs.
        commit: of the code.

    Raises:
        InvalidField: a file cannot be written.
    """
    rows = [run.figures | {"command": command, "commit": commit} for run in runs]
    figures = save_text(json.dumps(rows, indent=1) + "\n", out / "sine.json")
    run = runs[-1]
    file = out / f"{run.model}-{run.seed}.safetensors"
    header = {"recipe": run.recipe.model_dump_json(), "seed": str(run.seed), "command": command, "commit": commit}
    safetensors.numpy.save_file({"theta": run.trained.network.theta}, file, header)
    return [figures, file]


def save(runs: list[SineRun], out: Path) -> list[Path]:
    """Write the two tables and the pictures.

    Args:
        runs: all runs.
        out: folder, created if missing.

    Raises:
        InvalidField: a file cannot be written. MissingExtra: matplotlib is not installed.
    """
    files = []
    for number, rows in tables([run.figures for run in runs]).items():
        files.append(save_text(json.dumps(rows, indent=1) + "\n", out / f"table{number}.json"))
        files.append(save_text(markdown(rows, number), out / f"table{number}.md"))
    files += save_figure(draw_regression(runs), out / "regression")
    return files + save_figure(draw_spikes(runs), out / "spikes")


def tables(figures: list[dict[str, Any]]) -> dict[int, list[dict[str, Any]]]:
    """The rows of Table I and Table II, from the figures of some runs."""
    return {
        1: table(figures, "regression_rmse_x1000_from_100", PAPER_REGRESSION_X1000),
        2: table(figures, "forecast_rmse", PAPER_FORECAST),
    }


def table(figures: list[dict[str, Any]], key: str, paper: dict[str, Any]) -> list[dict[str, Any]]:
    """One row per model: the median over the seeds for each sequence, with the figures of the paper."""
    rows = []
    for model in dict.fromkeys(one["model"] for one in figures):
        own = [one for one in figures if one["model"] == model]
        rows.append(
            {
                "model": model,
                "sequences": [statistics.median(one[key][row] for one in own) for row in range(VALIDATION)],
                "all_steps": [
                    statistics.median(one["regression_rmse_x1000"][row] for one in own) for row in range(VALIDATION)
                ]
                if key.startswith("regression")
                else None,
                "paper": paper.get(model.removesuffix("-spiking")),
                "spike_rate": [statistics.median(one["spike_rate"][layer] for one in own) for layer in range(2)],
                "v_th": own[0]["v_th"],
                "seeds": len(own),
            }
        )
    return rows


def markdown(rows: list[dict[str, Any]], number: int) -> str:
    """A table in Markdown."""
    what = f"Table {'I' * number}: " + (
        f"regression, RMSE x 1000, steps {SKIP} to 998 (in brackets: all steps)" if number == 1 else "forecast, RMSE"
    )
    seeds = rows[0]["seeds"] if rows else 0
    lines = [
        f"{what}; sequences 1 / 2 / 3, {f'median of {seeds} seeds' if seeds > 1 else 'one seed'}",
        "",
        "| model | measured | paper | spike rate, layer 1 / 2 | V_th |",
        "| --- | --- | --- | --- | --- |",
    ]
    for row in rows:
        measured = _joined(row["sequences"])
        if row["all_steps"]:
            measured += f" ({_joined(row['all_steps'])})"
        paper = " / ".join(f"{value:g}" for value in row["paper"]) if row["paper"] else "failed"
        rates = " / ".join(f"{100 * rate:.2g} %" for rate in row["spike_rate"])
        thresholds = ", ".join(f"{value:g}" for value in row["v_th"][:4]) + (", ..." if len(row["v_th"]) > 4 else "")
        lines.append(f"| {row['model']} | {measured} | {paper} | {rates} | {thresholds} |")
    return "\n".join(lines) + "\n"


def _joined(values: Sequence[float]) -> str:
    return " / ".join(f"{value:.2g}" if math.isfinite(value) else "-" for value in values)


def draw_regression(runs: list[SineRun]) -> "Figure":
    """Plot truth and prediction of the first validation wave over 2000 steps, with their errors, one row per model."""
    firsts = list({run.model: run for run in reversed(runs)}.values())[::-1]
    figure = blank_figure(10, 1.9 * len(firsts) + 0.4)
    axes = figure.subplots(len(firsts), 1, sharex=True, squeeze=False)[:, 0]
    steps = np.arange(1, 2 * LENGTH)
    for axis, run in zip(axes, firsts, strict=True):
        truth = _truth()
        axis.plot(steps, truth, color="0.6", linewidth=2.5, label="sin")
        axis.plot(steps, np.clip(run.answers[:, 0], -1.6, 1.6), color="C3", linewidth=0.9, label=run.model)
        axis.axvline(LENGTH, color="0.3", linestyle=":")
        axis.set_ylim(-1.7, 1.7)
        axis.set_ylabel(run.model)
        forecast = run.figures["forecast_rmse"][0]
        regression = run.figures["regression_rmse_x1000_from_100"][0]
        axis.set_title(f"regression RMSE x 1000: {regression:.2g}      forecast RMSE: {forecast:.2g}", fontsize=9)
    axes[-1].set_xlabel(f"step; from {LENGTH} on the network runs on its own predictions")
    return figure


def _truth() -> Array:
    """The first validation wave, continued (1999,)."""
    row = waves()[0].astype(np.float64)
    phase = math.atan2(row[0], (row[1] - row[0] * math.cos(0.05)) / math.sin(0.05))
    truth: Array = np.sin(np.arange(1, 2 * LENGTH) / 20 + phase)
    return truth


def draw_spikes(runs: list[SineRun]) -> "Figure":
    """Plot the spikes of both layers over the first validation wave, one column per model."""
    firsts = list({run.model: run for run in reversed(runs)}.values())[::-1]
    figure = blank_figure(2.6 * len(firsts) + 1, 4.6)
    axes = figure.subplots(2, len(firsts), sharex=True, squeeze=False)
    x = np.zeros((2 * LENGTH - 1, 1), np.float32)
    x[:LENGTH, 0] = waves()[0]
    for column, run in enumerate(firsts):
        network = run.trained.network
        tape = network.run(x, network.initial_state(1), LENGTH)
        for layer, taped in enumerate(tape[:2]):
            axis = axes[layer, column]
            steps, units = np.nonzero(taped.s[1:, 0])
            axis.plot(steps, units, "|", color="C0", markersize=2)
            axis.set_ylim(-1, taped.s.shape[2])
            axis.set_title(f"{run.model}, layer {layer + 1}: {100 * taped.s[1:].mean():.2g} %", fontsize=9)
            axis.axvline(LENGTH, color="0.3", linestyle=":")
    axes[0, 0].set_ylabel("unit")
    axes[1, 0].set_ylabel("unit")
    return figure
