"""Distributed training: all processes have the same bits, take the step of one process, and survive a lost process."""

import contextlib
import copy
import json
import os
import signal
import socket
import subprocess
import sys
import tomllib
from pathlib import Path

import numpy as np
import pytest
import safetensors.torch
import torch
from torch import nn

from neurove_core.models import bundle
from neurove_core.networks.encoding import to_spikes
from neurove_core.networks.state import detached
from neurove_core.training import data, pipeline
from neurove_core.training.batches import draw
from neurove_core.training.config import TrainingConfig
from neurove_core.training.loop import CHECKPOINT, RUN_JSON, learning_rate, losses, train, train_segment
from neurove_core.training.loss import scaled_sum
from neurove_core.training.ranks import ALONE, SharedNorm, device_of
from neurove_core.training.run import TrainingRun
from neurove_protocol.errors import BadModel, InvalidField
from tests import tiny
from tests.live.conftest import wait_until
from tests.neurove_core.training.rank_worker import one_update

ROOT = Path(__file__).parents[3]
TOML = tiny.toml(sequences=3, steps=60, batch=4, warm_up_steps=2, checkpoint_s=0, validation_sequences=0)
CONFIG = TrainingConfig.model_validate(tomllib.loads(TOML))
AGAIN = "if no launcher starts it again, continue with --resume"


def free_port():
    with socket.socket() as one:
        one.bind(("127.0.0.1", 0))
        return one.getsockname()[1]


def children_of(pid):
    return [int(child) for child in Path(f"/proc/{pid}/task/{pid}/children").read_text().split()]


def listens_beyond_loopback(pid):
    """The ports of a process that other machines can reach."""
    open_files = []
    for one in Path(f"/proc/{pid}/fd").iterdir():
        with contextlib.suppress(FileNotFoundError):  # it was closed meanwhile
            open_files.append(str(one.readlink()))
    tables = [Path(f"/proc/net/{name}").read_text().splitlines()[1:] for name in ("tcp", "tcp6")]
    rows = [line.split() for table in tables for line in table]
    ours = [row[1] for row in rows if row[3] == "0A" and f"socket:[{row[9]}]" in open_files]
    loopback = ("0100007F", "00000000000000000000000001000000", "0000000000000000FFFF00000100007F")
    return [address for address in ours if address.split(":")[0] not in loopback]


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


@pytest.fixture(scope="module")
def two(folder, tmp_path_factory):
    """Results of two processes that two agents of torchrun started; see rank_worker.py."""
    out, port = tmp_path_factory.mktemp("two"), free_port()
    (out / "config.json").write_text(CONFIG.model_dump_json())
    agents = [torchrun(port, "tests.neurove_core.training.rank_worker", str(folder), str(out)) for _ in range(2)]
    for agent in agents:
        _, errors = agent.communicate(timeout=300)
        assert agent.returncode == 0, errors
    return out


def torchrun(port, module, *words):
    """An agent of torchrun with one process, on the loopback."""
    meeting = ["--rdzv-backend", "c10d", "--rdzv-endpoint", f"127.0.0.1:{port}", "--rdzv-id", f"test-{port}"]
    places = ["--nnodes", "2", "--nproc-per-node", "1", "--local-addr", "127.0.0.1"]
    command = [sys.executable, "-m", "torch.distributed.run", *places, *meeting, "-m", module, *words]
    return subprocess.Popen(command, cwd=ROOT, stderr=subprocess.PIPE, text=True)


def test_two_processes_take_the_same_step_as_one_and_end_with_the_same_bits(sequences, two):
    one, other = (safetensors.torch.load_file(two / f"rank-{rank}.safetensors") for rank in (0, 1))
    assert one.keys() == other.keys()
    assert all(torch.equal(tensor, other[name]) for name, tensor in one.items())
    alone = TrainingRun.begin(one_update(CONFIG), sequences)
    train_segment(alone, draw(np.random.default_rng(5), sequences, alone.config.recipe))
    for name, parameter in alone.network.named_parameters():
        torch.testing.assert_close(one[f"gradient.{name}"], parameter.grad, rtol=1e-3, atol=1e-5)
    for name, buffer in alone.network.named_buffers():
        torch.testing.assert_close(one[f"once.{name}"], buffer)
    assert json.loads((two / "out" / RUN_JSON).read_text())["devices"] == 2


def test_what_ranks_exchange_besides_tensors(two):
    """The text of rank_worker.py says what each line is."""
    told = [json.loads((two / f"rank-{rank}.json").read_text()) for rank in (0, 1)]
    assert told[0]["bytes"] == told[1]["bytes"] == "of rank 1"
    assert [one["work"] for one in told] == ["done by 0", "done by 1"]
    assert told[0]["other_failed"] == "process 1 of the run failed: a full disk; " + AGAIN
    assert told[1]["other_failed"] == "a full disk"
    assert "process 1 of the run has b" in told[0]["differs"]
    assert "process 0 of the run has a" in told[1]["differs"]


def test_a_run_that_lost_a_process_starts_again_and_ends_with_the_weights_of_an_uninterrupted_one(
    folder, two, tmp_path
):
    """The launcher of `neurove train --devices 2` starts both again, and they continue from the checkpoint."""
    (tmp_path / "tiny.toml").write_text(TOML)
    out = tmp_path / "out"
    words = ["train", str(tmp_path / "tiny.toml"), "--out", str(out), "--data", str(folder), "--device", "cpu"]
    command = [sys.executable, "-m", "neurove_service.cli", *words, "--calibration-sequences", "0", "--devices", "2"]
    with subprocess.Popen(command, cwd=ROOT, stderr=subprocess.PIPE, text=True) as run:
        wait_until(lambda: (out / CHECKPOINT).exists() or run.poll() is not None)
        (first, *_) = children = children_of(run.pid)
        assert [port for pid in (run.pid, *children) for port in listens_beyond_loopback(pid)] == []
        os.kill(first, signal.SIGKILL)
        _, errors = run.communicate(timeout=300)
    assert run.returncode == 0, errors
    assert f"exitcode: {-signal.SIGKILL}" in errors  # of torch
    one, other = (bundle.load(each / "tiny.safetensors") for each in (two / "out", out))
    weights = other.network.state_dict()
    assert all(torch.equal(tensor, weights[name]) for name, tensor in one.network.state_dict().items())
    assert "2 devices" in other.provenance
    with pytest.raises(BadModel, match="began with devices=2"):
        train(CONFIG, out, folder, resume=True)


def test_one_process_follows_the_recipe_bit_for_bit(folder, sequences, tmp_path):
    """The reference is the plain loop, without ranks."""
    recipe = CONFIG.recipe.model_copy(update={"steps": 12})
    config = CONFIG.model_copy(update={"recipe": recipe})
    run = TrainingRun.begin(config, sequences)
    network, optimiser, rng, balance = run.network, run.optimiser, run.rng, run.balance
    for step in range(0, recipe.steps, recipe.chunks):
        segment, state = draw(rng, sequences, recipe), network.initial_state(recipe.batch)
        for chunk in range(recipe.chunks):
            windows = slice(2 * chunk, 2 * chunk + 2)
            optimiser.param_groups[0]["lr"] = learning_rate(step + chunk, recipe)
            answers, state = network(to_spikes(segment.counts[windows], "log1p"), state)
            loss, balance = scaled_sum(*losses(run, answers, segment, windows), balance, recipe.balance_decay)
            optimiser.zero_grad()
            loss.backward()
            nn.utils.clip_grad_norm_(network.parameters(), recipe.clip_norm)
            optimiser.step()
            state = detached(state)
    made = bundle.load(train(config, tmp_path, folder)).network.state_dict()
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
def test_a_batch_that_does_not_split_is_refused(tmp_path, devices):
    with pytest.raises(InvalidField, match=rf"devices={devices}: recipe.batch=4 does not split"):
        pipeline.check(CONFIG, tmp_path, devices=devices)


def test_a_device_must_exist():
    assert device_of("cpu", 1, 2) == torch.device("cpu")
    with pytest.raises(InvalidField, match="auto, cpu or cuda"):
        device_of("tpu")
    many = torch.cuda.device_count() + 1
    with pytest.raises(InvalidField, match=f"{many} GPUs are needed"):
        device_of("cuda", 0, many)
    assert device_of("auto", 0, many).type == "cpu"
