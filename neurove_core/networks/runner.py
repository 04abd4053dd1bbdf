"""Runner: what an Estimator needs of a network. Its counts of one window per stream in, twists and next states out."""

from collections.abc import Sequence
from typing import Protocol

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from neurove_core.networks.encoding import to_spikes
from neurove_core.networks.kinds import Network, State


class Runner(Protocol):
    """Encodes windows and runs a network on them. It holds no stream's state and is safe to share between threads."""

    def run(
        self, counts: Sequence[NDArray[np.uint8]], states: Sequence[State]
    ) -> list[tuple[NDArray[np.float64], State]]:
        """One window of each of B streams.

        Args:
            counts: B windows, each (C, H, W) event counts; see ModelConfig.input_shape.
            states: the state of each stream, for a batch of one.

        Returns:
            for each stream its twists (n, 6) in scaled units, and its next state.
        """


class PlainRunner:
    """Runs the network itself, one stream after the other; see `Runner`.

    Args:
        network: in evaluation mode. It is not copied.
    """

    def __init__(self, network: Network) -> None:
        self._network = network
        self._encoding = network.config.network.encoding

    @torch.inference_mode()
    def run(
        self, counts: Sequence[NDArray[np.uint8]], states: Sequence[State]
    ) -> list[tuple[NDArray[np.float64], State]]:
        """One window of each stream; see `Runner.run`."""
        spikes = to_spikes(batch_of(counts), self._encoding)
        answers = [self._network(spikes[:, b : b + 1], state) for b, state in enumerate(states)]
        return [(twists[0, 0].double().numpy(), state) for twists, state in answers]


def batch_of(counts: Sequence[NDArray[np.uint8]]) -> Tensor:
    """Windows (2n, H, W) of B streams as one time step (1, B, 2n, H, W), without a copy for a single stream."""
    batch = torch.from_numpy(counts[0] if len(counts) == 1 else np.stack(counts))
    return batch.view(1, len(counts), *counts[0].shape)
