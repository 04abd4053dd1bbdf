"""The engine: NeuroVE as the service runs it. Norms are folded into the weights, each part runs in its fastest form.

    Engine(network)(spikes, state) -> (twists, state)

This equals the network in evaluation mode up to rounding: folding a norm moves the last bits of a current, and a spike
may depend on these. The engine inside `plain()` is the reference implementation: the same folded weights through
`lif_step`, `aslstm_step` and `readout_step`. Tests compare the spikes of both bit for bit. A state may pass between
network, engine and reference. Convolutions and projection run over spike lists where the widths allow it (sparse.py,
sparse_int8.py), else dense. README.md in this folder lists every fast form with its reference implementation.
"""

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import linear

from neurove_core.engine.cells import Array, copied_params, flattened_weights, run_cells
from neurove_core.engine.convolution import Convolution
from neurove_core.engine.encoding import CountInput
from neurove_core.engine.fallback import vectors_work
from neurove_core.engine.folding import (
    Folded,
    folded,
    folded_convolution,
    folded_projection,
    int8_layer,
    int8_projection,
)
from neurove_core.engine.int8 import Int8Extractor, Int8Projection
from neurove_core.engine.spike_lists import SpikeList, to_maps
from neurove_core.networks import tables
from neurove_core.networks.neurove import NetworkState, NeuroVE, SpikingBlock
from neurove_core.spiking.alif import diffuse
from neurove_core.spiking.aslstm import ASLSTM, ASLSTMState, aslstm_step
from neurove_core.spiking.fused import scan
from neurove_core.spiking.lif import LIFParams, LIFState, lif_scan_reference
from neurove_core.spiking.plain import is_plain
from neurove_core.spiking.readout import readout_step

if TYPE_CHECKING:  # it needs the vector code, which may not work with this numba
    from neurove_core.engine.sparse import SparseExtractor


class Engine:
    """Inference of one network. It holds no stream's state and is safe to share between threads.

    Args:
        network: in float32 on the CPU. Its weights are copied; later changes have no effect.
    """

    def __init__(self, network: NeuroVE) -> None:
        self._bins = network.bins
        blocks = [block for block in network.blocks if isinstance(block, SpikingBlock)]
        net, grid = network.config.network, network.config.canonical
        sizes = [(grid.height, grid.width), *network.map_sizes()]
        with torch.no_grad():
            self._lif: LIFParams = blocks[0].lif
            self._int8, self._sparse = None, None
            self._convolutions: list[Convolution] = []
            self._project: Folded | Int8Projection
            if net.precision == "int8":
                layers = [int8_layer(block, at=i) for i, block in enumerate(blocks)]
                self._int8 = Int8Extractor(layers, sizes, self._lif)
                self._project = Int8Projection(int8_projection(network, net.channels[-1], *sizes[-1]))
            else:
                self._convolutions = [
                    folded_convolution(block, *size) for block, size in zip(blocks, sizes, strict=False)
                ]
                self._project = folded_projection(network, net.channels[-1], *sizes[-1])
                self._sparse = _over_lists(blocks, self._convolutions, sizes, self._project, self._lif)
            self._readout = Folded(*(tensor.detach().clone() for tensor in network.outputs()))
            self._kappa = tables.sigmoid(float(network.kappa_logit))
            cells = [cell for cell in network.cells if isinstance(cell, ASLSTM)]
            self._params = [copied_params(cell.params()) for cell in cells]
            self._d_space = network.d_space.detach().clone()
        inside = self._project if isinstance(self._project, Folded) and self._sparse is None else None
        self._features_inside = inside.bias.numel() if inside else 0  # of a projection in `run_cells`
        self._weights = flattened_weights(inside, self._params, self._d_space, self._readout)
        self._constants = np.array([net.alpha, net.v_th, self._kappa], np.float32)

    @property
    def reads_counts(self) -> bool:
        """Whether `encoding.to_count_input` is a faster input than `to_spikes`."""
        return self._sparse is not None

    @torch.inference_mode()
    def __call__(self, spikes: Tensor | CountInput, state: NetworkState) -> tuple[Tensor, NetworkState]:
        """Velocities of T consecutive windows, and the state after them.

        Args:
            spikes: (T, B, 2n, H, W), any layout; channels last is read without a copy. An int8 network also takes
                `encoding.to_codes`, a float32 network `encoding.to_count_input`.
            state: state of these B streams, from the network or the engine.

        Returns:
            twists (T, B, n, 6) in scaled units and the next state, as NeuroVE.forward.
        """
        x, membranes = self._features(spikes, state)
        rows, steps = self._rows(x), spikes.shape[0]
        twists, cells, y = (self._plain_cells if is_plain() else self._fused_cells)(rows, steps, state)
        return twists, NetworkState(membranes, cells, y)

    @torch.inference_mode()
    def together(
        self, spikes: Tensor | CountInput, states: Sequence[NetworkState]
    ) -> list[tuple[Tensor, NetworkState]]:
        """One window of each of B streams in one batch; eight streams take 0.8 of the time of eight calls.

        The feature extractor runs on all streams at once. Cells and readout run on each stream alone, so that the
        rounding of one stream never depends on another. Answers equal those of single calls bit for bit in int8 and
        over spike lists (sparse.py); a dense convolution of several maps may round differently from one of a single
        map.

        Args:
            spikes: (1, B, 2n, H, W), as in a call.
            states: state of each stream, for a batch of one.

        Returns:
            twists (1, 1, n, 6) and the next state of each stream.
        """
        together = tuple(
            LIFState(torch.cat([m.v for m in maps])) for maps in zip(*(s.membranes for s in states), strict=True)
        )
        x, membranes = self._features(spikes, NetworkState(together, (), states[0].readout))
        rows = self._rows(x)
        answers = []
        for b, state in enumerate(states):
            twists, cells, y = (self._plain_cells if is_plain() else self._fused_cells)(rows[b : b + 1], 1, state)
            # cloned, because a view would keep the memory of all streams
            own = tuple(LIFState(membrane.v[b : b + 1].clone()) for membrane in membranes)
            answers.append((twists, NetworkState(own, cells, y)))
        return answers

    @torch.inference_mode()
    def features(self, spikes: Tensor | CountInput, state: NetworkState) -> tuple[Tensor, tuple[LIFState, ...]]:
        """Run the feature extractor alone: spikes (T * B, C, H', W') of the last map, and the membranes after them."""
        x, membranes = self._features(spikes, state)
        return to_maps(x) if isinstance(x, SpikeList) else x.float(), membranes

    def _features(
        self, spikes: Tensor | CountInput, state: NetworkState
    ) -> tuple[Tensor | SpikeList, tuple[LIFState, ...]]:
        if self._sparse is not None and not is_plain():
            return self._sparse(spikes, state.membranes)
        if isinstance(spikes, CountInput):
            spikes = spikes.spikes()
        if self._int8 is not None:
            return self._int8(spikes.flatten(0, 1), state.membranes)
        x = spikes.flatten(0, 1).contiguous(memory_format=torch.channels_last)
        fire = self._plain_fire if is_plain() else self._fused_fire
        membranes = []
        for convolve, membrane in zip(self._convolutions, state.membranes, strict=True):
            x, after = fire(convolve(x), membrane.v)
            membranes.append(LIFState(after))
        return x, tuple(membranes)

    def _rows(self, x: Tensor | SpikeList) -> Tensor | Array:
        """The input of the cells from the last map (R, C, H, W): its spikes (R, I), or their projection (R, F)."""
        if isinstance(x, SpikeList):
            if isinstance(self._project, Int8Projection):
                return self._project(x)
            assert self._sparse is not None  # it made the list
            return self._sparse.project(x)
        rows = x.permute(0, 2, 3, 1).flatten(1)  # in memory order
        return self._project(rows) if isinstance(self._project, Int8Projection) else rows

    def _fused_fire(self, currents: Tensor, v: Tensor) -> tuple[Tensor, Tensor]:
        return scan.scan_in_place(currents, v, self._lif.decay, self._lif.v_th)

    def _plain_fire(self, currents: Tensor, v: Tensor) -> tuple[Tensor, Tensor]:
        spikes, after = lif_scan_reference(currents.view(-1, *v.shape), LIFState(v), self._lif)
        return spikes.flatten(0, 1), after.v

    def _fused_cells(
        self, rows: Tensor | Array, steps: int, state: NetworkState
    ) -> tuple[Tensor, tuple[ASLSTMState, ...], Tensor]:
        x: Array = rows.numpy() if isinstance(rows, Tensor) else rows
        stacked = torch.stack([field for cell in state.cells for field in cell])  # (3 L, B, N): c, v, s of each layer
        y = state.readout.clone()
        answers = np.empty((steps, *y.shape), np.float32)
        run_cells(x, self._weights, self._features_inside, self._constants, stacked.numpy(), y.numpy(), answers)
        fields = stacked.unbind()
        cells = tuple([ASLSTMState(*fields[i : i + 3]) for i in range(0, len(fields), 3)])
        return torch.from_numpy(answers[..., : 6 * self._bins].reshape(steps, -1, self._bins, 6)), cells, y

    def _plain_cells(
        self, rows: Tensor | Array, steps: int, state: NetworkState
    ) -> tuple[Tensor, tuple[ASLSTMState, ...], Tensor]:
        y, cells, answers, rows = state.readout, list(state.cells), [], torch.as_tensor(rows)
        x = linear(rows, *self._project) if isinstance(self._project, Folded) else rows
        for z in x.view(steps, rows.shape[0] // steps, -1):
            for index, params in enumerate(self._params):
                cells[index] = aslstm_step(z, cells[index], params)
                z = diffuse(cells[index].s, cells[index].v, self._d_space[index])
            y = readout_step(z, y, *self._readout, self._kappa)
            answers.append(y)
        twists = torch.stack(answers)[..., : 6 * self._bins].reshape(steps, -1, self._bins, 6)
        return twists, tuple(cells), y


def _over_lists(
    blocks: list[SpikingBlock],
    convolutions: list[Convolution],
    sizes: list[tuple[int, int]],
    projection: Folded,
    lif: LIFParams,
) -> "SparseExtractor | None":
    """The extractor over spike lists, or None where it does not work with these widths or on this machine."""
    if not vectors_work():
        return None
    from neurove_core.engine.sparse import SparseLayer, sparse_extractor

    layers = [
        SparseLayer(*folded(block.conv.weight, block.norm), convolve, *size)
        for block, convolve, size in zip(blocks, convolutions, sizes, strict=False)
    ]
    return sparse_extractor(layers, projection, lif)
