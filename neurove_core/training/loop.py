"""The training loop: batches of segments, truncated backpropagation through time, Adam.

Source: research/velocity.md, recipe L.
"""

import json
import math
import subprocess
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from neurove_core import self_test
from neurove_core.config import CanonicalConfig
from neurove_core.estimator import Estimator
from neurove_core.files import write_atomically
from neurove_core.ingest.channels import window_counts
from neurove_core.models import bundle, golden
from neurove_core.models.bundle import Bundle
from neurove_core.models.metadata import MadeBy, Metadata
from neurove_core.networks.encoding import to_spikes
from neurove_core.networks.state import detached
from neurove_core.training import validation
from neurove_core.training.batches import Segment, draw
from neurove_core.training.config import RecipeConfig, TrainingConfig
from neurove_core.training.curve import Scalars, draw_curve
from neurove_core.training.data import Cache, Sequences, Span
from neurove_core.training.loss import group_loss, scaled_sum
from neurove_core.training.ranks import ALONE, Ranks
from neurove_core.training.recorded import RecordedSequences
from neurove_core.training.run import TrainingRun, checkpoint_step
from neurove_core.training.validation import Held

CHECKPOINT: Final = "checkpoint.safetensors"
RUN_JSON: Final = "run.json"

_CURVE_STEPS: Final = 100  # updates per point of the curve; in a short run, one hundredth of all updates
_PROVENANCE_CHARS: Final = 1000
_GOLDEN_SEQUENCES: Final = 8
_GOLDEN_BYTES: Final = 200_000
_NAMES_CHARS: Final = 400  # of the names of recordings in the provenance


class Progress(NamedTuple):
    """Progress of a run."""

    step: int
    steps: int
    linear_m_s: float  # mean length of the linear error since the last point of the curve
    angular_rad_s: float
    validated: dict[str, float] | None = None  # the newest validation, see `validation.Point`


class _Losses(NamedTuple):
    linear: float
    angular: float


def learning_rate(step: int, recipe: RecipeConfig) -> float:
    """Compute the learning rate of update `step`, counted from 0: a linear warm-up, then half a cosine to 0.

    Each further cycle repeats this with half the peak of the previous cycle (warm restarts, Loshchilov 2017). The first
    cycles do not depend on the number of cycles, so a finished run can continue with more.

    >>> recipe = RecipeConfig(steps=300, warm_up_steps=100, cycles=2)
    >>> [round(learning_rate(step, recipe), 6) for step in (0, 99, 200, 299, 399, 500, 600)]
    [1e-05, 0.001, 0.0005, 0.0, 0.0005, 0.00025, 0.0]
    """
    cycle = min(step // recipe.steps, recipe.cycles - 1)
    step, peak = step - cycle * recipe.steps, recipe.learning_rate * 0.5**cycle
    if step < recipe.warm_up_steps:
        return peak * (step + 1) / recipe.warm_up_steps
    done = (step - recipe.warm_up_steps) / max(1, recipe.steps - recipe.warm_up_steps)
    return peak * 0.5 * (1 + math.cos(math.pi * min(1.0, done)))


def train(
    config: TrainingConfig,
    out: Path,
    data: Path,
    *,
    more: Sequence[Path | Span] = (),
    held: Held | None = None,
    resume: bool = False,
    start: Bundle | None = None,
    ranks: Ranks = ALONE,
    on_progress: Callable[[Progress], None] = lambda _: None,
) -> Path:
    """Train a network on existing sequences, and write its bundle without an uncertainty; see `pipeline.train`.

    Args:
        config: of the run.
        out: folder for the checkpoint, run.json, the curve and the bundle.
        data: folder of the sequences, filled by `Cache.fill` and `RecordedSequences.fill`.
        more: files of further sequences, as `data.save` writes them, or spans of their windows.
        held: windows that validate the run; without them it is not validated and not stopped early. With them, the
            held-out parts of the recordings are not trained on; see `RecordedSequences.split`.
        resume: continue from the checkpoint in `out`, if it exists; with several ranks, from the newest of theirs.
        start: model whose weights the run begins from; ignored if the run continues from a checkpoint.
        ranks: this process and the others of the run, which call this function too; see `joining.joined`.
        on_progress: called after each segment.

    Returns:
        the path of the bundle, which the first rank has written.

    Raises:
        BrokenRecording: a sequence is missing or broken.
        BadModel: the checkpoint does not fit the configuration, or `start` has another network.
        InvalidField: the batch does not split over the ranks.
        LostRank: one of the processes ended early.
    """
    if ranks.first:
        out.mkdir(parents=True, exist_ok=True)
    recorded = RecordedSequences(data, config)
    validates = ranks.gather(held is not None)[0]  # only the first rank has the windows that validate
    parts = recorded.split()[0] if validates else recorded.paths()
    sequences = Sequences([*Cache(data, config).paths(), *parts, *more])
    run = begin_run(config, out, sequences, ranks, start, resume=resume)
    path = out / f"{config.name}{bundle.SUFFIX}"
    if not ranks.first:
        train_to_end(run, sequences, out)
        return path
    with Scalars(out, run.step) as scalars:
        train_to_end(run, sequences, out, on_progress, scalars.add, held)
    draw_curve(run.curve, out, f"{config.name}: {run.step} updates", run.validation)
    made = run.bundle(provenance(run, len(more)), metadata_of(run), best=kept_step(run) < run.step)
    test = self_test.record(Estimator(made), golden_windows(sequences, config.model.canonical))
    bundle.save(replace(made, golden=test), path)
    return path


def begin_run(
    config: TrainingConfig, out: Path, sequences: Sequences, ranks: Ranks, start: Bundle | None, *, resume: bool
) -> TrainingRun:
    """The run of a rank, at its first update or at that of the newest checkpoint of all ranks.

    The folder of the first rank need not be the one that has the checkpoint, because a launcher may number the
    machines anew when it starts their processes again.
    """
    path = out / CHECKPOINT
    steps = ranks.gather(checkpoint_step(path) if resume else -1)
    newest = max(steps)
    if newest < 0:
        return TrainingRun.begin(config, sequences, ranks, start)
    if min(steps) == newest:
        return TrainingRun.restore(path, config, ranks)
    source = steps.index(newest)
    content = ranks.from_rank(source, path.read_bytes() if ranks.rank == source else b"")
    with tempfile.TemporaryDirectory() as folder:
        copy = Path(folder, CHECKPOINT)
        copy.write_bytes(content)
        return TrainingRun.restore(copy, config, ranks)


def train_to_end(
    run: TrainingRun,
    sequences: Sequences,
    out: Path,
    on_progress: Callable[[Progress], None] = lambda _: None,
    on_point: Callable[[dict[str, float]], None] = lambda _: None,
    held: Held | None = None,
) -> None:
    """Train to the end of the recipe, or until the validation does not improve any more.

    The first rank validates the run, and writes checkpoints and run.json to `out`.
    """
    recipe, share = run.config.recipe, run.rank_recipe
    spent_s, saved_s, began_s, recent = run.cpu_s, time.monotonic(), time.process_time(), list[_Losses]()
    if held and not run.validation:
        on_point(_validated(run, held))
    over = _is_over(run)
    while run.step < recipe.updates and not over:
        recent += train_segment(run, draw(run.rng, sequences, share, run.config.model))
        mean = _mean(recent)
        validated = run.validation[-1] if run.validation else None
        on_progress(Progress(run.step, recipe.updates, 2 * mean.linear, 2 * mean.angular, validated))
        if len(recent) < min(_CURVE_STEPS, recipe.steps / 100) and run.step < recipe.updates:
            continue
        if held:
            on_point(_validated(run, held))
        ranks = run.ranks.gather((run.rng_state, time.process_time() - began_s, _is_over(run)))
        run.cpu_s = spent_s + sum(cpu_s for _, cpu_s, _ in ranks)
        over = any(ends for _, _, ends in ranks)
        run.curve.append(_point(run, mean))
        on_point(run.curve[-1])
        recent = []
        due = time.monotonic() - saved_s >= recipe.checkpoint_s or run.step >= recipe.updates or over
        if due and run.ranks.first:
            run.save(out / CHECKPOINT, [order for order, _, _ in ranks])
            _write_run(run, out)
            saved_s = time.monotonic()


def _validated(run: TrainingRun, held: Held) -> validation.Point:
    """Validate a run, and keep its weights if they are the best so far."""
    point = validation.validate(run.network, held, run.config, (run.offset, run.scale), run.step)
    run.validation.append(point)
    if validation.best_of(run.validation) == len(run.validation) - 1:
        run.best = {name: tensor.detach().clone() for name, tensor in run.network.state_dict().items()}
    return point


def _is_over(run: TrainingRun) -> bool:
    """Whether the validation ends the run early. Only the first rank has validations."""
    return validation.is_over(run.validation, run.config.recipe)


def kept_step(run: TrainingRun) -> int:
    """The update whose weights the bundle gets: the last one, unless the best validation is clearly better."""
    if not run.validation or not run.best:
        return run.step
    best, last = run.validation[validation.best_of(run.validation)], run.validation[-1]
    return int(best["step"]) if validation.score(last) > validation.WORSE * validation.score(best) else run.step


def train_segment(run: TrainingRun, segment: Segment) -> list[_Losses]:
    """Run the streams of a segment from the zero state, with an update of the weights after each chunk."""
    recipe, ranks = run.config.recipe, run.ranks
    segment = Segment(*(tensor.to(ranks.device) for tensor in segment))
    state, steps = run.network.initial_state(segment.counts.shape[1]), []
    for first in range(0, recipe.segment_windows, recipe.chunk_windows):
        chunk = slice(first, first + recipe.chunk_windows)
        for group in run.optimiser.param_groups:
            group["lr"] = learning_rate(run.step, recipe)
        spikes = to_spikes(segment.counts[chunk], run.config.model.network.encoding)
        outputs, state = run.network(spikes, state)
        linear, angular = (ranks.mean(loss) for loss in losses(run, outputs, segment, chunk))
        loss, run.balance = scaled_sum(linear, angular, run.balance, recipe.balance_decay)
        run.optimiser.zero_grad(set_to_none=True)
        loss.backward()  # type: ignore[no-untyped-call]  # torch's own
        ranks.average_gradients(run.network.parameters())
        torch.nn.utils.clip_grad_norm_(run.network.parameters(), recipe.clip_norm)
        run.optimiser.step()
        run.step += 1
        state = detached(state)
        steps.append(_Losses(float(linear.detach()), float(angular.detach())))
    return steps


def losses(run: TrainingRun, outputs: Tensor, segment: Segment, chunk: slice) -> tuple[Tensor, Tensor]:
    """Compute L_l [m/s] and L_a [rad/s] of the outputs (T, B, n, 6) of the network for a chunk.

    The linear part is trained per metre of camera height, but its error counts in m/s. Otherwise streams near the
    ground, whose values are large, would dominate the loss. An unknown truth (nan) counts as no error.
    """
    truth = segment.twists[chunk]
    error = torch.where(truth.isnan(), 0, outputs * run.scale + run.offset - truth)
    return group_loss(error[..., :3] * segment.height_m[:, None, None]), group_loss(error[..., 3:])


def provenance(run: TrainingRun, more: int = 0) -> str:
    """Describe in one line how the model was made.

    Args:
        run: at its end.
        more: number of sequences in addition to those of the configuration.
    """
    recipe, data = run.config.recipe, run.config.data
    names = ", ".join(Path(one.source).name for one in data.recordings)
    also = f" and {more} more" if more else ""
    also += f", {len(data.recordings)} recordings ({names[:_NAMES_CHARS]})" if names else ""
    also += f", {run.ranks.count} devices" if run.ranks.count > 1 else ""
    text = (
        f"{_program(run)}: {run.step} updates of {recipe.batch} x {recipe.chunk_windows} windows, "
        f"seed {recipe.seed}, {data.sequences} simulated sequences of {data.seconds:g} s from seed {data.seed}{also}, "
        f"{run.cpu_s:.0f} CPU s, commit {commit() or 'unknown'}, torch {torch.__version__}"
    )
    return text[:_PROVENANCE_CHARS]


def metadata_of(run: TrainingRun) -> Metadata:
    """Describe how the model was made, as fields, with its errors in the last updates."""
    config = run.config
    made_by = MadeBy(
        program=_program(run),
        seed=config.recipe.seed,
        commit=commit(),
        torch=torch.__version__,
        updates=run.step,
        cpu_s=round(run.cpu_s, 1),
        recipe=config.recipe.model_dump(mode="json"),
        data=config.data.model_dump(mode="json"),
    )
    last = run.curve[-1] if run.curve else {}
    errors = ("linear_error_m_s", "angular_error_rad_s")
    figures = {f"training_{name}": last[name] for name in errors if name in last}
    kept = next((point for point in run.validation if point["step"] == kept_step(run)), {})
    figures |= {f"validation_{name}": value for name, value in kept.items() if name != "step"}
    return Metadata(made_by=made_by, figures=figures)


def _program(run: TrainingRun) -> str:
    begun = f", begun from {run.start[:12]}" if run.start else ""
    return f"neurove train {run.config.name}{begun}"


def golden_windows(sequences: Sequences, canonical: CanonicalConfig | None = None) -> NDArray[np.uint8]:
    """Select windows (T, C, H, W) for the golden test: the busiest end of the first sequences.

    A large grid gives fewer windows than `golden.WINDOWS`, so that they fit into the bundle.

    Args:
        sequences: of the run.
        canonical: grid and subcells of the model; by default the windows are as stored.
    """
    ends = []
    for index in range(min(len(sequences), _GOLDEN_SEQUENCES)):
        stop = len(sequences.twists[index])
        end = sequences.counts(index, max(0, stop - golden.WINDOWS), stop)
        end = end if canonical is None else window_counts(end, canonical)
        while len(end) > 1 and golden.stored_bytes(end) > _GOLDEN_BYTES:
            end = end[len(end) // 2 :]
        ends.append(end)
    return max(ends, key=np.count_nonzero)


def commit() -> str | None:
    """Return the commit of the running source, or None if it is not in a work tree."""
    command = ["git", "-C", str(Path(__file__).parent), "describe", "--always", "--dirty", "--exclude=*"]
    try:
        return subprocess.run(command, capture_output=True, text=True, check=True, timeout=10).stdout.strip() or None
    except (OSError, subprocess.SubprocessError):
        return None


def _mean(losses: list[_Losses]) -> _Losses:
    return _Losses(*(sum(values) / len(values) for values in zip(*losses, strict=True)))


def _point(run: TrainingRun, mean: _Losses) -> dict[str, float]:
    return {
        "step": run.step,
        "linear_error_m_s": 2 * mean.linear,
        "angular_error_rad_s": 2 * mean.angular,
        "learning_rate": learning_rate(run.step - 1, run.config.recipe),
        "cpu_s": round(run.cpu_s, 1),
    }


def _write_run(run: TrainingRun, out: Path) -> None:
    summary: dict[str, Any] = {
        "config": run.config.model_dump(mode="json"),
        "seed": run.config.recipe.seed,
        "commit": commit(),
        "torch": torch.__version__,
        "step": run.step,
        "start": run.start or None,
        "devices": run.ranks.count,
        "device": run.ranks.device.type,
        "cpu_s": round(run.cpu_s, 1),
        "curve": run.curve,
        "validation": run.validation,
        "kept_step": kept_step(run),
        "validated": validation.sentences(
            run.validation, kept_step(run), run.config.recipe, from_model=bool(run.start)
        ),
    }
    write_atomically(out / RUN_JSON, json.dumps(summary, indent=1).encode())
