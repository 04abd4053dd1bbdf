"""Training's convolution over the neurons that fired equals the dense one: currents bit for bit, and its gradients."""

import pytest
import torch
from torch import Tensor
from torch.nn.functional import conv2d

from neurove_core.config import CanonicalConfig, ModelConfig, NetworkConfig
from neurove_core.models import bundle
from neurove_core.spiking.fused import convolution
from neurove_core.spiking.plain import plain

SHAPES = [(2, 16, 5, 7, 16), (3, 32, 9, 8, 48), (6, 16, 2, 2, 32), (4, 64, 6, 11, 64)]  # R, C, H, W, C'


def maps_of(count: int, channels: int, rows: int, columns: int, rate: float, seed: int = 0) -> Tensor:
    drawn = torch.rand(count, channels, rows, columns, generator=torch.Generator().manual_seed(seed))
    return (drawn < rate).float().contiguous(memory_format=torch.channels_last)


def weight_of(outputs: int, channels: int) -> Tensor:
    return torch.randn(outputs, channels, 3, 3, generator=torch.Generator().manual_seed(1)).requires_grad_()


@pytest.fixture(autouse=True)
def _one_thread():
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


@pytest.mark.parametrize("rate", [0.0, 0.05, 0.2, 0.9])
@pytest.mark.parametrize("shape", SHAPES)
def test_currents_and_gradients_equal_those_of_the_dense_convolution(shape, rate):
    *size, outputs = shape
    spikes, weight = maps_of(*size, rate).requires_grad_(), weight_of(outputs, size[1])
    assert convolution.fits(spikes, weight)
    found, expected = convolution.convolve(spikes, weight), conv2d(spikes, weight, stride=2, padding=1)
    assert torch.equal(found, expected)
    pull = torch.randn(found.shape, generator=torch.Generator().manual_seed(2))
    for one, other in zip(
        torch.autograd.grad(found, [spikes, weight], pull),
        torch.autograd.grad(expected, [spikes, weight], pull),
        strict=True,
    ):
        assert one.shape == other.shape
        torch.testing.assert_close(one, other, rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("layout", [torch.contiguous_format, torch.channels_last])
def test_maps_and_gradients_of_any_layout_are_accepted(layout):
    spikes, weight = maps_of(2, 16, 5, 7, 0.1), weight_of(32, 16)
    pull = torch.randn(2, 32, 3, 4, generator=torch.Generator().manual_seed(2)).contiguous(memory_format=layout)
    grads = []
    for currents in (
        convolution.convolve(spikes.contiguous(memory_format=layout), weight),
        conv2d(spikes, weight, stride=2, padding=1),
    ):
        grads += torch.autograd.grad(currents, weight, pull)
    torch.testing.assert_close(grads[0], grads[1], rtol=1e-4, atol=1e-4)


def test_narrow_maps_a_single_map_frozen_weights_and_autocast_use_the_dense_convolution():
    spikes = maps_of(2, 16, 5, 7, 0.1)
    assert convolution.fits(spikes, weight_of(16, 16))
    assert not convolution.fits(spikes, weight_of(8, 16))
    assert not convolution.fits(maps_of(1, 16, 5, 7, 0.1), weight_of(16, 16))
    assert not convolution.fits(spikes, weight_of(16, 16).detach())
    assert not convolution.fits(spikes.double(), weight_of(16, 16).double())
    with torch.no_grad():
        assert not convolution.fits(spikes, weight_of(16, 16))
    with torch.autocast("cpu", torch.bfloat16):
        assert not convolution.fits(spikes, weight_of(16, 16))


@pytest.mark.parametrize("precision", ["float32", "int8"])
def test_a_training_step_of_a_network_equals_the_plain_one(precision):
    network = NetworkConfig(channels=(16, 32, 48), features=16, hidden=32, precision=precision)
    config = ModelConfig(canonical=CanonicalConfig(width=40, height=32), network=network)
    trained = bundle.untrained(3, config).network.train().requires_grad_()
    shape = (5, 3, *config.input_shape)
    given = torch.poisson(torch.full(shape, 0.3), generator=torch.Generator().manual_seed(4)).log1p()

    def step() -> tuple[Tensor, list[Tensor]]:
        twists, _ = trained(given, trained.initial_state(3))
        return twists, list(torch.autograd.grad((twists - 0.5).square().mean(), [*trained.parameters()]))

    twists, grads = step()
    with plain():
        expected, expected_grads = step()
    assert torch.equal(twists, expected)  # so every spike is the same
    for one, other in zip(grads, expected_grads, strict=True):
        torch.testing.assert_close(one, other, rtol=1e-3, atol=1e-5 * float(other.abs().max()))
