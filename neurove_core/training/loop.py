"""The loop: segments of many streams, truncated backpropagation through time, Adam (research/velocity.md, recipe L)."""

import json
import math
import subprocess
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Final, NamedTuple

import torch
from torch import Tensor

from neurove_core import bundle
from neurove_core.carried import detached
from neurove_core.encoding import to_spikes
from neurove_core.loss import group_loss, scaled_sum
from neurove_core.training.batches import Segment, draw
from neurove_core.training.config import RecipeConfig, TrainingConfig
from neurove_core.training.data import Cache, Sequences
from neurove_core.training.run import Run, write_whole

CHECKPOINT: Final = "checkpoint.safetensors"
RUN_JSON: Final = "run.json"

_CURVE_STEPS: Final = 100  # the curve has the mean of so many updates
_PROVENANCE_CHARS: Final = 1000


class Progress(NamedTuple):
    """How far a run is."""

    step: int
    steps: int
    linear_m_s: float  # mean length of the linear error since the last report
    angular_rad_s: float


class _Losses(NamedTuple):
    linear: float
    angular: float


def learning_rate(step: int, recipe: RecipeConfig) -> float:
    """Of update `step`, counted from 0: rises in a line to the recipe's, then falls as half a cosine to 0.

    >>> [round(learning_rate(step, RecipeConfig(steps=300, warm_up_steps=100)), 6) for step in (0, 99, 200, 300)]
    [1e-05, 0.001, 0.0005, 0.0]
    """
    if step < recipe.warm_up_steps:
        return recipe.learning_rate * (step + 1) / recipe.warm_up_steps
    done = (step - recipe.warm_up_steps) / max(1, recipe.steps - recipe.warm_up_steps)
    return recipe.learning_rate * 0.5 * (1 + math.cos(math.pi * min(1.0, done)))


def train(
    config: TrainingConfig,
    out: Path,
    data: Path,
    *,
    more: Sequence[Path] = (),
    resume: bool = False,
    on_progress: Callable[[Progress], None] = lambda _: None,
) -> Path:
    """Train a model to the end of its recipe.

    Args:
        config: of the run.
        out: folder for the checkpoint, run.json and the bundle.
        data: folder of the sequences, filled by `Cache.fill`.
        more: files of further sequences, as `data.save` writes them.
        resume: go on from the checkpoint in `out`, where there is one.
        on_progress: told after each segment.

    Returns:
        the bundle's path.

    Raises:
        BrokenRecording: a sequence is missing or broken. BadModel: the checkpoint can not be gone on from.
    """
    out.mkdir(parents=True, exist_ok=True)
    checkpoint = out / CHECKPOINT
    cache = Cache(data, config)
    sequences = Sequences([*(cache.path(index) for index in range(config.data.sequences)), *more])
    run = Run.restore(checkpoint, config) if resume and checkpoint.exists() else Run.begin(config, sequences)
    saved_s, began_s, recent = time.monotonic(), time.process_time() - run.cpu_s, list[_Losses]()
    while run.step < config.recipe.steps:
        recent += learn(run, draw(run.rng, sequences, config.recipe))
        run.cpu_s = time.process_time() - began_s
        mean = _mean(recent)
        on_progress(Progress(run.step, config.recipe.steps, 2 * mean.linear, 2 * mean.angular))
        if len(recent) >= _CURVE_STEPS or run.step >= config.recipe.steps:
            run.curve.append(_point(run, mean))
            recent = []
            if time.monotonic() - saved_s >= config.recipe.checkpoint_s or run.step >= config.recipe.steps:
                run.save(checkpoint)
                _write_run(run, out)
                saved_s = time.monotonic()
    path = out / f"{config.name}{bundle.SUFFIX}"
    bundle.save(run.bundle(provenance(run, len(more))), path)
    return path


def learn(run: Run, segment: Segment) -> list[_Losses]:
    """Follow a segment's streams from rest, chunk by chunk, with an update of the weights after each."""
    recipe = run.config.recipe
    state, losses = run.network.initial_state(segment.counts.shape[1]), []
    for first in range(0, recipe.segment_windows, recipe.chunk_windows):
        chunk = slice(first, first + recipe.chunk_windows)
        for group in run.optimiser.param_groups:
            group["lr"] = learning_rate(run.step, recipe)
        spikes = to_spikes(segment.counts[chunk], run.config.model.network.encoding)
        answers, state = run.network(spikes, state)
        linear, angular = errors(run, answers, segment, chunk)
        loss, run.balance = scaled_sum(linear, angular, run.balance, recipe.balance_decay)
        run.optimiser.zero_grad(set_to_none=True)
        loss.backward()  # type: ignore[no-untyped-call]  # torch's own
        torch.nn.utils.clip_grad_norm_(run.network.parameters(), recipe.clip_norm)
        run.optimiser.step()
        run.step += 1
        state = detached(state)
        losses.append(_Losses(float(linear.detach()), float(angular.detach())))
    return losses


def errors(run: Run, answers: Tensor, segment: Segment, chunk: slice) -> tuple[Tensor, Tensor]:
    """L_l in m/s and L_a in rad/s of a chunk's answers (T, B, n, 6).

    The linear part is learned per metre of camera height, but its error counts in m/s: else streams near the ground,
    whose numbers are large, would be all that is learned.
    """
    error = answers * run.scale + run.offset - segment.twists[chunk]
    return group_loss(error[..., :3] * segment.height_m[:, None, None]), group_loss(error[..., 3:])


def provenance(run: Run, more: int = 0) -> str:
    """One line: how this model was made; `more` sequences were learned from beside the configuration's."""
    recipe, data = run.config.recipe, run.config.data
    text = (
        f"neurove train {run.config.name}: {run.step} updates of {recipe.batch} x {recipe.chunk_windows} windows, "
        f"seed {recipe.seed}, {data.sequences} simulated sequences of {data.seconds:g} s from seed {data.seed}"
        f"{f' and {more} more' if more else ''}, "
        f"{run.cpu_s:.0f} CPU s, commit {commit() or 'unknown'}, torch {torch.__version__}"
    )
    return text[:_PROVENANCE_CHARS]


def commit() -> str | None:
    """The commit of the source that runs, or None where it is no work tree."""
    command = ["git", "-C", str(Path(__file__).parent), "describe", "--always", "--dirty", "--exclude=*"]
    try:
        return subprocess.run(command, capture_output=True, text=True, check=True, timeout=10).stdout.strip() or None
    except (OSError, subprocess.SubprocessError):
        return None


def _mean(losses: list[_Losses]) -> _Losses:
    return _Losses(*(sum(values) / len(values) for values in zip(*losses, strict=True)))


def _point(run: Run, mean: _Losses) -> dict[str, float]:
    return {
        "step": run.step,
        "linear_error_m_s": 2 * mean.linear,
        "angular_error_rad_s": 2 * mean.angular,
        "learning_rate": learning_rate(run.step - 1, run.config.recipe),
        "cpu_s": round(run.cpu_s, 1),
    }


def _write_run(run: Run, out: Path) -> None:
    about: dict[str, Any] = {
        "config": run.config.model_dump(mode="json"),
        "seed": run.config.recipe.seed,
        "commit": commit(),
        "torch": torch.__version__,
        "step": run.step,
        "cpu_s": round(run.cpu_s, 1),
        "curve": run.curve,
    }
    write_whole(out / RUN_JSON, json.dumps(about, indent=1).encode())
