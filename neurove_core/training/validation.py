"""Validation: the error of a run on windows that it does not train on, and when to stop because it gets worse.

A run is validated on two sets. `recorded` are the held-out parts of its recordings. `simulated` are a few scenes of its
own seeds, with the cameras, lenses and motions of the configuration: they tell whether a model that learns from
recordings still works elsewhere. Each set is run from the zero state, without augmentation.
"""

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np
import torch
from torch import Tensor

from neurove_core.config import ModelConfig
from neurove_core.ingest.channels import network_input
from neurove_core.networks import kinds
from neurove_core.networks.encoding import to_spikes
from neurove_core.networks.kinds import Network
from neurove_core.training.batches import Segment
from neurove_core.training.config import DataConfig, RecipeConfig, TrainingConfig
from neurove_core.training.data import Sequences, Span

Point = dict[str, float]
"""The errors of one validation: `step`, and `SET_linear_error_m_s` and `SET_angular_error_rad_s` of each set."""

SETS: Final = ("recorded", "simulated")
"""The sets, the one that decides first."""

LEAST_POINTS: Final = 10
"""A run is not stopped within this many validations after its best one."""

WORSE: Final = 1.05
"""Weights whose errors are this much larger than the best ones are replaced by the best ones at the end."""

WARNED: Final = 1.25
"""Above this ratio to the model that the run began from, the sentences at the end say that it has become worse."""

_SEED_SHIFT: Final = 300_000_000  # distance from the seeds of training
_SEEDS: Final = 890_000_000
_STREAMS: Final = 16  # most segments of a set
_NAMES: Final = {"recorded": "the held-out parts of the recordings", "simulated": "simulated scenes"}


def simulated_config(config: TrainingConfig) -> TrainingConfig:
    """The configuration of the simulated scenes that a run is validated on."""
    seconds = config.recipe.segment_windows * config.model.window.duration_us / 1e6
    seed = (config.data.seed + _SEED_SHIFT) % _SEEDS
    changes = {"sequences": config.recipe.validation_sequences, "recordings": (), "seconds": seconds, "seed": seed}
    return config.model_copy(update={"data": DataConfig.model_validate(config.data.model_dump() | changes)})


class Held(NamedTuple):
    """The sets of a run: S windows of each of B streams; None for a set without windows."""

    recorded: Segment | None
    simulated: Segment | None

    @classmethod
    def read(
        cls, recorded: list[Span], simulated: list[Path], recipe: RecipeConfig, model: ModelConfig | None = None
    ) -> "Held":
        """Read the windows of both sets.

        Args:
            recorded: windows of recordings that the run does not train on.
            simulated: files of simulated sequences.
            recipe: of the run; a stream has `segment_windows`.
            model: its subcells and its history; by default the stored counts are the input.
        """
        return cls(_segment(recorded, recipe, model), _segment([Span(path) for path in simulated], recipe, model))


def _segment(spans: list[Span], recipe: RecipeConfig, model: ModelConfig | None) -> Segment | None:
    found, windows = Sequences(spans), recipe.segment_windows
    starts = [
        (index, first)
        for index, twists in enumerate(found.twists)
        for first in range(0, len(twists) - windows + 1, windows)
    ]
    if not starts:
        return None
    chosen = [starts[int(i)] for i in np.linspace(0, len(starts) - 1, min(_STREAMS, len(starts)))]
    stored = [found.counts(index, first, first + windows) for index, first in chosen]
    counts = np.stack([one if model is None else network_input(one, model) for one in stored], 1)
    twists = np.stack([found.twists[index][first : first + windows] for index, first in chosen], 1)
    heights = torch.tensor([found.height_m[index] for index, _ in chosen], dtype=torch.float32)
    return Segment(torch.from_numpy(counts), torch.from_numpy(twists), heights)


def validate(network: Network, held: Held, config: TrainingConfig, scaling: tuple[Tensor, Tensor], step: int) -> Point:
    """Compute the errors of a network, in evaluation mode, on both sets.

    Args:
        network: trained so far; it stays as it is.
        held: the sets.
        config: of the run.
        scaling: offset and scale (6) of the outputs of the network.
        step: updates so far.
    """
    with torch.random.fork_rng(devices=[]):
        copy = kinds.make(config.model)
    copy.load_state_dict(network.state_dict())
    device = scaling[0].device
    copy = copy.to(device).eval()
    point: Point = {"step": float(step)}
    for name, segment in zip(SETS, held, strict=True):
        if segment is None:
            continue
        error = _error(copy, Segment(*(one.to(device) for one in segment)), config, scaling)
        # an axis without truth, such as the lateral one of a wheel, counts as no error; a part without truth has none
        for part, unit, values in (("linear", "m_s", error[..., :3]), ("angular", "rad_s", error[..., 3:])):
            known = values.isfinite().any(-1)
            lengths = torch.linalg.vector_norm(values.nan_to_num(0.0), dim=-1)
            if known.any():
                point[f"{name}_{part}_error_{unit}"] = float(lengths[known].mean())
    return point


def _error(network: Network, segment: Segment, config: TrainingConfig, scaling: tuple[Tensor, Tensor]) -> Tensor:
    """Estimate minus truth (S, B, n, 6) [m/s, rad/s]; nan where the truth is unknown."""
    offset, scale = scaling
    state, outputs = network.initial_state(segment.counts.shape[1]), []
    with torch.no_grad():
        for chunk in torch.split(segment.counts, config.recipe.chunk_windows):
            output, state = network(to_spikes(chunk, config.model.network.encoding), state)
            outputs.append(output)
    error: Tensor = torch.cat(outputs) * scale + offset - segment.twists
    error[..., :3] *= segment.height_m[:, None, None]
    return error


def score(point: Point) -> float:
    """One number of a validation, smaller is better: the product of the errors of the set that decides."""
    for name in SETS:
        found = [value for key, value in point.items() if key.startswith(f"{name}_")]
        if found:
            return math.prod(found)
    return math.inf


def best_of(points: Sequence[Point]) -> int:
    """Index of the best validation, the first one of equals."""
    return min(range(len(points)), key=lambda index: score(points[index]))


def is_over(points: Sequence[Point], recipe: RecipeConfig) -> bool:
    """Whether a run has not become better for `recipe.patience` of its updates and LEAST_POINTS validations.

    >>> points = [{"step": 10.0 * i, "simulated_linear_error_m_s": 1.0 + i} for i in range(12)]
    >>> is_over(points, RecipeConfig(steps=200, patience=0.5)), is_over(points[:10], RecipeConfig(steps=100))
    (True, False)
    """
    if not points or recipe.patience >= 1:
        return False
    best = best_of(points)
    since = points[-1]["step"] - points[best]["step"]
    return len(points) - 1 - best > LEAST_POINTS and since >= recipe.patience * recipe.updates


def sentences(points: Sequence[Point], kept_step: int, recipe: RecipeConfig, *, from_model: bool) -> list[str]:
    """What a run learned, for people: one sentence for each set, and whether it was stopped or has become worse.

    Args:
        points: of all validations.
        kept_step: update whose weights the bundle has.
        recipe: of the run.
        from_model: the run began from the weights of a model.
    """
    kept = next((point for point in points if point["step"] == kept_step), None)
    if kept is None:
        return []
    told = [f"error on {_NAMES[name]}: {_told(points[0], kept, name, from_model)}" for name in SETS if _of(kept, name)]
    last = int(points[-1]["step"])
    if last < recipe.updates:
        told.append(f"stopped early, after {last} of {recipe.updates} updates: no improvement since update {kept_step}")
    elif kept_step < last:
        told.append(f"the weights are those of update {kept_step}: later ones have larger errors")
    for name in SETS if from_model else ():
        ratio = max((kept[key] / max(points[0][key], 1e-9) for key in _of(kept, name)), default=0.0)
        if ratio > WARNED:
            told.append(f"warning: on {_NAMES[name]} the error is {ratio:.1f} times that of the model it began from")
    return told


def _of(point: Point, name: str) -> list[str]:
    return [key for key in point if key.startswith(f"{name}_")]


def _told(first: Point, kept: Point, name: str, from_model: bool) -> str:
    parts = []
    for key in _of(kept, name):
        part, unit = ("linear", "m/s") if key.endswith("m_s") else ("angular", "rad/s")
        before = f" ({first[key]:.3g} before training)" if from_model else ""
        parts.append(f"{part} {kept[key]:.3g} {unit}{before}")
    return ", ".join(parts)
