"""Sums over the neurons that fired equal the sums over all neurons, bit for bit."""

import logging

import numpy as np
import pytest
import torch

from neurove_core.config import CanonicalConfig, ModelConfig, NetworkConfig, WindowConfig
from neurove_core.engine import convolution, spike_lists
from neurove_core.engine.encoding import to_count_input
from neurove_core.engine.engine import Engine
from neurove_core.engine.fallback import forget_warnings
from neurove_core.engine.sparse import ListConvolution, SparseLayer, sparse_extractor
from neurove_core.models import bundle
from neurove_core.networks.encoding import to_spikes
from neurove_core.spiking.fused import scan
from neurove_core.spiking.lif import LIFParams, LIFState
from neurove_core.spiking.plain import plain

DECAY, V_TH = 0.5, 0.7
LIF = LIFParams(DECAY, V_TH)
SMALL = ModelConfig(
    window=WindowConfig(duration_us=10_000, bins=2),
    canonical=CanonicalConfig(width=19, height=14),
    network=NetworkConfig(channels=(16, 48, 32), features=80, hidden=11, v_th=0.4),
)


def spikes_of(count, channels, rows, columns, share, seed=0):
    drawn = torch.rand(count, rows, columns, channels, generator=torch.Generator().manual_seed(seed))
    return (drawn < share).float().permute(0, 3, 1, 2)


def layer_of(inputs, outputs, rows, columns, seed=0):
    generator = torch.Generator().manual_seed(seed)
    weight = torch.randn(outputs, inputs, 3, 3, generator=generator) / (3 * inputs**0.5)
    bias = torch.randn(outputs, generator=generator) / 4
    return SparseLayer(weight, bias, convolution.convolution(weight, bias, rows, columns), rows, columns)


def fire_over(layer, spikes, v):
    """Spikes and potentials of a layer over a list."""
    cells = np.ascontiguousarray(v.numpy().transpose(0, 2, 3, 1))
    fired, after = ListConvolution(layer)(spike_lists.to_list(spikes), cells, np.float32(DECAY), np.float32(V_TH))
    return spike_lists.to_maps(fired), torch.from_numpy(after.transpose(0, 3, 1, 2))


@pytest.mark.parametrize("share", [0, 0.02, 0.15, 0.39, 0.6, 1])
@pytest.mark.parametrize(
    ("inputs", "outputs", "rows", "columns"),
    [
        (1, 16, 1, 1),
        (5, 48, 4, 7),
        (20, 32, 9, 6),
        (16, 96, 2, 3),
        (64, 64, 9, 11),
        (32, 256, 5, 8),
        (130, 128, 7, 7),
        (64, 16, 21, 19),
    ],
)
@torch.inference_mode()
def test_a_layer_over_a_spike_list_fires_as_the_dense_one_bit_for_bit(inputs, outputs, rows, columns, share):
    """Short lists, and long ones, which are convolved dense."""
    layer = layer_of(inputs, outputs, rows, columns)
    size = (outputs, (rows + 1) // 2, (columns + 1) // 2)
    for steps, batch in ((1, 1), (3, 1), (1, 3), (2, 2)):
        spikes = spikes_of(steps * batch, inputs, rows, columns, share, seed=steps)
        v = torch.rand(batch, *size).contiguous(memory_format=torch.channels_last) - 0.3
        fired, after = fire_over(layer, spikes, v)
        expected, expected_after = scan.scan_in_place(layer.dense(spikes), v, DECAY, V_TH)
        assert torch.equal(fired, expected)
        assert torch.equal(after, expected_after)


@pytest.mark.parametrize("share", [0, 0.15, 1])
def test_a_spike_list_and_its_maps_convert_into_each_other(share):
    maps = spikes_of(3, 5, 4, 7, share)
    fired = spike_lists.to_list(maps)
    assert torch.equal(spike_lists.to_maps(fired), maps)
    assert fired.total == int(maps.sum())
    assert fired.starts.size == 3 * 4 * 7 + 1


@pytest.mark.parametrize("share", [0, 0.15, 1], ids=["no spike", "spikes", "all fire"])
@pytest.mark.parametrize("size", [(16, 1, 1), (256, 9, 11), (700, 1, 3), (1, 5, 7)])
@pytest.mark.parametrize("features", [16, 80, 256])
def test_the_projection_of_a_map_is_summed_in_the_order_of_its_neurons_in_any_batch(features, size, share):
    channels, rows, columns = size
    generator = torch.Generator().manual_seed(1)
    weight, bias = torch.randn(features, channels * rows * columns, generator=generator), torch.randn(features)
    extractor = sparse_extractor([layer_of(4, 16, 5, 5)], (weight, bias), LIF)
    assert extractor is not None
    maps = spikes_of(4, *size, share)
    found = torch.from_numpy(extractor.project(spike_lists.to_list(maps)))
    assert found.shape == (4, features)
    for index in range(4):
        alone = torch.from_numpy(extractor.project(spike_lists.to_list(maps[index : index + 1])))
        assert torch.equal(alone, found[index : index + 1])
        expected = bias.clone()
        for place in maps[index].permute(1, 2, 0).flatten().nonzero():
            expected += weight[:, int(place)]
        assert torch.equal(found[index], expected)


def test_widths_that_are_no_multiple_of_a_vector_use_the_dense_layers():
    layers, wide = [layer_of(4, 16, 5, 5), layer_of(16, 24, 3, 3)], (torch.zeros(32, 24 * 2 * 2), torch.zeros(32))
    assert sparse_extractor(layers, wide, LIF) is None
    layers[1] = layer_of(16, 32, 3, 3)
    assert sparse_extractor(layers, (torch.zeros(13, 32 * 2 * 2), torch.zeros(13)), LIF) is None
    assert sparse_extractor(layers, (torch.zeros(32, 32 * 2 * 2), torch.zeros(32)), LIF) is not None


@pytest.mark.parametrize("what", ["rounds differently", "is not finite", "raises"])
def test_where_the_dense_layer_differs_it_is_used_with_one_warning(what, caplog):
    first, layer = layer_of(4, 16, 5, 5), layer_of(16, 32, 3, 3)
    if what == "is not finite":
        layer.weight[3, 4, 1, 1] = float("nan")
    weight, bias = layer.weight, layer.bias

    def reordered(x):
        if what == "raises":
            raise RuntimeError("no such primitive")
        return convolution.plain_convolution(weight.flip(1), bias)(x.flip(1))

    forget_warnings()
    with caplog.at_level(logging.WARNING):
        for _ in range(2):
            layers = [first, layer._replace(dense=reordered)]
            assert sparse_extractor(layers, (torch.zeros(16, 128), torch.zeros(16)), LIF) is None
    assert len(caplog.records) == 1
    assert "form=convolutions over spike lists" in caplog.text


def network_of(seed=0):
    return bundle.untrained(seed, SMALL).network.requires_grad_(requires_grad=False)


@pytest.mark.parametrize("rate", [0.0, 0.05, 0.4, 40.0])
@pytest.mark.parametrize("batch", [1, 3])
@pytest.mark.parametrize("steps", [1, 4])
def test_whole_windows_of_few_and_of_many_spikes_fire_as_in_plain_steps_bit_for_bit(steps, batch, rate):
    engine = Engine(network_of())
    states = [network_of().initial_state(batch) for _ in range(2)]
    shape = (steps, batch, 4, 14, 19)
    for seed in range(3):
        spikes = torch.poisson(torch.full(shape, rate), generator=torch.Generator().manual_seed(seed)).log1p()
        fired, _ = engine.features(spikes, states[0])
        twists, states[0] = engine(spikes, states[0])
        with plain():
            expected, _ = engine.features(spikes, states[1])
            expected_twists, states[1] = engine(spikes, states[1])
        assert torch.equal(fired, expected)
        torch.testing.assert_close(twists, expected_twists, rtol=1e-4, atol=1e-5)
        for one, other in zip(states[0].membranes, states[1].membranes, strict=True):
            assert torch.equal(one.v, other.v)
        for cell, other_cell in zip(states[0].cells, states[1].cells, strict=True):
            assert torch.equal(cell.s, other_cell.s)


def test_streams_in_one_batch_answer_as_each_alone_bit_for_bit():
    engine, starts = Engine(network_of()), [network_of().initial_state(1) for _ in range(3)]
    spikes = torch.poisson(torch.full((1, 3, 4, 14, 19), 0.4), generator=torch.Generator().manual_seed(2)).log1p()
    for b, (twists, state) in enumerate(engine.together(spikes, starts)):
        expected, expected_state = engine(spikes[:, b : b + 1], starts[b])
        assert torch.equal(twists, expected)
        assert torch.equal(state.readout, expected_state.readout)
        for one, other in zip(state.membranes, expected_state.membranes, strict=True):
            assert torch.equal(one.v, other.v)


@pytest.mark.parametrize("wrong", ["height", "channels", "batch", "potentials", "type"])
def test_maps_that_do_not_fit_the_network_are_refused(wrong):
    engine, start = Engine(network_of()), network_of().initial_state(2)
    shape = {"height": (1, 2, 4, 17, 19), "channels": (1, 2, 5, 14, 19), "batch": (1, 3, 4, 14, 19)}
    if wrong == "potentials":
        start = start._replace(membranes=(start.membranes[0], *start.membranes[:2]))
    if wrong == "type":
        start = start._replace(membranes=tuple(LIFState(m.v.double()) for m in start.membranes))
    with pytest.raises(ValueError, match="for each stream, potentials are"):
        engine(torch.ones(shape.get(wrong, (1, 2, 4, 14, 19))), start)


def test_a_number_that_is_not_finite_stays_in_the_state_so_that_a_check_finds_it():
    spikes = torch.ones(2, 1, 4, 14, 19)
    spikes[0, 0, 0, 0, 0] = float("nan")
    assert not Engine(network_of())(spikes, network_of().initial_state(1))[1].finite()


def test_a_call_changes_neither_the_state_it_receives_nor_the_input():
    engine, spikes = Engine(network_of()), torch.ones(3, 2, 4, 14, 19)
    _, given = engine(spikes, network_of().initial_state(2))
    before = [given.readout.clone(), *(membrane.v.clone() for membrane in given.membranes), spikes.clone()]
    once, again = engine(spikes, given)[0], engine(spikes, given)[0]
    assert torch.equal(once, again)
    after = [given.readout, *(membrane.v for membrane in given.membranes), spikes]
    assert all(torch.equal(one, other) for one, other in zip(before, after, strict=True))


@pytest.mark.parametrize("rate", [0.0, 0.4, 40.0, 300.0])
@pytest.mark.parametrize("size", [(9, 8), (14, 19), (12, 16), (11, 47)])
@pytest.mark.parametrize("name", ["log1p", "binary"])
def test_counts_give_the_same_answers_as_their_spikes_bit_for_bit(name, size, rate):
    """Single windows and several at once, single streams and batches; rows shorter and longer than a vector."""
    network = SMALL.network.model_copy(update={"encoding": name})
    grid = CanonicalConfig(height=size[0], width=size[1])
    config = SMALL.model_copy(update={"network": network, "canonical": grid})
    network = bundle.untrained(0, config).network.requires_grad_(requires_grad=False)
    engine, states = Engine(network), [network.initial_state(2) for _ in range(2)]
    assert engine.reads_counts
    for steps in (1, 3, 1):
        drawn = torch.poisson(torch.full((steps, 2, 4, *size), rate), generator=torch.Generator().manual_seed(steps))
        counts = drawn.clamp(max=255).to(torch.uint8)
        found, states[0] = engine(to_count_input(counts, name), states[0])
        expected, states[1] = engine(to_spikes(counts, name), states[1])
        assert torch.equal(found, expected)
        for one, other in zip(states[0].membranes, states[1].membranes, strict=True):
            assert torch.equal(one.v, other.v)
    starts = [network.initial_state(1) for _ in range(2)]
    for b, (twists, _) in enumerate(engine.together(to_count_input(counts, name), starts)):
        assert torch.equal(twists, engine(to_spikes(counts[:, b : b + 1], name), starts[b])[0])
    with plain():
        plainly = [engine(give(counts, name), states[0])[0] for give in (to_count_input, to_spikes)]
    assert torch.equal(*plainly)
