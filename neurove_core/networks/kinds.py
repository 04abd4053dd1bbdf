"""The kinds of networks, by the `kind` of a model's configuration: NeuroVE and its learned baselines.

All have the same interface, so that training, evaluation and the estimator work with any of them:

    network.initial_state(batch) -> state            tensors in named tuples, see state.py
    network(spikes, state) -> (twists, state)        (T, B, C, H, W) -> (T, B, n, 6), in scaled units

The paper's variant w/o diffusion is a NeuroVE with `network.diffusion = false`.
"""

from collections.abc import Callable
from typing import Final

from torch import Tensor

from neurove_core.config import ModelConfig
from neurove_core.networks.ann import Ann, AnnState
from neurove_core.networks.neurove import NetworkState, NeuroVE
from neurove_core.networks.snn_ang import SnnAng, SnnAngState

Network = NeuroVE | Ann | SnnAng
State = NetworkState | AnnState | SnnAngState

KINDS: Final[dict[str, Callable[[ModelConfig], Network]]] = {"neurove": NeuroVE, "ann": Ann, "snn-ang": SnnAng}
"""The class of each kind."""


def make(config: ModelConfig) -> Network:
    """A new network for a configuration, with random weights."""
    return KINDS[config.kind](config)


def fired(state: State) -> dict[str, Tensor]:
    """Which neurons fired in the last step, by layer; empty for a network without spikes.

    It is derived from the state: the membrane of a neuron of the feature extractor that has just fired is exactly 0.
    """
    membranes = () if isinstance(state, AnnState) else state.membranes
    cells = state.cells if isinstance(state, NetworkState) else ()
    layers = {f"block {number}": one.v == 0 for number, one in enumerate(membranes, 1)}
    return layers | {f"cell {number}": one.s > 0 for number, one in enumerate(cells, 1)}
