"""The fast Runner: the engine of a NeuroVE network with the encoding that it reads in the least time."""

from collections.abc import Callable, Sequence
from typing import cast

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from neurove_core.engine.encoding import CountInput, to_codes, to_count_input
from neurove_core.engine.engine import Engine
from neurove_core.networks.arrays import Runner
from neurove_core.networks.encoding import to_spikes
from neurove_core.networks.kinds import Network, State
from neurove_core.networks.neurove import NetworkState, NeuroVE
from neurove_core.networks.runner import PlainRunner, batch_of, log_sigma_of


def runner_of(network: Network) -> Runner:
    """The fastest runner of a network: NeuroVE has a fast path, the baselines run as they were trained."""
    return FastRunner(network) if isinstance(network, NeuroVE) else PlainRunner(network)


class FastRunner:
    """Runs windows through the engine, several streams in one batch; see `Runner`.

    Answers to several streams equal those to each alone bit for bit in int8 and over spike lists; a dense convolution
    in float32 may round differently, see `Engine.together`.

    Args:
        network: its weights are copied; later changes have no effect.
    """

    def __init__(self, network: NeuroVE) -> None:
        self._engine, self._network = Engine(network), network
        self._encoding = network.config.network.encoding
        self._encode: Callable[[Tensor, str], Tensor | CountInput] = to_spikes
        if network.config.network.precision == "int8":
            self._encode = to_codes
        elif self._engine.reads_counts:
            self._encode = to_count_input

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
        encoded = self._encode(batch_of(counts), self._encoding)
        own = cast("Sequence[NetworkState]", states)  # of this network
        answers = self._engine.together(encoded, own) if len(own) > 1 else [self._engine(encoded, own[0])]
        return [(twists[0, 0].double().numpy(), state) for twists, state in answers]
