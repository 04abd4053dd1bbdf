"""Adapt a model to one robot: learn from its recorded drive, calibrate, and compare on pieces that were held out.

The recorded windows are mixed with simulated sequences. They keep what the recording does not show, such as the axes
that wheel speed leaves unknown.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

import numpy as np
import torch
from numpy.typing import NDArray

from neurove_core import self_test, tasks
from neurove_core.adaptation import compare
from neurove_core.adaptation.pieces import Span as Times
from neurove_core.adaptation.pieces import within
from neurove_core.adaptation.prepare import Prepared
from neurove_core.estimator import Estimator
from neurove_core.evaluation.estimates import Estimates, estimate_recording
from neurove_core.models import bundle as bundles
from neurove_core.models.bundle import Bundle
from neurove_core.tasks import Pool
from neurove_core.training import calibration, loop, pipeline, validation
from neurove_core.training import config as configs
from neurove_core.training.config import DataConfig, TrainingConfig
from neurove_core.training.data import Cache, Span, save
from neurove_core.training.pipeline import OnProgress
from neurove_core.training.ranks import alone
from neurove_core.training.recorded import split_recording
from neurove_core.training.validation import Held
from neurove_protocol.velocity import AXES

RECORDED_SHARE: Final = 0.6
"""Share of the training segments that come from the recordings; the others are simulated."""

_SEGMENT_WINDOWS: Final = 32  # shorter than in training, because pieces of a recording are short
_SECONDS: Final = 600.0  # the longest sequence of a configuration: a piece is not divided
_PROVENANCE_CHARS: Final = 1000


@dataclass(frozen=True)
class Recipe:
    """How much is learned."""

    updates: int = 600  # 0: only the gains
    learning_rate: float = 1e-4
    simulated: int = 16  # sequences
    calibration_sequences: int = calibration.SEQUENCES
    workers: int = 1
    seed: int = 0
    device: torch.device | None = None  # that learns and calibrates; None: the CPU learns, the engine calibrates
    config: str = "wider"  # training configuration that gives the augmentations and the simulated scenes


@dataclass(frozen=True)
class Adapted:
    """A model after the adaptation, and how it compares."""

    bundle: Bundle
    before: dict[str, Any]  # see compare.figures
    after: dict[str, Any]
    better: bool
    why: str
    notes: tuple[str, ...]


def configuration(start: Bundle, recipe: Recipe, name: str) -> TrainingConfig:
    """The configuration of an adaptation: that of a training, with the network of the start model.

    Raises:
        InvalidField: there is no such training configuration, or a value in it is wrong.
    """
    usual = configs.load(recipe.config)
    changes = {
        "steps": max(1, recipe.updates),
        "cycles": 1,
        "seed": recipe.seed,
        "learning_rate": recipe.learning_rate,
        "warm_up_steps": min(50, recipe.updates // 4),
        "validation_share": 0.0,
        "patience": 1.0,
        "segment_windows": min(_SEGMENT_WINDOWS, usual.recipe.segment_windows),
        "validation_sequences": min(usual.recipe.validation_sequences, recipe.simulated),
    }
    data = DataConfig.model_validate(usual.data.model_dump() | {"sequences": recipe.simulated, "recordings": ()})
    fields = {"name": name, "model": start.config, "data": data, "recipe": usual.recipe.model_copy(update=changes)}
    return usual.model_copy(update=fields)


def least_windows(config: TrainingConfig) -> tuple[int, int]:
    """Least number of consecutive windows to learn from, and to validate with."""
    return config.recipe.most_windows, config.recipe.segment_windows


def adapt(
    prepared: list[Prepared],
    start: Bundle,
    config: TrainingConfig,
    folder: Path,
    recipe: Recipe,
    on_progress: OnProgress = lambda *_: None,
) -> Adapted:
    """Scale the outputs, learn, calibrate and compare.

    First one gain per axis is fitted to the pieces to learn from. Then the network learns, beginning with the scaled
    model. The validation pieces decide which of the two is kept. The held-out pieces only compare.

    Args:
        prepared: the recordings of one robot.
        start: model that the adaptation begins from; `Prepared.before` has its estimates.
        config: as `configuration` gives it.
        folder: for sequences, checkpoint and curve.
        recipe: how much is learned.
        on_progress: called after each step of a task.

    Raises:
        BrokenRecording, BadModel, InvalidField: as `training.loop.train` and `training.pipeline.calibrate`.
    """
    before = [one.before for one in prepared]
    gain = compare.gains(compare.joined(_pairs(prepared, before, lambda one: one.pieces.training)))
    notes = ["gains: " + " ".join(f"{axis} {value:.2f}" for axis, value in zip(AXES, gain, strict=True))]
    scaled = _scaled(start, gain, config.name)
    candidates = [("gains alone", scaled, [_times(one, gain) for one in before])]
    if recipe.updates:
        learned = _learned(prepared, scaled, config, folder, recipe, on_progress)
        estimator, after = Estimator(learned), []
        for done, one in enumerate(prepared, 1):
            after.append(estimate_recording(estimator, one.recording))
            on_progress("estimated", done, len(prepared), one.recording.name)
        candidates.append(("learning", learned, after))
    checked = [compare.joined(_pairs(prepared, found, lambda one: one.pieces.validation)) for _, _, found in candidates]
    scores = [compare.score(one) for one in checked]
    best = int(np.argmin(scores))
    if recipe.updates:
        compared = ", ".join(f"{name} {score:.3f}" for (name, _, _), score in zip(candidates, scores, strict=True))
        notes.append(
            f"kept: {candidates[best][0]}; product of the RMSE of both parts on the validation pieces: {compared}"
        )
    _, made, found = candidates[best]
    if made.uncertainty is not None:
        factor = compare.sigma_factor(checked[best])
        notes.append("sigma, by the validation pieces: " + " ".join(f"{value:.2f}" for value in factor))
        made = calibration.with_wider_sigma(made, factor, "scaled on the recordings of neurove adapt")
        found = [replace(one, sigma=None if one.sigma is None else one.sigma * factor) for one in found]
    figures = (
        compare.figures(compare.joined(_pairs(prepared, before, lambda one: one.pieces.held))),
        compare.figures(compare.joined(_pairs(prepared, found, lambda one: one.pieces.held))),
    )
    better, why = compare.verdict(*figures)
    return Adapted(_described(made, start, prepared, *figures), *figures, better, why, tuple(notes))


def _learned(
    prepared: list[Prepared],
    start: Bundle,
    config: TrainingConfig,
    folder: Path,
    recipe: Recipe,
    on_progress: OnProgress,
) -> Bundle:
    """The model after learning from the recordings, with an uncertainty from simulated sequences if one is wanted."""
    data = folder / "data"
    _simulate(config, data, tasks.local(recipe.workers), on_progress)
    learned = _sequences(prepared, config, data / "learned", lambda one: one.pieces.training, on_progress)
    validating = _sequences(prepared, config, data / "validated", lambda one: one.pieces.validation, on_progress)
    scenes = validation.simulated_config(config) if config.recipe.validation_sequences else None
    if scenes:
        _simulate(scenes, data, tasks.local(recipe.workers), on_progress)
    simulated = Cache(data, scenes).paths() if scenes else []
    held = Held.read([Span(path) for path, _ in validating], simulated, config.recipe)

    def trained(progress: loop.Progress) -> None:
        errors = f"{progress.linear_m_s:.3f} m/s {progress.angular_rad_s:.4f} rad/s"
        on_progress("learned", progress.step, progress.steps, errors)

    spans = _spans(learned, config, recipe.simulated)
    path = loop.train(
        config, folder, data, more=spans, held=held, start=start, ranks=alone(recipe.device), on_progress=trained
    )
    if recipe.calibration_sequences and config.model.kind == "neurove":
        plain = bundles.load(path)
        pipeline.calibrate(
            plain,
            config,
            data,
            path,
            recipe.calibration_sequences,
            tasks.local(recipe.workers),
            on_progress,
            device=recipe.device,
        )
    return bundles.load(path)


def _scaled(start: Bundle, gain: NDArray[np.float64], name: str) -> Bundle:
    """The start model with its estimates multiplied by a gain per axis; its sigma grows with it."""
    by = torch.from_numpy(gain).float()
    made = replace(start, name=name, offset=start.offset * by, scale=start.scale * by)
    if made.golden:
        made = replace(made, golden=self_test.record(Estimator(made), made.golden.counts, made.golden.tolerance))
    return made.with_digest()


def _times(found: Estimates, gain: NDArray[np.float64]) -> Estimates:
    sigma = None if found.sigma is None else found.sigma * gain
    return replace(found, twists=found.twists * gain, sigma=sigma)


def _pairs(
    prepared: list[Prepared], estimates: list[Estimates], spans_of: Callable[[Prepared], tuple[Times, ...]]
) -> list[compare.Paired]:
    return [
        compare.pair(found, one.truth.twists, spans_of(one)) for found, one in zip(estimates, prepared, strict=True)
    ]


def _simulate(config: TrainingConfig, folder: Path, pool: Pool, on_progress: OnProgress) -> None:
    cache, wanted = Cache(folder, config), config.data.sequences
    for done, name in enumerate(cache.fill(pool), wanted - len(cache.missing()) + 1):
        on_progress("simulated", done, wanted, name)


def _sequences(
    prepared: list[Prepared],
    config: TrainingConfig,
    folder: Path,
    spans_of: Callable[[Prepared], tuple[Times, ...]],
    on_progress: OnProgress,
) -> list[tuple[Path, int]]:
    """Windows of some pieces of all recordings as files, with the number of windows of each."""
    folder.mkdir(parents=True, exist_ok=True)
    undivided = config.model_copy(update={"data": config.data.model_copy(update={"seconds": _SECONDS})})
    made: list[tuple[Path, int]] = []
    for done, one in enumerate(prepared, 1):
        truth = within(one.truth.twists, spans_of(one))
        for sequence in split_recording(one.recording, truth, one.height_m, undivided):
            path = folder / f"{len(made):06d}.safetensors"
            save(sequence, path)
            made.append((path, len(sequence.twists)))
        on_progress(f"split into windows ({folder.name})", done, len(prepared), one.recording.name)
    return made


def _spans(learned: list[tuple[Path, int]], config: TrainingConfig, simulated: int) -> list[Span]:
    """Spans of the recorded windows, so many that they make up RECORDED_SHARE of all sequences, evenly placed."""
    length = config.recipe.most_windows
    starts = [(path, first) for path, windows in learned for first in range(windows - length + 1)]
    wanted = max(len(learned), round(simulated * RECORDED_SHARE / (1 - RECORDED_SHARE)))
    if not simulated:
        wanted = max(wanted, sum(windows for _, windows in learned) // length)
    chosen = [starts[int(i)] for i in np.linspace(0, len(starts) - 1, wanted)] if starts else []
    return [Span(path, first, first + length) for path, first in chosen]


def _described(
    made: Bundle, start: Bundle, prepared: list[Prepared], before: dict[str, Any], after: dict[str, Any]
) -> Bundle:
    """The bundle with its origin and with the figures of the comparison."""
    names = ", ".join(one.recording.name for one in prepared)
    text = f"neurove adapt: begun from {start.name} {start.digest[:12]}, recordings {names}; {made.provenance}"
    figures = dict(made.metadata.figures)
    for part, unit in (("v_l", "m_s"), ("v_a", "rad_s")):
        for when, found in (("before", before), ("after", after)):
            if found[part]["rmse"] is not None:
                figures[f"adapted_{when}_rmse_{part}_{unit}"] = float(found[part]["rmse"])
    metadata = made.metadata.model_copy(update={"figures": figures})
    return replace(made, provenance=text[:_PROVENANCE_CHARS], metadata=metadata).with_digest()
