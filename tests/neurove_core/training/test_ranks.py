"""Distributed training: all processes have the same bits, take the step of one process, and survive a lost process."""

import copy
import json
import multiprocessing
import shutil
from pathlib import Path

import numpy as np
import pytest
import safetensors.torch
import torch
from torch import nn

from neurove_core.models import bundle
from neurove_core.networks.encoding import to_spikes
from neurove_core.networks.state import detached
from neurove_core.training import data
from neurove_core.training.batches import Segment, draw
from neurove_core.training.config import TrainingConfig
from neurove_core.training.loop import CHECKPOINT, RUN_JSON, learning_rate, losses, train, train_segment, train_to_end
from neurove_core.training.loss import scaled_sum
from neurove_core.training.ranks import ALONE, LostRank, SharedNorm, device_of, process_group
from neurove_core.training.run import TrainingRun
from neurove_protocol.errors import BadModel, InvalidField
from tests.neurove_core.training.test_training import TINY

CONFIG, RECIPE = TINY, TINY.recipe


@pytest.fixture(autouse=True)
def _tests_can_be_imported(monkeypatch):
    """Started processes import this file, because it contains their function; they get the path of this process."""
    monkeypatch.syspath_prepend(str(Path(__file__).parents[3]))


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Sequences of noise: these tests do not depend on the content of the sequences."""
    folder, rng = tmp_path_factory.mktemp("noise"), np.random.default_rng(0)
    cache = data.Cache(folder, CONFIG)
    cache.folder.mkdir(parents=True)
    for index in range(3):
        counts = rng.poisson(0.3, (10, 10, 16, 22)).astype(np.uint8)
        twists = rng.standard_normal((10, 5, 6)).astype(np.float32)
        data.save(data.Sequence(counts, twists, 1.0 + index, f"noise {index}"), cache.path(index))
    return folder


@pytest.fixture(scope="module")
def sequences(folder):
    return data.Cache(folder, CONFIG).open()


def one_update(config: TrainingConfig) -> TrainingConfig:
    recipe = config.recipe.model_copy(update={"segment_windows": 4, "chunk_windows": 4})
    return config.model_copy(update={"recipe": recipe})


def part(segment: Segment, first: int, stop: int) -> Segment:
    return Segment(segment.counts[:, first:stop], segment.twists[:, first:stop], segment.height_m[first:stop])


def train_as_rank(config, paths, out, ranks):
    """Main function of each rank in the test below: an update on its half of a batch, then a complete run."""
    sequences = data.Sequences(paths)
    run = TrainingRun.begin(one_update(config), sequences, ranks)
    batch = draw(np.random.default_rng(5), sequences, run.config.recipe)
    train_segment(run, part(batch, 2 * ranks.rank, 2 * ranks.rank + 2))
    kept = {f"gradient.{name}": tensor.grad for name, tensor in run.network.named_parameters()}
    kept |= {f"once.{name}": tensor.clone() for name, tensor in run.network.state_dict().items()}
    run = TrainingRun.begin(config, sequences, ranks)
    train_to_end(run, sequences, out)
    kept |= run.network.state_dict() | {"curve": torch.tensor([list(point.values())[:4] for point in run.curve])}
    kept = {name: tensor.contiguous() for name, tensor in kept.items()}
    safetensors.torch.save_file(kept, out / f"rank-{ranks.rank}.safetensors")


def test_two_processes_take_the_same_step_as_one_and_end_with_the_same_bits(sequences, tmp_path):
    arguments = (CONFIG, sequences.paths, tmp_path)
    with process_group(2, "cpu", train_as_rank, arguments) as ranks:
        train_as_rank(*arguments, ranks)
    one, other = (safetensors.torch.load_file(tmp_path / f"rank-{rank}.safetensors") for rank in (0, 1))
    assert one.keys() == other.keys()
    assert all(torch.equal(tensor, other[name]) for name, tensor in one.items())
    alone = TrainingRun.begin(one_update(CONFIG), sequences)
    train_segment(alone, draw(np.random.default_rng(5), sequences, alone.config.recipe))
    for name, parameter in alone.network.named_parameters():
        torch.testing.assert_close(one[f"gradient.{name}"], parameter.grad, rtol=1e-3, atol=1e-5)
    for name, buffer in alone.network.named_buffers():
        torch.testing.assert_close(one[f"once.{name}"], buffer)
    assert {file.name for file in tmp_path.iterdir()} == {
        CHECKPOINT, RUN_JSON, "rank-0.safetensors", "rank-1.safetensors"
    }  # fmt: skip
    assert json.loads((tmp_path / RUN_JSON).read_text())["devices"] == 2


def test_a_run_that_lost_a_process_resumes_and_ends_with_the_same_weights(folder, tmp_path):
    whole, parts = tmp_path / "whole", tmp_path / "parts"
    at_once = train(CONFIG, whole, folder, devices=2)

    def kill(progress):
        if progress.step == 8:
            for process in multiprocessing.active_children():
                process.kill()

    with pytest.raises(LostRank, match="process 1 of the run ended"):
        train(CONFIG, parts, folder, devices=2, on_progress=kill)
    shutil.copytree(parts, tmp_path / "alone")
    with pytest.raises(BadModel, match="began with devices=2"):
        train(CONFIG, tmp_path / "alone", folder, resume=True)
    resumed = train(CONFIG, parts, folder, resume=True, devices=2)
    assert not multiprocessing.active_children()
    one, two = (bundle.load(path).network.state_dict() for path in (at_once, resumed))
    assert all(torch.equal(tensor, two[name]) for name, tensor in one.items())
    assert "2 devices" in bundle.load(resumed).provenance


def test_one_process_follows_the_recipe_bit_for_bit(folder, sequences, tmp_path):
    """The reference is the plain loop, without ranks."""
    run = TrainingRun.begin(CONFIG, sequences)
    network, optimiser, rng, balance = run.network, run.optimiser, run.rng, run.balance
    for step in range(0, RECIPE.steps, RECIPE.chunks):
        segment, state = draw(rng, sequences, RECIPE), network.initial_state(RECIPE.batch)
        for chunk in range(RECIPE.chunks):
            windows = slice(2 * chunk, 2 * chunk + 2)
            optimiser.param_groups[0]["lr"] = learning_rate(step + chunk, RECIPE)
            answers, state = network(to_spikes(segment.counts[windows], "log1p"), state)
            loss, balance = scaled_sum(*losses(run, answers, segment, windows), balance, RECIPE.balance_decay)
            optimiser.zero_grad()
            loss.backward()
            nn.utils.clip_grad_norm_(network.parameters(), RECIPE.clip_norm)
            optimiser.step()
            state = detached(state)
    made = bundle.load(train(CONFIG, tmp_path, folder)).network.state_dict()
    assert all(torch.equal(tensor, made[name]) for name, tensor in network.state_dict().items() if "num_b" not in name)


@pytest.mark.parametrize(("norm", "shape"), [(nn.BatchNorm1d(5), (7, 5)), (nn.BatchNorm2d(5), (3, 5, 4, 2))])
def test_a_shared_norm_computes_what_the_norm_of_torch_does(norm, shape):
    torch.manual_seed(0)
    nn.init.uniform_(norm.weight)
    nn.init.uniform_(norm.bias)
    shared = SharedNorm(copy.deepcopy(norm), ALONE)
    x = (3 + torch.randn(shape)).requires_grad_()
    y = x.detach().clone().requires_grad_()
    weights = torch.randn(shape)
    for one, given in ((norm, x), (shared, y)):
        (one(given) * weights).sum().backward()
    torch.testing.assert_close(x.grad, y.grad)
    assert list(norm.state_dict()) == list(shared.state_dict())
    for name, tensor in norm.state_dict().items():
        torch.testing.assert_close(shared.state_dict()[name], tensor)
    torch.testing.assert_close(shared.weight.grad, norm.weight.grad)


@pytest.mark.parametrize("devices", [0, 3])
def test_a_batch_that_does_not_split_is_refused(folder, tmp_path, devices):
    with pytest.raises(InvalidField, match=rf"devices={devices}: recipe.batch=4 does not split"):
        train(CONFIG, tmp_path, folder, devices=devices)


def test_a_device_must_exist():
    assert device_of("cpu", 1, 2) == torch.device("cpu")
    with pytest.raises(InvalidField, match="auto, cpu or cuda"):
        device_of("tpu")
    many = torch.cuda.device_count() + 1
    with pytest.raises(InvalidField, match=f"{many} GPUs are needed"):
        device_of("cuda", 0, many)
    assert device_of("auto", 0, many).type == "cpu"
