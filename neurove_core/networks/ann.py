"""A network of equal size without spikes, as a baseline: convolutions, LSTM and readout in NeuroVE's layout."""

import itertools
from typing import NamedTuple

import torch
from torch import Tensor, nn

from neurove_core.config import ModelConfig
from neurove_core.networks.state import is_finite
from neurove_core.spiking.readout import readout_step


class AnnState(NamedTuple):
    """State from window to window, for a batch of B streams."""

    h: Tensor  # hidden state of the LSTM (L, B, N)
    c: Tensor  # cell state of the LSTM (L, B, N)
    readout: Tensor  # potential of the output neurons (B, 6n)

    def finite(self) -> bool:
        """Whether every number of the state is finite."""
        return is_finite(self)


class Ann(nn.Module):
    """NeuroVE with a ReLU in place of each LIF and torch's LSTM in place of the ASLSTM.

    Differs: the feature extractor has no membranes, so it has no memory of its own.
    """

    def __init__(self, config: ModelConfig) -> None:
        super().__init__()
        net = config.network
        self.config = config
        self.bins = config.window.bins
        rows, columns = config.canonical.height, config.canonical.width
        self.convs, self.norms = nn.ModuleList(), nn.ModuleList()
        for a, b in itertools.pairwise((config.input_shape[0], *net.channels)):
            self.convs.append(nn.Conv2d(a, b, 3, stride=2, padding=1, bias=False))
            self.norms.append(nn.BatchNorm2d(b))
            rows, columns = (rows + 1) // 2, (columns + 1) // 2
        self.project = nn.Linear(net.channels[-1] * rows * columns, net.features, bias=False)
        self.project_norm = nn.BatchNorm1d(net.features)
        self.lstm = nn.LSTM(net.features, net.hidden, net.cells)
        self.readout = nn.Linear(net.hidden, 6 * self.bins)
        self.kappa_logit = nn.Parameter(torch.tensor(-1.386))  # sigmoid gives 0.2

    def initial_state(self, batch: int = 1) -> AnnState:
        """The zero state of `batch` streams."""
        zeros, net = self.readout.weight.new_zeros, self.config.network
        shape = (net.cells, batch, net.hidden)
        return AnnState(zeros(shape), zeros(shape), zeros(batch, 6 * self.bins))

    def forward(self, spikes: Tensor, state: AnnState) -> tuple[Tensor, AnnState]:
        """Twists of T consecutive windows, and the state after them; see `NeuroVE.forward`."""
        steps, batch = spikes.shape[:2]
        x = spikes.flatten(0, 1).contiguous(memory_format=torch.channels_last)
        for conv, norm in zip(self.convs, self.norms, strict=True):
            x = torch.relu(norm(conv(x)))
        features = self.project_norm(self.project(x.flatten(1))).unflatten(0, (steps, batch))
        out, (h, c) = self.lstm(features, (state.h, state.c))
        y, kappa, answers = state.readout, torch.sigmoid(self.kappa_logit), []
        for z in out:
            y = readout_step(z, y, self.readout.weight, self.readout.bias, kappa)
            answers.append(y)
        return torch.stack(answers).view(steps, batch, self.bins, 6), AnnState(h, c, y)
