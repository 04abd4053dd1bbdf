"""NeuroVE: spiking feature extractor and velocity estimator, (spikes, state) -> (twists, state); paper section III."""

import itertools
from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch.nn.functional import conv2d, linear

from neurove_core.config import ModelConfig
from neurove_core.networks.quantisation import rounded, rounded_input
from neurove_core.networks.state import is_finite
from neurove_core.spiking.alif import diffuse
from neurove_core.spiking.aslstm import ASLSTM, ASLSTMState
from neurove_core.spiking.fused import convolution as fused
from neurove_core.spiking.lif import LIFParams, LIFState, lif_scan
from neurove_core.spiking.plain import is_plain
from neurove_core.spiking.readout import readout_scan


class NetworkState(NamedTuple):
    """State from window to window, for a batch of B streams."""

    membranes: tuple[LIFState, ...]  # one per block of the feature extractor, (B, C, H, W)
    cells: tuple[ASLSTMState, ...]  # one per ASLSTM layer, (B, N)
    readout: Tensor  # potential of the output neurons (B, 6n), followed by those of the spread where there is one

    def finite(self) -> bool:
        """Whether every number of the state is finite."""
        return is_finite(self)


class SpikingBlock(nn.Module):
    """Convolution of stride 2, threshold-dependent batch norm (tdBN, Zheng 2021), LIF.

    Differs: tdBN's factor v_th is the initial value of the norm's learnable weight, which spans the same functions.
    With `int8` the convolution's weights are rounded to 8 bits, also in training (decision 38). With `of_spikes`, all
    input is 0 or 1, and training on a CPU convolves the neurons that fired alone (spiking/fused/convolution.py).
    """

    def __init__(
        self, inputs: int, outputs: int, lif: LIFParams, *, int8: bool = False, of_spikes: bool = False
    ) -> None:
        super().__init__()
        self.conv = nn.Conv2d(inputs, outputs, 3, stride=2, padding=1, bias=False)
        self.norm = nn.BatchNorm2d(outputs)
        nn.init.constant_(self.norm.weight, lif.v_th)
        self.lif = lif
        self._int8, self._of_spikes = int8, of_spikes

    def forward(self, spikes: Tensor, state: LIFState) -> tuple[Tensor, LIFState]:
        """(T, B, C, H, W) to (T, B, C', H', W'); the norm's statistics run over time and batch together."""
        steps, batch = spikes.shape[:2]
        frames = spikes.flatten(0, 1).contiguous(
            memory_format=torch.channels_last
        )  # the fastest layout for convolutions on CPUs
        weight = rounded(self.conv.weight) if self._int8 else self.conv.weight
        if self._of_spikes and not is_plain() and fused.fits(frames, weight):
            current = self.norm(fused.convolve(frames, weight))
        else:
            current = self.norm(conv2d(frames, weight, stride=2, padding=1))
        return lif_scan(current.unflatten(0, (steps, batch)), state, self.lif)


class NeuroVE(nn.Module):
    """The network of paper Fig. 2: one time step per window, n bins in, n twists out, all state streamed.

    Its outputs are in the bundle's scaled units; Estimator converts them to m/s and rad/s. In int8 the weights of its
    convolutions and of its projection are rounded to 8 bits, also in training (decision 38).
    """

    def __init__(self, config: ModelConfig) -> None:
        super().__init__()
        net = config.network
        self.config = config
        self.bins = config.window.bins
        lif = LIFParams(net.decay, net.v_th, net.surrogate, net.surrogate_width * net.v_th)
        widths = (config.input_shape[0], *net.channels)
        self._int8 = net.precision == "int8"
        self.blocks = nn.ModuleList(
            SpikingBlock(a, b, lif, int8=self._int8, of_spikes=index > 0)
            for index, (a, b) in enumerate(itertools.pairwise(widths))
        )
        rows, columns = self.map_sizes()[-1]
        self.project = nn.Linear(net.channels[-1] * rows * columns, net.features, bias=False)
        self.project_norm = nn.BatchNorm1d(net.features)
        inputs = (net.features, *(net.hidden,) * (net.cells - 1))
        self.cells = nn.ModuleList(
            ASLSTM(
                width,
                net.hidden,
                alpha=net.alpha,
                v_th=net.v_th,
                diffusion=net.diffusion,
                surrogate=net.surrogate,
                surrogate_width=net.surrogate_width * net.v_th,
            )
            for width in inputs
        )
        d_space = torch.full((net.cells, net.hidden), 0.5 if net.diffusion else 0.0)
        self.d_space: Tensor
        if net.diffusion:
            self.d_space = nn.Parameter(d_space)
        else:
            self.register_buffer("d_space", d_space, persistent=False)
        self.readout = nn.Linear(net.hidden, 6 * self.bins)
        self.spread: nn.Linear | None = None  # more output neurons, for the uncertainty of each axis; see add_spread
        self.kappa_logit = nn.Parameter(torch.tensor(-1.386))  # sigmoid gives 0.2

    def add_spread(self, rows: int = 6) -> nn.Linear:
        """Add output neurons for the spread of the errors, with zero weights, and return them.

        They have the leak and the input of the velocity outputs, and no twist depends on them. Their potentials, one
        row for each axis, are log sigma of the newest window in units of the bundle's scale; see `log_sigma`.
        """
        self.spread = nn.Linear(self.readout.in_features, rows)
        nn.init.zeros_(self.spread.weight)
        nn.init.zeros_(self.spread.bias)
        return self.spread

    def log_sigma(self, state: NetworkState) -> Tensor | None:
        """Log sigma (B, rows) of the window that led to this state; None without a spread."""
        return None if self.spread is None else state.readout[:, 6 * self.bins :]

    def outputs(self) -> tuple[Tensor, Tensor]:
        """Weight (R, N) and bias (R) of all output neurons; R is 6n plus the rows of the spread."""
        if self.spread is None:
            return self.readout.weight, self.readout.bias
        both = self.readout, self.spread
        return torch.cat([layer.weight for layer in both]), torch.cat([layer.bias for layer in both])

    def map_sizes(self) -> list[tuple[int, int]]:
        """Rows and columns of every block's output."""
        rows, columns = self.config.canonical.height, self.config.canonical.width
        sizes = []
        for _ in self.config.network.channels:
            rows, columns = (rows + 1) // 2, (columns + 1) // 2
            sizes.append((rows, columns))
        return sizes

    def initial_state(self, batch: int = 1) -> NetworkState:
        """The zero state of `batch` streams."""
        zeros = self.readout.weight.new_zeros
        membranes = tuple(
            LIFState(zeros(batch, channels, rows, columns).contiguous(memory_format=torch.channels_last))
            for channels, (rows, columns) in zip(self.config.network.channels, self.map_sizes(), strict=True)
        )
        cells = tuple(cell.initial_state(batch) for cell in self._layers())
        return NetworkState(membranes, cells, zeros(batch, len(self.outputs()[1])))

    def _layers(self) -> list[ASLSTM]:
        return [cell for cell in self.cells if isinstance(cell, ASLSTM)]

    def forward(self, spikes: Tensor, state: NetworkState) -> tuple[Tensor, NetworkState]:
        """Twists of T consecutive windows, and the state after them.

        Source: NeuroVE, section III-A to III-D, computed layer by layer, each over all time steps.

        Args:
            spikes: (T, B, C, H, W) from encoding.to_spikes; C is 2n, and more with subcells or a history.
            state: state of these B streams, from initial_state or the previous call.

        Returns:
            twists (T, B, n, 6) in scaled units: vx vy vz wx wy wz, one per bin; and the next state.
        """
        steps, batch = spikes.shape[:2]
        if self._int8:
            spikes = rounded_input(spikes)
        membranes = []
        for block, membrane in zip(self.blocks, state.membranes, strict=True):
            spikes, membrane = block(spikes, membrane)
            membranes.append(membrane)
        weight = rounded(self.project.weight) if self._int8 else self.project.weight
        x = self.project_norm(linear(spikes.flatten(2).flatten(0, 1), weight)).unflatten(0, (steps, batch))
        cells = []
        for index, (layer, cell) in enumerate(zip(self._layers(), state.cells, strict=True)):
            scanned, last = layer(x, cell)
            x = diffuse(scanned.s, scanned.v, self.d_space[index])
            cells.append(last)
        answers, y = readout_scan(x, state.readout, *self.outputs(), torch.sigmoid(self.kappa_logit))
        twists = answers[..., : 6 * self.bins].reshape(steps, batch, self.bins, 6)
        return twists, NetworkState(tuple(membranes), tuple(cells), y)
