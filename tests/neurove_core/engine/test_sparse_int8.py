"""In 8-bit integers, sums over the neurons that fired equal the sums over all neurons, bit for bit."""

import logging

import numpy as np
import pytest
import torch

from neurove_core.config import CanonicalConfig, ModelConfig, NetworkConfig, WindowConfig
from neurove_core.engine import spike_lists
from neurove_core.engine.engine import Engine
from neurove_core.engine.fallback import forget_warnings
from neurove_core.engine.int8 import Int8Layer, Int8Projection, int8_convolution, plain_int8_convolution
from neurove_core.engine.sparse_int8 import (
    Int8DenseConvolution,
    Int8FirstConvolution,
    Int8ListConvolution,
    SparseInt8Layer,
    sparse_int8_extractor,
)
from neurove_core.models import bundle
from neurove_core.networks import quantisation
from neurove_core.spiking.lif import LIFParams, LIFState, lif_scan_reference
from neurove_core.spiking.plain import plain

DECAY, V_TH = 0.5, 0.7
LIF = LIFParams(DECAY, V_TH)
CONSTANTS = np.float32(DECAY), np.float32(V_TH)
SMALL = ModelConfig(
    window=WindowConfig(duration_us=12_000, bins=3),
    canonical=CanonicalConfig(width=19, height=14),
    network=NetworkConfig(channels=(16, 48, 32), features=80, hidden=11, v_th=0.4, precision="int8"),
)


def layer_of(inputs, outputs, rows, columns, top=1, *, q=None, seed=0):
    generator = torch.Generator().manual_seed(seed)
    if q is None:
        q = torch.randint(-127, 128, (outputs, inputs, 3, 3), generator=generator, dtype=torch.int8)
    factor, offset = torch.rand(2, outputs, generator=generator)
    factor = (factor + 0.1) / (100 * inputs**0.5 * top)
    return SparseInt8Layer(q, factor, offset - 0.5, int8_convolution(q, top, rows, columns), rows, columns)


def maps_of(count, channels, rows, columns, share, top=1, seed=0):
    drawn = torch.rand(2, count, rows, columns, channels, generator=torch.Generator().manual_seed(seed))
    return ((drawn[0] < share) * (1 + drawn[1] * top).clamp(max=top)).to(torch.uint8).permute(0, 3, 1, 2)


def expected_of(layer, maps, v, top=1):
    """Spikes and potentials by torch's public operators."""
    found = plain_int8_convolution(layer.q, top)(maps)
    currents = found * layer.factor.view(-1, 1, 1) + layer.offset.view(-1, 1, 1)
    spikes, after = lif_scan_reference(currents.view(-1, *v.shape), LIFState(v), LIF)
    return spikes.flatten(0, 1), after.v


def assert_fires_alike(found, expected):
    fired, after = found
    assert torch.equal(spike_lists.to_maps(fired), expected[0])
    assert torch.equal(torch.from_numpy(after.transpose(0, 3, 1, 2)), expected[1])


SIZES = [
    (1, 16, 1, 1),
    (5, 48, 4, 7),
    (20, 32, 9, 6),
    (16, 96, 2, 3),
    (64, 64, 9, 11),
    (130, 128, 7, 7),
    (64, 16, 21, 19),
]


@pytest.mark.parametrize("share", [0, 0.02, 0.15, 0.44, 0.6, 1])
@pytest.mark.parametrize(("inputs", "outputs", "rows", "columns"), SIZES)
@torch.inference_mode()
def test_a_layer_over_a_spike_list_fires_as_the_plain_one_bit_for_bit(inputs, outputs, rows, columns, share):
    """Short lists, and long ones, which are convolved dense."""
    layer = layer_of(inputs, outputs, rows, columns)
    for steps, batch in ((1, 1), (3, 1), (1, 3), (2, 2)):
        maps = maps_of(steps * batch, inputs, rows, columns, share, seed=steps)
        v = torch.rand(batch, outputs, (rows + 1) // 2, (columns + 1) // 2) - 0.3
        cells = np.ascontiguousarray(v.numpy().transpose(0, 2, 3, 1))
        expected = expected_of(layer, maps, v)
        over = Int8ListConvolution(layer)
        assert_fires_alike(over(spike_lists.to_list(maps), cells, *CONSTANTS), expected)
        assert_fires_alike(over.over_list(spike_lists.to_list(maps), cells, *CONSTANTS), expected)


@pytest.mark.parametrize("how", ["chosen for this machine", "dense"])
@pytest.mark.parametrize("share", [0, 0.15, 1])
@pytest.mark.parametrize(
    ("inputs", "outputs", "rows", "columns"),
    [*SIZES, (4, 80, 12, 11), (10, 16, 13, 26), (7, 32, 3, 16), (2, 16, 6, 49)],
)
@torch.inference_mode()
def test_the_first_layer_fires_as_the_plain_one_bit_for_bit(inputs, outputs, rows, columns, share, how):
    layer = layer_of(inputs, outputs, rows, columns, top=255)
    over = Int8DenseConvolution(layer) if how == "dense" else Int8FirstConvolution(layer)
    for steps, batch in ((1, 1), (3, 1), (1, 3), (2, 2)):
        maps = maps_of(steps * batch, inputs, rows, columns, share, top=255, seed=steps)
        v = torch.rand(batch, outputs, (rows + 1) // 2, (columns + 1) // 2) - 0.3
        cells = np.ascontiguousarray(v.numpy().transpose(0, 2, 3, 1))
        assert_fires_alike(over(maps.contiguous().numpy(), cells, *CONSTANTS), expected_of(layer, maps, v, top=255))


@pytest.mark.parametrize("sign", [-1, 1])
@pytest.mark.parametrize("inputs", [28, 29, 64, 200])
@torch.inference_mode()
def test_the_largest_sums_are_exact(inputs, sign):
    """All weights are maximal and all neurons fire: from 29 channels on the sums exceed 16 bits."""
    q = torch.full((16, inputs, 3, 3), sign * 127, dtype=torch.int8)
    v = np.zeros((2, 4, 3, 16), np.float32)
    for top, over in ((1, Int8ListConvolution), (255, Int8FirstConvolution)):
        if 9 * inputs * 127 * top >= 1 << 24:
            continue
        layer = layer_of(inputs, 16, 7, 5, top, q=q)
        maps = torch.full((2, inputs, 7, 5), top, dtype=torch.uint8)
        given = spike_lists.to_list(maps) if top == 1 else maps.numpy()
        assert_fires_alike(over(layer)(given, v, *CONSTANTS), expected_of(layer, maps, torch.zeros(2, 16, 4, 3), top))


@pytest.mark.parametrize("share", [0, 0.15, 1], ids=["no spike", "spikes", "all fire"])
@pytest.mark.parametrize("size", [(16, 1, 1), (256, 9, 11), (700, 1, 3), (1, 5, 7)])
@pytest.mark.parametrize("features", [13, 16, 80, 256])
def test_a_spike_list_is_projected_as_its_maps_are_bit_for_bit(features, size, share):
    """13 is no multiple of a vector: the list is converted to maps."""
    inputs = size[0] * size[1] * size[2]
    generator = torch.Generator().manual_seed(0)
    q = torch.randint(-127, 128, (features, inputs), generator=generator, dtype=torch.int8)
    step, factor, offset = torch.rand(3, features, generator=generator)
    projection = Int8Projection(Int8Layer(quantisation.Quantised(q, step), factor, offset))
    maps = maps_of(4, *size, share)
    rows = maps.permute(0, 2, 3, 1).flatten(1)
    found = projection(spike_lists.to_list(maps))
    assert torch.equal(found, projection(rows))
    with plain():
        assert torch.equal(found, projection(rows))


def test_the_largest_sums_of_a_projection_over_a_list_are_exact():
    q = torch.cat([torch.full((8, 132_105), 127), torch.full((8, 132_105), -127)]).to(torch.int8)
    projection = Int8Projection(Int8Layer(quantisation.Quantised(q, torch.ones(16)), torch.ones(16), torch.zeros(16)))
    maps = torch.ones(2, 132_105, 1, 1, dtype=torch.uint8)
    assert torch.equal(projection(spike_lists.to_list(maps)), projection(maps.flatten(1)))


def test_widths_that_are_no_multiple_of_a_vector_use_the_dense_layers():
    first = layer_of(4, 16, 5, 5, top=255)
    assert sparse_int8_extractor([first, layer_of(16, 24, 3, 3)], LIF) is None
    assert sparse_int8_extractor([first, layer_of(16, 32, 3, 3)], LIF) is not None


@pytest.mark.parametrize("what", ["sums differently", "raises"])
def test_where_the_dense_layer_differs_it_is_used_with_one_warning(what, caplog):
    first, layer = layer_of(4, 16, 5, 5, top=255), layer_of(16, 32, 3, 3)

    def different(x):
        if what == "raises":
            raise RuntimeError("no such primitive")
        return plain_int8_convolution(layer.q, 1)(x) + 1

    forget_warnings()
    caplog.clear()  # a machine without 8-bit products has warned about `first`
    with caplog.at_level(logging.WARNING):
        for _ in range(2):
            assert sparse_int8_extractor([first, layer._replace(dense=different)], LIF) is None
    assert len(caplog.records) == 1
    assert "form=8-bit convolutions over spike lists" in caplog.text


def network_of(seed=0):
    return bundle.untrained(seed, SMALL).network.requires_grad_(requires_grad=False)


@pytest.mark.parametrize("rate", [0.0, 0.05, 0.4, 40.0])
@pytest.mark.parametrize("batch", [1, 3])
@pytest.mark.parametrize("steps", [1, 4])
def test_whole_windows_of_few_and_of_many_spikes_fire_as_in_plain_steps_bit_for_bit(steps, batch, rate):
    engine = Engine(network_of())
    states = [network_of().initial_state(batch) for _ in range(2)]
    shape = (steps, batch, 6, 14, 19)
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
    spikes = torch.poisson(torch.full((1, 3, 6, 14, 19), 0.4), generator=torch.Generator().manual_seed(2)).log1p()
    for b, (twists, state) in enumerate(engine.together(spikes, starts)):
        expected, expected_state = engine(spikes[:, b : b + 1], starts[b])
        assert torch.equal(twists, expected)
        assert torch.equal(state.readout, expected_state.readout)
        for one, other in zip(state.membranes, expected_state.membranes, strict=True):
            assert torch.equal(one.v, other.v)


@pytest.mark.parametrize("wrong", ["height", "channels", "batch", "potentials"])
def test_maps_that_do_not_fit_the_network_are_refused(wrong):
    engine, start = Engine(network_of()), network_of().initial_state(2)
    shape = {"height": (1, 2, 6, 17, 19), "channels": (1, 2, 5, 14, 19), "batch": (1, 3, 6, 14, 19)}
    if wrong == "potentials":
        start = start._replace(membranes=(start.membranes[0], *start.membranes[:2]))
    with pytest.raises(ValueError, match="for each stream, potentials are"):
        engine(torch.ones(shape.get(wrong, (1, 2, 6, 14, 19))), start)
