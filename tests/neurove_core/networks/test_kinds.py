"""The learned baselines have NeuroVE's interface: streaming, training and bundles work for each kind."""

import copy
from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import nn

from neurove_core import self_test
from neurove_core.config import CanonicalConfig, ModelConfig, NetworkConfig
from neurove_core.estimator import Estimator, Push
from neurove_core.evaluation.estimates import estimate_recording
from neurove_core.evaluation.evaluate import evaluate, report
from neurove_core.models import bundle
from neurove_core.models.bundle import PER_HEIGHT
from neurove_core.models.uncertainty import Uncertainty
from neurove_core.networks import kinds
from neurove_core.networks import state as carried
from neurove_core.networks.snn_ang import CHANNELS, OUTPUT_TAU_STEPS
from neurove_core.sources import open_source
from neurove_core.training import calibration, data
from neurove_core.training.config import DataConfig, RecipeConfig, TrainingConfig
from neurove_core.training.loop import train
from neurove_core.training.ranks import ALONE, share_norms
from neurove_protocol import Sensor
from neurove_protocol.errors import BadModel
from tests.builders import make_events

SOURCE = "sim://street?seed=4&seconds=1.2&camera=pinhole:24x18:75&height=2"
each_kind = pytest.mark.parametrize("kind", list(kinds.KINDS))
STEPS, BATCH = 5, 3


def config_of(kind: str, **network) -> ModelConfig:
    options = {"channels": (4, 8), "features": 12, "hidden": 10, **network}
    return ModelConfig(
        kind=kind, canonical=CanonicalConfig(width=22, height=16, hfov_deg=80), network=NetworkConfig(**options)
    )


def spikes_of(config: ModelConfig, batch: int = BATCH) -> torch.Tensor:
    shape = (STEPS, batch, 2 * config.window.bins, config.canonical.height, config.canonical.width)
    return torch.poisson(torch.full(shape, 0.4), generator=torch.Generator().manual_seed(1)).log1p()


@each_kind
@torch.no_grad()
def test_window_by_window_equals_the_whole_sequence_and_streams_are_independent(kind):
    config = config_of(kind)
    network, spikes = bundle.untrained(0, config).network.double(), spikes_of(config).double()
    whole, last = network(spikes, network.initial_state(BATCH))
    assert whole.shape == (STEPS, BATCH, 5, 6)
    state, single = network.initial_state(BATCH), []
    for window in spikes:
        twists, state = network(window[None], state)
        single.append(twists)
    torch.testing.assert_close(torch.cat(single), whole)
    for a, b in zip(carried.tensors_of(state), carried.tensors_of(last), strict=True):
        torch.testing.assert_close(a, b)
    alone, _ = network(spikes[:, 1:2], network.initial_state(1))
    torch.testing.assert_close(alone, whole[:, 1:2])


@each_kind
def test_every_parameter_has_a_gradient_and_a_detached_state_has_no_history(kind):
    config = config_of(kind, surrogate_width=4.0)
    network = bundle.untrained(0, config).network.train()
    twists, state = network(spikes_of(config), network.initial_state(BATCH))
    assert any(tensor.requires_grad for tensor in carried.tensors_of(state))
    assert not any(tensor.requires_grad for tensor in carried.tensors_of(carried.detached(state)))
    assert type(carried.detached(state)) is type(state)
    twists.square().sum().backward()
    for name, parameter in network.named_parameters():
        assert parameter.grad is not None, name
        assert parameter.grad.any(), name


@each_kind
def test_a_state_with_a_nan_is_detected(kind):
    state = kinds.make(config_of(kind)).initial_state(2)
    assert state.finite()
    for tensor in carried.tensors_of(state):
        tensor[(0,) * tensor.dim()] = float("nan")
        assert not state.finite()
        tensor[(0,) * tensor.dim()] = 0.0


@each_kind
def test_a_bundle_keeps_its_kind_and_serves(kind, tmp_path):
    made = bundle.untrained(2, config_of(kind), "one")
    path = tmp_path / "one.safetensors"
    bundle.save(made, path)
    loaded = bundle.load(path)
    assert (loaded.config.kind, type(loaded.network)) == (kind, type(made.network))
    estimator, recording = Estimator(replace(loaded, linear_unit=PER_HEIGHT)), open_source(SOURCE)
    estimator.warm_up()
    said = estimate_recording(estimator, recording)
    figures = report([evaluate(said, recording.twists())])
    assert np.isfinite(said.twists).all()
    assert (figures["firing_rate"] is None) == (kind == "ann")
    layers = {"neurove": {"block 1", "block 2", "cell 1", "cell 2"}, "snn-ang": {"block 1", "block 2"}, "ann": set()}
    assert set(figures["firing_rate_by_layer"]) == layers[kind]


def test_a_bundle_of_one_kind_does_not_load_as_another():
    data = bundle.untrained(2, config_of("ann")).to_bytes()
    for other in ("neurove", "snn-ang"):
        text = data.replace(b'\\"kind\\":\\"ann\\"', b'\\"kind\\":\\"' + other.encode() + b'\\"')
        header = int.from_bytes(data[:8], "little") + len(text) - len(data)
        with pytest.raises(BadModel, match="missing|not one of this architecture"):
            bundle.from_bytes(header.to_bytes(8, "little") + text[8:], "swapped")


def test_the_ann_has_the_size_of_neurove_within_a_tenth():
    sizes = {kind: sum(one.numel() for one in kinds.make(ModelConfig(kind=kind)).parameters()) for kind in kinds.KINDS}
    assert sizes["ann"] == pytest.approx(sizes["neurove"], rel=0.1)


@torch.no_grad()
def test_an_ann_has_memory_only_in_its_lstm_and_its_readout():
    config = config_of("ann")
    network, spikes = bundle.untrained(0, config).network, spikes_of(config, 1)
    _, state = network(spikes[:1], network.initial_state(1))
    forgotten = network.initial_state(1)._replace(h=state.h, c=state.c, readout=state.readout)
    assert torch.equal(network(spikes[1:], state)[0], network(spikes[1:], forgotten)[0])


@torch.no_grad()
def test_the_outputs_of_snn_ang_leak_and_never_fire():
    config = config_of("snn-ang")
    network = bundle.untrained(0, config).network
    network.readout.bias.zero_()
    for norm in network.norms:
        norm.bias.fill_(-9.0)  # no neuron fires
    state = network.initial_state(1)._replace(readout=torch.full((1, 30), 5.0))
    answers, _ = network(spikes_of(config, 1), state)
    leak = np.exp(-1 / OUTPUT_TAU_STEPS)
    torch.testing.assert_close(
        answers[:, 0, 0, 0], torch.tensor([5 * leak ** (k + 1) for k in range(STEPS)], dtype=torch.float32)
    )


def test_snn_ang_halves_its_image_four_times_and_no_more():
    network = kinds.make(config_of("snn-ang", channels=CHANNELS))
    sizes = [tuple(one.v.shape[1:]) for one in network.initial_state(1).membranes]
    assert sizes == [(16, 8, 11), (32, 4, 6), (64, 2, 3), (128, 1, 2), (256, 1, 2)]


@each_kind
def test_streams_answered_in_one_batch_equal_those_answered_alone(kind):
    estimator, sensor = Estimator(bundle.untrained(2, config_of(kind))), Sensor(22, 16)
    seen = [make_events(2_000, sensor=sensor, duration_us=120_000, seed=seed) for seed in range(3)]
    pushes = [Push(events, estimator.initial_state(sensor), 120_000) for events in seen]
    for push, together in zip(pushes, estimator.push_many(pushes), strict=True):
        for one, other in zip(estimator.push(*push).estimates, together.estimates, strict=True):
            np.testing.assert_allclose(other.twists, one.twists, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("kind", ["ann", "snn-ang"])
def test_a_baseline_in_int8_is_rejected(kind):
    with pytest.raises(ValueError, match=f"network.precision='int8': kind='{kind}' supports float32 only"):
        ModelConfig(kind=kind, network=NetworkConfig(precision="int8"))


@each_kind
@torch.no_grad()
def test_shared_norms_of_ranks_replace_the_norms_of_each_kind(kind):
    config = config_of(kind)
    own = bundle.untrained(0, config).network.train()
    shared = copy.deepcopy(own)
    share_norms(shared, ALONE)
    assert not any(isinstance(one, nn.BatchNorm1d | nn.BatchNorm2d) for one in shared.modules())
    answers = [network(spikes_of(config), network.initial_state(BATCH))[0] for network in (own, shared)]
    torch.testing.assert_close(*answers)
    assert shared.state_dict().keys() == own.state_dict().keys()


@pytest.mark.parametrize("kind", ["ann", "snn-ang"])
def test_a_baseline_has_no_uncertainty(kind, tmp_path):
    model = replace(bundle.untrained(0, config_of(kind)), linear_unit=PER_HEIGHT)
    with pytest.raises(BadModel, match=f"kind='{kind}': only a network of kind 'neurove'"):
        list(calibration.collect_errors(model, []))
    claimed = replace(model, uncertainty=Uncertainty(torch.eye(6), 0.5, "a test"))
    with pytest.raises(ValueError, match=f"kind='{kind}' has no uncertainty"):
        claimed.to_bytes()


@each_kind
def test_each_kind_trains_from_one_recipe_and_resumes_exactly(kind, tmp_path):
    config = TrainingConfig(
        name="tiny",
        model=config_of(kind),
        data=DataConfig(sequences=2, seconds=0.4, cameras={"pinhole:24x18": 1.0}),
        recipe=RecipeConfig(steps=4, batch=2, segment_windows=4, chunk_windows=2, checkpoint_s=0),
    )
    list(data.Cache(tmp_path, config).fill())

    class Stopped(Exception):
        pass

    def stop(progress):
        if progress.step == 2:
            raise Stopped

    whole = bundle.load(train(config, tmp_path / "whole", tmp_path))
    with pytest.raises(Stopped):
        train(config, tmp_path / "parts", tmp_path, on_progress=stop)
    parts = bundle.load(train(config, tmp_path / "parts", tmp_path, resume=True))
    self_test.check(Estimator(whole))
    np.testing.assert_array_equal(whole.golden.twists, parts.golden.twists)
    weights = parts.network.state_dict()
    assert all(torch.equal(tensor, weights[name]) for name, tensor in whole.network.state_dict().items())
