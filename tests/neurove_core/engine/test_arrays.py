"""A network that was read from a file runs on arrays, and answers as torch does."""

from itertools import pairwise

import numpy as np
import pytest
import torch

from neurove_core.config import CanonicalConfig, ModelConfig, NetworkConfig
from neurove_core.engine.array_fast import FirstLayer, ListLayer, ListProjection
from neurove_core.engine.array_folding import convolutions, projection
from neurove_core.engine.array_runner import ArrayRunner
from neurove_core.engine.engine import Engine
from neurove_core.engine.runner import FastRunner
from neurove_core.models import bundle
from neurove_core.networks import encoding, quantisation, tables
from neurove_core.spiking.plain import plain

GRID = CanonicalConfig(width=33, height=21)
NETWORKS = {
    "float32": NetworkConfig(channels=(16, 32, 16), features=32, hidden=12, v_th=0.4),
    "binary": NetworkConfig(channels=(16, 32), features=16, hidden=12, v_th=0.4, encoding="binary", diffusion=False),
    "int8": NetworkConfig(channels=(16, 32, 16), features=32, hidden=12, v_th=0.4, precision="int8"),
    "int8, narrow": NetworkConfig(channels=(6, 20), features=20, hidden=12, v_th=0.4, precision="int8"),
}
NARROW = NetworkConfig(channels=(6, 20), features=20, hidden=12, v_th=0.4)


def runners(network):
    """The runner of a bundle's bytes, and that of the same network in torch."""
    made = bundle.untrained(3, ModelConfig(canonical=GRID, network=network))
    read = bundle.from_bytes(made.to_bytes(), "x")
    assert read.digest == made.digest
    return ArrayRunner(read.weights), FastRunner(made.network.requires_grad_(requires_grad=False))


def sums_in_our_order(network):
    """Whether torch's form runs over spike lists here: not where oneDNN adds in another order on this processor."""
    made = bundle.untrained(3, ModelConfig(canonical=GRID, network=network))
    return network.precision == "int8" or Engine(made.network).reads_counts


def windows(config, seed):
    """One window of each of three streams: calm, usual and saturated."""
    rng = np.random.default_rng(seed)
    return [rng.poisson(rate, config.input_shape).clip(0, 255).astype(np.uint8) for rate in (0.05, 0.5, 200)]


def answers(runner, config, count=8):
    """Twists of three streams over some windows."""
    states, found = [runner.initial_state() for _ in range(3)], []
    for at in range(count):
        done = runner.run(windows(config, 20_400 + at), states)
        states = [state for _, state in done]
        found.append([twists for twists, _ in done])
    return np.array(found)


@pytest.mark.parametrize("name", NETWORKS)
def test_arrays_answer_as_torch_does_bit_for_bit(name):
    ours, theirs = runners(NETWORKS[name])
    config = ModelConfig(canonical=GRID, network=NETWORKS[name])
    assert ours.is_compiled
    got, want = answers(ours, config), answers(theirs, config)
    assert (np.diff(want, axis=0) != 0).any()
    if name == "int8, narrow" or not sums_in_our_order(NETWORKS[name]):  # torch projects and runs the cells dense there
        np.testing.assert_allclose(got, want, rtol=0, atol=1e-5)
    else:
        assert np.array_equal(got, want)


def test_widths_that_are_filled_up_answer_as_the_dense_form_up_to_rounding():
    config = ModelConfig(canonical=GRID, network=NARROW)
    ours, theirs = runners(NARROW)
    np.testing.assert_allclose(answers(ours, config), answers(theirs, config), rtol=0, atol=1e-4)


@pytest.mark.parametrize("name", ["float32", "int8"])
def test_plain_numpy_answers_as_compiled_code_up_to_the_rounding_of_the_cells(name):
    config = ModelConfig(canonical=GRID, network=NETWORKS[name])
    ours, _ = runners(NETWORKS[name])
    want = answers(ours, config, 4)
    with plain():
        got = answers(ours, config, 4)
    np.testing.assert_allclose(got, want, rtol=0, atol=1e-5)


def test_several_streams_answer_as_each_alone_and_do_not_change_the_state_they_were_given():
    config = ModelConfig(canonical=GRID, network=NETWORKS["float32"])
    ours, _ = runners(NETWORKS["float32"])
    given = windows(config, 20_410)
    state = ours.run(given[1:2], [ours.initial_state()])[0][1]
    before = [part.copy() for part in (*state.membranes, state.cells, state.readout)]
    together = ours.run(given, [state] * 3)
    alone = [ours.run([one], [state])[0] for one in given]
    assert all(np.array_equal(one[0], other[0]) for one, other in zip(together, alone, strict=True))
    for (_, one), (_, other) in zip(together, alone, strict=True):
        assert all(np.array_equal(a, b) for a, b in zip(one.membranes, other.membranes, strict=True))
    after = (*state.membranes, state.cells, state.readout)
    assert all(np.array_equal(a, b) for a, b in zip(before, after, strict=True))


@pytest.mark.parametrize("name", ["float32", "int8"])
def test_a_form_that_is_loaded_equals_plain_numpy_and_a_wrong_one_does_not(name):
    network = NETWORKS[name]
    read = bundle.from_bytes(bundle.untrained(3, ModelConfig(canonical=GRID, network=network)).to_bytes(), "x")
    first, second, *_ = convolutions(read.weights)
    assert FirstLayer(first, network.encoding).agrees()
    later, projected = ListLayer(second), ListProjection(projection(read.weights))
    assert later.agrees()
    assert projected.agrees()
    second.offset[:] += 1  # the kernels read this memory at each call, and so does plain numpy
    assert later.agrees()
    second.weight[:] = second.weight[..., ::-1].copy()
    assert ListLayer(second).agrees()
    if name == "int8":  # the kernel has a copy of these weights
        assert not later.agrees()


def test_tables_and_roundings_are_those_of_torch():
    assert torch.equal(encoding.LOG1P, torch.log1p(torch.arange(256, dtype=torch.float32)))
    for name, table in (("log1p", encoding.LOG1P), ("binary", encoding.BINARY)):
        assert np.array_equal(tables.codes_of(name), quantisation.codes(table).numpy())
    weight = torch.randn(7, 5, 3, 3, generator=torch.Generator().manual_seed(20_420))
    weight[2] = 0
    want, got = quantisation.quantised(weight), tables.quantised(weight.numpy())
    assert np.array_equal(got.q, want.q.numpy())
    assert np.array_equal(got.step, want.step.numpy())
    logits = np.linspace(-6, 6, 101)
    found = [tables.sigmoid(one) for one in logits]
    np.testing.assert_allclose(found, torch.sigmoid(torch.tensor(logits)).numpy(), rtol=2e-7)
    assert all(one < other for one, other in pairwise(found))
