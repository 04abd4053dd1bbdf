"""SNN-ANG, a baseline of the paper: spiking convolutions, global average pooling, leaky outputs; no recurrent cell.

Source: Gehrig, Shrestha, Mouritzen, Scaramuzza, Event-Based Angular Velocity Regression with Spiking Networks
(ICRA 2020): five convolutions of 3x3 with 16, 32, 64, 128 and 256 channels and strides 2, 2, 2, 2, 1, thresholds and
time constants of each, global average pooling, and outputs that filter and never fire.
Differs: see SnnAng.
"""

import itertools
import math
from typing import Final, NamedTuple

import torch
from torch import Tensor, nn

from neurove_core.config import ModelConfig
from neurove_core.networks.state import is_finite
from neurove_core.spiking.lif import LIFParams, LIFState, lif_scan
from neurove_core.spiking.readout import readout_step

CHANNELS: Final = (16, 32, 64, 128, 256)
"""Channels of its five layers."""

THRESHOLDS: Final = (0.27, 0.25, 0.30, 0.40, 0.40)
TAU_STEPS: Final = (2.0, 2.0, 4.0, 4.0, 4.0)
OUTPUT_TAU_STEPS: Final = 8.0
"""Time constants of the paper in its time steps of 1 ms; layers after the fifth use those of the fifth."""

_STRIDED: Final = 4  # number of layers that halve the image


class SnnAngState(NamedTuple):
    """State from window to window, for a batch of B streams."""

    membranes: tuple[LIFState, ...]  # one per layer, (B, C, H, W)
    readout: Tensor  # potential of the output neurons (B, 6n)

    def finite(self) -> bool:
        """Whether every number of the state is finite."""
        return is_finite(self)


class SnnAng(nn.Module):
    """SNN-ANG with the input and the outputs of NeuroVE. Of the network configuration it uses `channels`.

    Differs: so that one recipe and one budget train all networks, this network has one step per window, as ours, and
    its time constants count these steps; LIF neurons with a hard reset in place of SRM neurons (whose double
    exponential and refractory kernel of 1 to 4 ms have no meaning between windows of 50 ms); tdBN before each layer,
    without which nothing learns in this many updates, and zero padding; our surrogate gradient, as wide as each
    threshold; linear velocity in addition to angular velocity; state that continues from window to window instead of
    a reset every 100 ms.
    """

    def __init__(self, config: ModelConfig) -> None:
        super().__init__()
        net = config.network
        self.config = config
        self.bins = config.window.bins
        self.convs, self.norms = nn.ModuleList(), nn.ModuleList()
        self._lif: list[LIFParams] = []
        self._sizes: list[tuple[int, ...]] = []
        rows, columns = config.canonical.height, config.canonical.width
        for layer, (a, b) in enumerate(itertools.pairwise((config.input_shape[0], *net.channels))):
            stride, nth = 2 if layer < _STRIDED else 1, min(layer, len(THRESHOLDS) - 1)
            self.convs.append(nn.Conv2d(a, b, 3, stride=stride, padding=1, bias=False))
            norm = nn.BatchNorm2d(b)
            nn.init.constant_(norm.weight, THRESHOLDS[nth])
            self.norms.append(norm)
            decay, width = math.exp(-1 / TAU_STEPS[nth]), net.surrogate_width * THRESHOLDS[nth]
            self._lif.append(LIFParams(decay, THRESHOLDS[nth], net.surrogate, width))
            rows, columns = -(-rows // stride), -(-columns // stride)
            self._sizes.append((b, rows, columns))
        self.readout = nn.Linear(net.channels[-1], 6 * self.bins)

    def initial_state(self, batch: int = 1) -> SnnAngState:
        """The zero state of `batch` streams."""
        zeros = self.readout.weight.new_zeros
        membranes = tuple(LIFState(zeros(batch, *size)) for size in self._sizes)
        return SnnAngState(membranes, zeros(batch, 6 * self.bins))

    def forward(self, spikes: Tensor, state: SnnAngState) -> tuple[Tensor, SnnAngState]:
        """Twists of T consecutive windows, and the state after them; see `NeuroVE.forward`."""
        steps, batch = spikes.shape[:2]
        membranes = []
        for conv, norm, lif, membrane in zip(self.convs, self.norms, self._lif, state.membranes, strict=True):
            frames = spikes.flatten(0, 1).contiguous(memory_format=torch.channels_last)
            current = norm(conv(frames)).unflatten(0, (steps, batch))
            spikes, after = lif_scan(current, membrane, lif)
            membranes.append(after)
        y, kappa, answers = state.readout, math.exp(-1 / OUTPUT_TAU_STEPS), []
        for z in spikes.mean(dim=(3, 4)):
            y = readout_step(z, y, self.readout.weight, self.readout.bias, kappa)
            answers.append(y)
        return torch.stack(answers).view(steps, batch, self.bins, 6), SnnAngState(tuple(membranes), y)
