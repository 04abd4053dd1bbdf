"""The plain Runner: the network itself, in torch."""

from collections.abc import Sequence

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from neurove_core.networks.encoding import to_spikes
from neurove_core.networks.kinds import Network, State
from neurove_core.networks.neurove import NetworkState, NeuroVE


class PlainRunner:
    """Runs the network itself, one stream after the other; see `Runner`.

    Args:
        network: in evaluation mode. It is not copied.
    """

    def __init__(self, network: Network) -> None:
        self._network = network
        self._encoding = network.config.network.encoding

    def initial_state(self) -> State:
        """The zero state of one stream."""
        return self._network.initial_state()

    def log_sigma(self, state: State) -> NDArray[np.float64] | None:
        """Log sigma (6) of the window that led to a state; None without a spread."""
        return log_sigma_of(self._network, state)

    @torch.inference_mode()
    def run(
        self, counts: Sequence[NDArray[np.uint8]], states: Sequence[State]
    ) -> list[tuple[NDArray[np.float64], State]]:
        """One window of each stream; see `Runner.run`."""
        spikes = to_spikes(batch_of(counts), self._encoding)
        answers = [self._network(spikes[:, b : b + 1], state) for b, state in enumerate(states)]
        return [(twists[0, 0].double().numpy(), state) for twists, state in answers]


def log_sigma_of(network: Network, state: State) -> NDArray[np.float64] | None:
    """Log sigma (6) of the window that led to a state; None without a spread."""
    if not isinstance(network, NeuroVE) or not isinstance(state, NetworkState):
        return None
    found = network.log_sigma(state)
    return None if found is None else found[0].double().cpu().numpy()


def batch_of(counts: Sequence[NDArray[np.uint8]]) -> Tensor:
    """Windows (2n, H, W) of B streams as one time step (1, B, 2n, H, W), without a copy for a single stream."""
    batch = torch.from_numpy(counts[0] if len(counts) == 1 else np.stack(counts))
    return batch.view(1, len(counts), *counts[0].shape)
