"""A NeuroVE network as arrays: its weights by name, their shapes, and the state of a stream. Needs no torch."""

import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from neurove_core.config import ModelConfig

Array = NDArray[np.float32]


class Weights(NamedTuple):
    """The stored tensors of a network, by the names of its torch module."""

    config: ModelConfig
    tensors: Mapping[str, NDArray[Any]]
    spread: bool = False  # whether it has output neurons for the spread of its errors

    @property
    def parameters(self) -> int:
        """Number of learned values; the statistics of norms are not learned."""
        return sum(array.size for name, array in self.tensors.items() if "running_" not in name)


class State(Protocol):
    """What a network carries from window to window, as arrays or as tensors."""

    def finite(self) -> bool:
        """Whether every number of the state is finite."""


class ArrayState(NamedTuple):
    """State of a NeuroVE network for one stream, in the layout of the compiled code."""

    membranes: tuple[Array, ...]  # of each block (1, H, W, C) after the reset; C filled up to a multiple of LANES
    cells: Array  # (3 L, 1, N): c, v, s of each ASLSTM layer
    readout: Array  # (1, R): potentials of the output neurons, followed by those of the spread
    channels: tuple[int, ...]  # of each block, without those that fill it up

    def finite(self) -> bool:
        """Whether every number of the state is finite."""
        return all(bool(np.isfinite(part).all()) for part in (*self.membranes, self.cells, self.readout))

    def fired(self) -> dict[str, NDArray[np.bool_]]:
        """Which neurons fired in the last step, by layer; as `kinds.fired`."""
        own = zip(self.membranes, self.channels, strict=True)
        layers = {f"block {number}": one[..., :count] == 0 for number, (one, count) in enumerate(own, 1)}
        return layers | {f"cell {number}": one > 0 for number, one in enumerate(self.cells[2::3], 1)}

    @property
    def rate(self) -> float:
        """Share of the cells that fired in the last step."""
        return float(self.cells[2::3].mean())


class Begins(Protocol):
    """What can begin a stream: a runner, or a network in torch."""

    def initial_state(self) -> Any:
        """The zero state of one stream."""


class Runner(Protocol):
    """Encodes windows and runs a network on them. It holds no stream's state and is safe to share between threads."""

    def initial_state(self) -> State:
        """The zero state of one stream."""

    def log_sigma(self, state: Any) -> NDArray[np.float64] | None:
        """Log sigma (6) of the window that led to a state, in units of the bundle's scale; None without a spread."""

    def run(self, counts: Sequence[NDArray[np.uint8]], states: Sequence[Any]) -> list[tuple[NDArray[np.float64], Any]]:
        """One window of each of B streams.

        Args:
            counts: B windows, each (C, H, W) event counts; see ModelConfig.input_shape.
            states: the state of each stream, for a batch of one.

        Returns:
            for each stream its twists (n, 6) in scaled units, and its next state.
        """


def map_sizes(config: ModelConfig) -> list[tuple[int, int]]:
    """Rows and columns of the input, and of every block's output."""
    sizes = [(config.canonical.height, config.canonical.width)]
    for _ in config.network.channels:
        rows, columns = sizes[-1]
        sizes.append(((rows + 1) // 2, (columns + 1) // 2))
    return sizes


def shapes(config: ModelConfig, *, spread: bool, rows: int = 6) -> dict[str, tuple[int, ...]]:
    """Names and shapes of the stored tensors of a NeuroVE network, all float32.

    Args:
        config: of kind neurove.
        spread: whether it has output neurons for the spread.
        rows: number of these.
    """
    net = config.network
    found: dict[str, tuple[int, ...]] = {"kappa_logit": ()}
    inputs = config.input_shape[0]
    for at, channels in enumerate(net.channels):
        found[f"blocks.{at}.conv.weight"] = (channels, inputs, 3, 3)
        found |= _norm(f"blocks.{at}.norm", channels)
        inputs = channels
    found["project.weight"] = (net.features, inputs * math.prod(map_sizes(config)[-1]))
    found |= _norm("project_norm", net.features)
    for at in range(net.cells):
        width = net.hidden if at else net.features
        found |= {
            f"cells.{at}.w_x": (5 * net.hidden, width),
            f"cells.{at}.w_v": (4 * net.hidden, net.hidden),
            f"cells.{at}.b": (5 * net.hidden,),
        }
        if net.diffusion:
            found[f"cells.{at}.d_time"] = (net.hidden,)
    if net.diffusion:
        found["d_space"] = (net.cells, net.hidden)
    outputs = {"readout": 6 * config.window.bins} | ({"spread": rows} if spread else {})
    for name, count in outputs.items():
        found |= {f"{name}.weight": (count, net.hidden), f"{name}.bias": (count,)}
    return found


def _norm(name: str, channels: int) -> dict[str, tuple[int, ...]]:
    return {f"{name}.{part}": (channels,) for part in ("weight", "bias", "running_mean", "running_var")}
