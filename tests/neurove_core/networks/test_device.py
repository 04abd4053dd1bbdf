"""The network on a chosen device, many streams in one batch; on the CPU, and for what a CPU can show of a GPU."""

import numpy as np
import pytest
import torch

from neurove_core.config import CanonicalConfig, ModelConfig, NetworkConfig
from neurove_core.engine.array_runner import ArrayRunner
from neurove_core.models import bundle
from neurove_core.networks.device import TOLERANCE, DeviceRunner, device_of, difference
from neurove_core.networks.runner import PlainRunner
from neurove_core.spiking.plain import plain
from neurove_protocol.errors import InvalidField

STREAMS, WINDOWS = 5, 6
KINDS = [("neurove", "float32"), ("neurove", "int8"), ("ann", "float32"), ("snn-ang", "float32")]
CPU = torch.device("cpu")


def model(kind, precision="float32"):
    network = NetworkConfig(channels=(8, 16), features=16, hidden=16, v_th=0.4, precision=precision)
    config = ModelConfig(kind=kind, canonical=CanonicalConfig(width=22, height=16), network=network)
    return bundle.untrained(20_010, config)


def windows_of(config):
    """Counts (T, B, C, H, W)."""
    rng = np.random.default_rng(20_011)
    return rng.poisson(0.5, (WINDOWS, STREAMS, *config.input_shape)).astype(np.uint8)


def answers(runner, windows, at_once):
    """Twists (B, T, n, 6) of all streams and their states, in batches of so many streams."""
    states, found = [runner.initial_state() for _ in range(STREAMS)], []
    for counts in windows:
        steps = []
        for first in range(0, STREAMS, at_once):
            steps += runner.run(list(counts[first : first + at_once]), states[first : first + at_once])
        states = [state for _, state in steps]
        found.append([twists for twists, _ in steps])
    return np.stack(found, 1), states


@pytest.mark.parametrize(("kind", "precision"), KINDS)
@pytest.mark.parametrize("compiled", [True, False])  # a GPU has no compiled scan
def test_a_batch_on_the_device_answers_as_the_network_does_stream_by_stream(kind, precision, compiled):
    made = model(kind, precision)
    windows = windows_of(made.config)
    wanted, _ = answers(PlainRunner(made.network.eval()), windows, 1)
    runner = DeviceRunner(made.network, CPU)
    if compiled:
        found, states = answers(runner, windows, STREAMS)
    else:
        with plain():
            found, states = answers(runner, windows, STREAMS)
    assert np.abs(wanted).max() > 0
    assert difference(found, wanted) < 1e-5
    assert difference(answers(runner, windows, 2)[0], wanted) < 1e-5  # streams that come and go
    assert all(state.finite() for state in states)
    assert not np.allclose(found[0], found[1])  # each stream has its own state and input


def test_the_spread_of_a_batch_is_that_of_the_engine():
    made = model("neurove")
    network = made.network
    network.add_spread()
    with torch.no_grad():
        network.spread.weight.normal_(0, 0.3, generator=torch.Generator().manual_seed(20_012))
    windows = windows_of(made.config)
    engine = ArrayRunner(bundle.untrained(20_010, made.config).current_weights)
    runner = DeviceRunner(network, CPU)
    found, states = answers(runner, windows, STREAMS)
    assert difference(found, answers(engine, windows, STREAMS)[0]) < TOLERANCE
    plainly = PlainRunner(network.eval())
    _, wanted = answers(plainly, windows, 1)
    for one, other in zip(states, wanted, strict=True):
        assert np.abs(plainly.log_sigma(other)).max() > 0
        np.testing.assert_allclose(runner.log_sigma(one), plainly.log_sigma(other), rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize(("kind", "precision"), KINDS)
def test_no_tensor_stays_on_the_cpu(kind, precision):
    """The device `meta` has no values, so that only the answers cannot be read; it refuses tensors of the CPU."""
    made = model(kind, precision)
    runner = DeviceRunner(made.network, torch.device("meta"))
    states = [runner.initial_state() for _ in range(STREAMS)]
    with pytest.raises(NotImplementedError, match="Cannot copy out of meta tensor"):
        runner.run(list(windows_of(made.config)[0]), states)
    runner = DeviceRunner(made.network, torch.device("meta"))
    with pytest.raises(RuntimeError, match="device"):
        runner.run(list(windows_of(made.config)[0]), [DeviceRunner(made.network, CPU).initial_state()] * STREAMS)


def test_later_changes_of_a_network_do_not_change_its_copy_on_the_device():
    made = model("neurove")
    runner, windows = DeviceRunner(made.network, CPU), windows_of(made.config)
    before, _ = answers(runner, windows, STREAMS)
    with torch.no_grad():
        for parameter in made.network.parameters():
            parameter.zero_()
    np.testing.assert_array_equal(answers(runner, windows, STREAMS)[0], before)


@pytest.mark.parametrize("name", ["tpu", "cuda:", "cuda:x", "cuda:-1", "CPU", ""])
def test_an_unknown_device_is_named(name):
    with pytest.raises(InvalidField, match=f"--device={name!r}: cpu, cuda or cuda:N is expected"):
        device_of(name, "evaluate")


def test_a_gpu_that_is_missing_is_named():
    assert device_of("cpu", "evaluate") == CPU
    count = torch.cuda.device_count() if torch.cuda.is_available() else 0
    name = f"cuda:{count}"
    with pytest.raises(InvalidField, match=f"--device='{name}': (torch sees|this build of torch has no CUDA)"):
        device_of(name, "evaluate")


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="torch sees no GPU")
@pytest.mark.parametrize(("kind", "precision"), KINDS)
def test_a_gpu_answers_as_the_cpu(kind, precision):
    made = model(kind, precision)
    windows = windows_of(made.config)
    found, _ = answers(DeviceRunner(made.network, device_of("cuda", "test")), windows, STREAMS)
    assert difference(found, answers(DeviceRunner(made.network, CPU), windows, STREAMS)[0]) < TOLERANCE
