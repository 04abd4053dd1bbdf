"""The peers' neurons in our network: the same weights and input, with their LIF layers as their users run them.

The extra `bench` installs the peers, except those whose requirements would install another torch:
`pip install --no-deps spikingjelly norse nir nirtorch sinabs pbr`. Peers that are not installed are named and skipped.
"""

import copy
import importlib
import math
import warnings
from collections.abc import Callable
from typing import Any, Final

import torch
from torch import Tensor, nn

from neurove_core.networks.neurove import NeuroVE, SpikingBlock
from neurove_core.spiking.lif import LIFState

Missing = list[str]
"""Names of peers that could not be loaded, each with the reason."""


def load(name: str, missing: Missing) -> Any | None:
    """Import a peer's module. If that fails, return None and add a line to `missing`."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # deprecations in a peer are not our concern
            return importlib.import_module(name)
    except ImportError as error:
        missing.append(f"{name.partition('.')[0]} ({error})")
        return None


def networks(network: NeuroVE, missing: Missing) -> dict[str, NeuroVE]:
    """Our network with each peer's neurons, by the name of the peer; run them inside `spiking.plain.plain()`."""
    made = {
        "spikingjelly": _with_neurons(network, _spikingjelly(missing), stepwise=False),
        "snnTorch": _with_neurons(network, _snntorch(missing), stepwise=True),
        "norse": _with_neurons(network, _norse(missing), stepwise=True),
        "sinabs": _with_neurons(network, _sinabs(missing), stepwise=False),
    }
    return {name: peer for name, peer in made.items() if peer is not None}


DIFFERENT_BY_DESIGN: Final = ("snnTorch", "norse")
"""Peers with other results by design: snnTorch resets one step later, norse rounds its potential in another place."""

ROUNDED_OTHERWISE: Final = {"sinabs": 0.01}
"""Peers whose loss in training may deviate from ours by so much of it: the spikes of sinabs are not channels last in
memory, so torch sums the statistics of the next norm in another order, and a few of a million spikes differ."""

Neurons = Callable[[SpikingBlock], tuple[Callable[[Tensor], Tensor], Callable[[], None]]]
"""For one block: a function from currents to spikes, and one that resets its state."""


class PeerBlock(nn.Module):
    """A block of our network with a peer's neurons, which start each sequence from the zero state.

    Args:
        block: our block; its weights are shared.
        neurons: make the peer's neurons.
        stepwise: whether the peer's users loop over time steps or pass all steps at once.
    """

    def __init__(self, block: SpikingBlock, neurons: Neurons, *, stepwise: bool) -> None:
        super().__init__()
        self.conv, self.norm = block.conv, block.norm
        self._fire, self._reset = neurons(block)
        self._stepwise = stepwise

    def forward(self, spikes: Tensor, state: LIFState) -> tuple[Tensor, LIFState]:
        """As SpikingBlock.forward, but the state is returned unchanged."""
        self._reset()
        if self._stepwise:
            return torch.stack([self._fire(self.norm(self.conv(x))) for x in spikes]), state
        current: Tensor = self.norm(self.conv(spikes.flatten(0, 1)))
        return self._fire(current.view(*spikes.shape[:2], *current.shape[1:])), state


def features(network: NeuroVE, spikes: Tensor) -> Tensor:
    """Spikes (T * B, C, H', W') of the last feature map of a network, from the zero state."""
    state = network.initial_state(spikes.shape[1])
    for block, membrane in zip(network.blocks, state.membranes, strict=True):
        spikes, _ = block(spikes, membrane)
    return spikes.flatten(0, 1)


def _with_neurons(network: NeuroVE, neurons: Neurons | None, *, stepwise: bool) -> NeuroVE | None:
    if neurons is None:
        return None
    peer = copy.deepcopy(network)
    blocks = [block for block in peer.blocks if isinstance(block, SpikingBlock)]
    peer.blocks = nn.ModuleList(PeerBlock(block, neurons, stepwise=stepwise) for block in blocks)
    return peer


def _spikingjelly(missing: Missing) -> Neurons | None:
    module = load("spikingjelly.activation_based.neuron", missing)
    if module is None:
        return None
    surrogates = importlib.import_module("spikingjelly.activation_based.surrogate")

    def neurons(block: SpikingBlock) -> tuple[Callable[[Tensor], Tensor], Callable[[], None]]:
        node = module.LIFNode(
            tau=1 / (1 - block.lif.decay),
            decay_input=False,
            v_threshold=block.lif.v_th,
            v_reset=0.0,
            surrogate_function=surrogates.Rect(alpha=1 / block.lif.surrogate_width),
            detach_reset=True,
            step_mode="m",
        )
        return node, node.reset

    return neurons


def _snntorch(missing: Missing) -> Neurons | None:
    module = load("snntorch", missing)
    if module is None:
        return None

    def neurons(block: SpikingBlock) -> tuple[Callable[[Tensor], Tensor], Callable[[], None]]:
        leaky = module.Leaky(beta=block.lif.decay, threshold=block.lif.v_th, reset_mechanism="zero", init_hidden=True)
        return leaky, leaky.reset_mem

    return neurons


def _norse(missing: Missing) -> Neurons | None:
    module = load("norse.torch", missing)
    if module is None:
        return None

    def neurons(block: SpikingBlock) -> tuple[Callable[[Tensor], Tensor], Callable[[], None]]:
        share = 1 - block.lif.decay
        with torch.no_grad():  # v + share (i - v): the norm before it compensates for the factor on the current
            block.norm.weight.div_(share)
            block.norm.bias.div_(share)
        params = module.LIFBoxParameters(tau_mem_inv=torch.tensor(share), v_th=torch.tensor(block.lif.v_th))
        cell = module.LIFBoxCell(params, dt=1.0)
        state: list[Any] = []

        def fire(current: Tensor) -> Tensor:
            spikes: Tensor
            spikes, after = cell(current, *state)
            state[:] = [after]
            return spikes

        return fire, state.clear

    return neurons


def _sinabs(missing: Missing) -> Neurons | None:
    module = load("sinabs.layers", missing)
    if module is None:
        return None
    activation = importlib.import_module("sinabs.activation")

    def neurons(block: SpikingBlock) -> tuple[Callable[[Tensor], Tensor], Callable[[], None]]:
        layer = module.LIF(
            tau_mem=-1 / math.log(block.lif.decay),
            spike_threshold=torch.tensor(block.lif.v_th),
            spike_fn=activation.SingleSpike,
            reset_fn=activation.MembraneReset(),
            surrogate_grad_fn=activation.SingleExponential(),
            norm_input=False,
        )

        def fire(currents: Tensor) -> Tensor:
            spikes: Tensor = layer(currents.transpose(0, 1))  # sinabs expects (B, T, ...)
            return spikes.transpose(0, 1)

        # a lambda, because a bound method would be copied with the network, and its layer with it
        return fire, lambda: layer.reset_states()

    return neurons
