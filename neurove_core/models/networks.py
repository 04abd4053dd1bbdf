"""Networks of bundles as torch modules: made from stored weights, stored as arrays, and with random weights."""

from collections.abc import Mapping
from typing import Any

import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from neurove_core.config import ModelConfig
from neurove_core.networks import kinds
from neurove_core.networks.arrays import Weights
from neurove_core.networks.kinds import Network
from neurove_core.networks.neurove import NeuroVE

VERSION = str(torch.__version__)
"""The version of torch, on which random weights depend."""


def network_of(weights: Weights) -> Network:
    """The network with these weights, which are copied, in evaluation mode."""
    network = _made(weights.config, spread=weights.spread)
    tensors = {name: torch.from_numpy(array) for name, array in weights.tensors.items()}
    network.load_state_dict(tensors, strict=False)  # names are checked; only the norms' batch counters are not stored
    return network.eval()


def shapes(config: ModelConfig, *, spread: bool) -> dict[str, tuple[int, ...]]:
    """Names and shapes of the stored tensors of any kind of network; no memory is used for them."""
    with torch.device("meta"):  # a small header may declare terabytes of weights
        return {name: tuple(tensor.shape) for name, tensor in _stored(_made(config, spread=spread)).items()}


def arrays_of(network: Network) -> Mapping[str, NDArray[Any]]:
    """The stored tensors of a network, as views of its memory."""
    return {name: tensor.detach().cpu().contiguous().numpy() for name, tensor in _stored(network).items()}


def bytes_of(network: Network) -> int:
    """Size of all tensors of a network [bytes], without reading them."""
    return sum(tensor.numel() * tensor.element_size() for tensor in network.state_dict().values())


def parameters_of(network: Network) -> int:
    """Number of learned values of a network."""
    return sum(parameter.numel() for parameter in network.parameters())


def with_random_weights(seed: int, config: ModelConfig) -> Network:
    """A network with random weights, and norms that have the statistics of random input, so that neurons fire."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        network = kinds.make(config)
        shape = (8, 4, *config.input_shape)
        _take_statistics(network, torch.poisson(torch.full(shape, 0.3)).log1p())
    return network.eval()


def _made(config: ModelConfig, *, spread: bool) -> Network:
    network = kinds.make(config)
    if spread and isinstance(network, NeuroVE):
        network.add_spread()
    return network


def _stored(network: Network) -> dict[str, Tensor]:
    return {name: one for name, one in network.state_dict().items() if not name.endswith("num_batches_tracked")}


def _take_statistics(network: Network, spikes: Tensor) -> None:
    momenta = {
        layer: layer.momentum for layer in network.modules() if isinstance(layer, nn.BatchNorm1d | nn.BatchNorm2d)
    }
    for norm in momenta:
        norm.momentum = 1.0  # with less, few batches hardly move the running mean, and nothing fires
    with torch.no_grad():
        network.train()(spikes, network.initial_state(spikes.shape[1]))
    for norm, momentum in momenta.items():
        norm.momentum = momentum
