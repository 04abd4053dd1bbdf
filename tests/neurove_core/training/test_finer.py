"""Training with parts of a cell and a history: stored fine counts, their channels, robots and rocking cameras."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from pydantic import ValidationError

from neurove_core import self_test
from neurove_core.config import CanonicalConfig, ModelConfig, NetworkConfig
from neurove_core.estimator import Estimator
from neurove_core.ingest.channels import network_input, to_cells, window_counts
from neurove_core.models import bundle
from neurove_core.models.bundle import PER_HEIGHT
from neurove_core.sim.motion.generated import MAX_HEADING, driving, robot, rocked
from neurove_core.training import config as configs
from neurove_core.training import data
from neurove_core.training.batches import draw
from neurove_core.training.calibration import VARIANTS, collect_errors
from neurove_core.training.config import DataConfig, RecipeConfig, TrainingConfig
from neurove_core.training.loop import train
from neurove_core.training.run import TrainingRun
from neurove_core.training.validation import Held
from neurove_protocol.errors import BadModel

NETWORK = NetworkConfig(channels=(4, 8), features=16, hidden=16, history=(1, 2))
GRID = CanonicalConfig(width=11, height=8, hfov_deg=80, subcells=2)
FINE = TrainingConfig(
    name="fine",
    model=ModelConfig(canonical=GRID, network=NETWORK),
    data=DataConfig(
        sequences=2, seconds=0.5, cameras={"pinhole:24x18": 1.0}, subcells=2, threshold=(0.1, 0.12), slowed_hand=(1, 1)
    ),
    recipe=RecipeConfig(steps=8, batch=2, segment_windows=4, chunk_windows=2, warm_up_steps=2, checkpoint_s=0),
)
COARSE_MODEL = ModelConfig(canonical=GRID.model_copy(update={"subcells": 1}), network=NETWORK)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("fine")
    assert len(list(data.Cache(folder, FINE).fill())) == 2
    return folder


def test_fine_counts_are_stored_once_for_models_with_and_without_subcells(folder):
    coarse = FINE.model_copy(update={"model": COARSE_MODEL})
    assert data.Cache(folder, coarse).missing() == []
    stored = data.Cache(folder, coarse).open().counts(0, 0, 10)
    assert stored.shape == (10, 10, 16, 22)
    simulation = data.draw_simulation(FINE.data, 0)
    assert np.array_equal(stored, data.sequence_of(simulation, FINE.model).counts)
    cells = data.sequence_of(simulation, COARSE_MODEL).counts
    assert np.array_equal(to_cells(stored, 2), cells)
    assert np.array_equal(window_counts(stored, COARSE_MODEL.canonical), cells)
    assert cells.sum() > 10


def test_a_sparse_file_gives_the_counts_that_were_saved(tmp_path):
    counts = np.random.default_rng(0).poisson(0.05, (6, 4, 9, 7)).astype(np.uint8)
    counts[2] = 0
    counts[5, 0, 0, 0] = 255
    made = data.Sequence(counts, np.ones((6, 2, 6), np.float32), 1.5, "x")
    data.save(made, tmp_path / "a.safetensors", sparse=True)
    found = data.Sequences([tmp_path / "a.safetensors", data.Span(tmp_path / "a.safetensors", 2, 5)])
    assert np.array_equal(found.counts(0, 0, 6), counts)
    assert np.array_equal(found.counts(0, 1, 4), counts[1:4])
    assert np.array_equal(found.counts(1, 1, 3), counts[3:5])


def test_a_batch_has_the_channels_of_the_network(folder):
    sequences = data.Cache(folder, FINE).open()
    for model in (FINE.model, COARSE_MODEL):
        segment = draw(np.random.default_rng(0), sequences, FINE.recipe, model)
        assert tuple(segment.counts.shape) == (4, 2, *model.input_shape)
        channels = model.window_shape[0]
        assert not segment.counts[0, :, channels:].any()  # a segment begins like a stream
        assert segment.counts[1:, :, channels:].any()


def test_a_model_with_parts_and_a_history_is_trained_and_serves(folder, tmp_path):
    made = bundle.load(train(FINE, tmp_path, folder))
    assert made.config == FINE.model
    assert made.golden is not None
    self_test.check(Estimator(made))
    errors = list(collect_errors(made, [(data.Cache(folder, FINE).open(), False)]))
    assert len(errors) == 2 * len(VARIANTS)
    assert all(np.isfinite(one.error).all() and one.error.shape == (10, 5, 6) for one in errors)


def test_a_calibration_on_a_device_finds_the_errors_of_the_engine(folder):
    made = bundle.untrained(5, FINE.model, "fine")
    parts = [(data.Cache(folder, FINE).open(), False)]
    wanted, found = (list(collect_errors(made, parts, device)) for device in (None, torch.device("cpu")))
    for ours, theirs in zip(found, wanted, strict=True):
        assert ours[2:] == theirs[2:]
        np.testing.assert_allclose(ours.error, theirs.error, atol=1e-4)
        np.testing.assert_allclose(ours.inputs, theirs.inputs, atol=1e-4)
    with pytest.raises(NotImplementedError, match="meta"):  # its tensors have no values, so that they cannot be read
        next(collect_errors(made, parts, torch.device("meta")))


def test_a_validation_sees_the_channels_of_the_network(folder):
    paths = data.Cache(folder, FINE).paths()
    held = Held.read([], paths, FINE.recipe, FINE.model)
    assert held.simulated is not None
    assert held.simulated.counts.shape[2:] == FINE.model.input_shape


def test_a_model_whose_subcells_are_not_stored_is_refused_with_both_values():
    fields = FINE.model_dump() | {"data": DataConfig()}
    with pytest.raises(ValidationError, match=r"data.subcells=1: model.canonical.subcells=2 needs as many"):
        TrainingConfig.model_validate(fields)


def test_settings_that_are_newer_than_stored_sequences_leave_their_folder_as_it_was(tmp_path):
    old = data.Cache(tmp_path, configs.load("default")).folder.name
    assert old == "84f87b804314bf9f"
    rocking = FINE.model_copy(update={"data": DataConfig.model_validate(FINE.data.model_dump() | {"rocked": 0.5})})
    assert data.Cache(tmp_path, rocking).folder != data.Cache(tmp_path, FINE).folder


@pytest.mark.parametrize("seed", range(6))
def test_a_robot_keeps_its_speeds_and_turns_in_place(seed):
    twist = robot(seed, 60.0, (0.1, 3.0), (0.05, 1.2)).twist(np.arange(0.5, 59.5, 0.05))
    forward, yaw = twist[:, 2], twist[:, 4]
    assert np.abs(forward).max() <= 3.3
    assert np.abs(yaw).max() <= 1.3
    in_place = (np.abs(forward) < 0.02) & (np.abs(yaw) > 0.04)
    assert in_place.mean() > 0.05
    assert np.abs(np.cumsum(yaw) * 0.05).max() < 2 * MAX_HEADING


def test_rocking_adds_the_pitch_rate_that_is_asked_for():
    drive = driving(20_001, 20.0)
    twist, calm = (one.twist(np.arange(0.5, 19.5, 0.01)) for one in (rocked(drive, 1, 0.08, 20.0), drive))
    added = np.sqrt(np.mean(twist[:, 3] ** 2) - np.mean(calm[:, 3] ** 2))
    assert added == pytest.approx(0.08, rel=0.15)
    np.testing.assert_allclose(np.linalg.norm(twist[:, :3], axis=1), np.linalg.norm(calm[:, :3], axis=1), atol=0.05)


@pytest.mark.parametrize("index", range(4))
def test_the_same_seed_draws_the_same_robot_or_rocking_drive(index):
    wanted = DataConfig.model_validate(
        FINE.data.model_dump() | {"scenes": {"street": 1.0}, "robots": 0.5, "rocked": 0.5}
    )
    first, again = (data.draw_simulation(wanted, index) for _ in range(2))
    assert first.name == again.name
    at = np.linspace(0, 0.5, 20)
    assert np.array_equal(first.trajectory.twist(at), again.trajectory.twist(at))


@pytest.mark.parametrize("channels", [(4, 8), (7, 8)], ids=["as wide", "wider"])
def test_a_run_begins_from_a_smaller_model_and_computes_what_it_did(folder, channels):
    small = FINE.model.model_copy(
        update={
            "canonical": GRID.model_copy(update={"subcells": 1}),
            "network": NETWORK.model_copy(update={"history": ()}),
        }
    )
    wanted = FINE.model.model_copy(update={"network": NETWORK.model_copy(update={"channels": channels})})
    start = replace(bundle.untrained(4, small), linear_unit=PER_HEIGHT)
    run = TrainingRun.begin(FINE.model_copy(update={"model": wanted}), data.Cache(folder, FINE).open(), start=start)
    fine = np.zeros((6, 10, 16, 22), np.uint8)  # one event at most in a cell, in any of its quarters
    fine[:, :, ::2, 1::2] = np.random.default_rng(0).uniform(size=(6, 10, 8, 11)) < 0.3
    answers = [
        network.eval()(torch.from_numpy(network_input(fine, config)).float().log1p()[:, None], network.initial_state())
        for network, config in ((run.network, wanted), (start.network, small))
    ]
    torch.testing.assert_close(answers[0][0], answers[1][0])
    assert answers[0][0].std() > 0
    if channels != small.network.channels:  # in training, where norms see the batch, the new neurons fire
        network = run.network.train()
        _, state = network(
            torch.from_numpy(network_input(fine, wanted)).float().log1p()[:, None], network.initial_state()
        )
        assert (state.membranes[0].v[:, 4:] == 0).any()


def test_a_run_does_not_begin_from_a_wider_model(folder):
    other = FINE.model.model_copy(update={"network": NETWORK.model_copy(update={"channels": (5, 8)})})
    start = replace(bundle.untrained(4, other), linear_unit=PER_HEIGHT)
    with pytest.raises(BadModel, match=r"network.channels=\(5, 8\), the configuration has \(4, 8\)"):
        TrainingRun.begin(FINE, data.Cache(folder, FINE).open(), start=start)


def test_a_run_does_not_begin_from_another_history(folder):
    other = FINE.model.model_copy(update={"network": NETWORK.model_copy(update={"history": (4,)})})
    start = replace(bundle.untrained(4, other), linear_unit=PER_HEIGHT)
    with pytest.raises(BadModel, match=r"network.history=\(4,\), the configuration has \(1, 2\)"):
        TrainingRun.begin(FINE, data.Cache(folder, FINE).open(), start=start)
