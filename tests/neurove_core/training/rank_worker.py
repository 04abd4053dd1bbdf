"""A process of a distributed run in test_ranks.py; its arguments are the folders of sequences and results."""

import json
import sys
from pathlib import Path

import numpy as np
import safetensors.torch
import torch

from neurove_core.training import data, joining
from neurove_core.training.batches import Segment, draw
from neurove_core.training.config import TrainingConfig
from neurove_core.training.loop import train, train_segment
from neurove_core.training.run import TrainingRun
from neurove_protocol.errors import NeuroVEError


def one_update(config: TrainingConfig) -> TrainingConfig:
    recipe = config.recipe.model_copy(update={"segment_windows": 4, "chunk_windows": 4})
    return config.model_copy(update={"recipe": recipe})


def part(segment: Segment, first: int, stop: int) -> Segment:
    return Segment(segment.counts[:, first:stop], segment.twists[:, first:stop], segment.height_m[first:stop])


def error_of(call, *arguments) -> str:
    try:
        call(*arguments)
    except (NeuroVEError, OSError) as error:
        return str(error)
    return ""


def main(folder: Path, out: Path) -> None:
    config = TrainingConfig.model_validate_json((out / "config.json").read_text())
    torch.set_num_threads(1)  # as the command does: another number of threads adds in another order
    with joining.joined("cpu") as ranks:
        sequences = data.Cache(folder, config).open()
        run = TrainingRun.begin(one_update(config), sequences, ranks)
        batch = draw(np.random.default_rng(5), sequences, run.config.recipe)
        train_segment(run, part(batch, 2 * ranks.rank, 2 * ranks.rank + 2))  # its half of the batch
        kept = {f"gradient.{name}": tensor.grad for name, tensor in run.network.named_parameters()}
        kept |= {f"once.{name}": tensor.clone() for name, tensor in run.network.state_dict().items()}
        kept = {name: tensor.contiguous() for name, tensor in kept.items()}
        safetensors.torch.save_file(kept, out / f"rank-{ranks.rank}.safetensors")
        train(config, out / "out", folder, ranks=ranks)

        def fail_on_1() -> None:
            if ranks.rank == 1:
                raise OSError("a full disk")

        told = {
            "bytes": ranks.from_rank(1, f"of rank {ranks.rank}".encode()).decode(),
            "work": ranks.together(lambda: f"done by {ranks.rank}"),
            "other_failed": error_of(ranks.together, fail_on_1),
            "differs": error_of(ranks.agree, "letter", "ab"[ranks.rank]),
        }
        (out / f"rank-{ranks.rank}.json").write_text(json.dumps(told))


if __name__ == "__main__":
    main(*map(Path, sys.argv[1:]))
