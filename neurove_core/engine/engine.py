"""NeuroVE as the service runs it: the norms folded into the weights, each part in its fastest form, same state.

    Engine(network)(spikes, state) -> (twists, state)

is what the network in evaluation mode computes, up to rounding: folding a norm moves the last bits of a current, and a
spike that hangs on them. What holds bit for bit is tested against the engine inside `neurons.plain()`: the same folded
weights through `lif_step`, `aslstm_step` and `readout_step`. State goes to and fro between all of them. Convolutions
and projection are sums over the neurons that fired where widths allow it (sparse.py, sparse_int8.py), else dense.
"""

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import linear

from neurove_core.engine import int8, sparse, spike_lists
from neurove_core.engine.cells import Array, copied_params, flattened_weights, run_cells
from neurove_core.engine.folding import (
    Folded,
    folded,
    folded_convolution,
    folded_projection,
    int8_layer,
    int8_projection,
)
from neurove_core.networks.neurove import NetworkState, NeuroVE, SpikingBlock
from neurove_core.spiking.alif import diffuse
from neurove_core.spiking.aslstm import ASLSTM, ASLSTMState, aslstm_step
from neurove_core.spiking.fused import scan
from neurove_core.spiking.lif import LIFParams, LIFState, lif_scan_reference
from neurove_core.spiking.plain import is_plain
from neurove_core.spiking.readout import readout_step


class Engine:
    """The inference of one network; holds no stream's state and is safe to share between threads.

    Args:
        network: in float32 on the CPU; its weights are copied, later changes of them are not seen.
    """

    def __init__(self, network: NeuroVE) -> None:
        self._bins = network.bins
        blocks = [block for block in network.blocks if isinstance(block, SpikingBlock)]
        net, grid = network.config.network, network.config.canonical
        sizes = [(grid.height, grid.width), *network.map_sizes()]
        with torch.no_grad():
            self._lif: LIFParams = blocks[0].lif
            self._extractor, self._sparse, self._convolutions = None, None, []
            if net.precision == "int8":
                self._extractor = int8.Extractor(
                    [int8_layer(block, at=i) for i, block in enumerate(blocks)], sizes, self._lif
                )
            else:
                self._convolutions = [
                    folded_convolution(block, *size) for block, size in zip(blocks, sizes, strict=False)
                ]
            self._project: Folded | int8.Projection
            if net.precision == "int8":
                self._project = int8.Projection(int8_projection(network, net.channels[-1], *sizes[-1]))
            else:
                self._project = folded_projection(network, net.channels[-1], *sizes[-1])
                self._sparse = self._over_lists(blocks, sizes)
            self._readout = Folded(*(tensor.detach().clone() for tensor in network.outputs()))
            self._kappa = float(torch.sigmoid(network.kappa_logit))
            cells = [cell for cell in network.cells if isinstance(cell, ASLSTM)]
            self._params = [copied_params(cell.params()) for cell in cells]
            self._d_space = network.d_space.detach().clone()
        inside = self._project if isinstance(self._project, Folded) and self._sparse is None else None
        self._features_inside = inside.bias.numel() if inside else 0  # of a projection that `run_cells` computes
        self._weights = flattened_weights(inside, self._params, self._d_space, self._readout)
        self._constants = np.array([net.alpha, net.v_th, self._kappa], np.float32)

    @property
    def reads_counts(self) -> bool:
        """Whether it takes `encoding.to_counts` in less time than `to_spikes`."""
        return self._sparse is not None

    @torch.inference_mode()
    def __call__(self, spikes: Tensor | sparse.Counts, state: NetworkState) -> tuple[Tensor, NetworkState]:
        """Velocities of T consecutive windows, and the state after them.

        Args:
            spikes: (T, B, 2n, H, W), any layout; channels last is read as it lies. An int8 network takes
                `encoding.to_codes` too, and one in float32 `encoding.to_counts`.
            state: of these B streams, the network's or the engine's.

        Returns:
            twists (T, B, n, 6) in scaled units and the next state, as NeuroVE.forward.
        """
        x, membranes = self._features(spikes, state)
        rows, steps = self._rows(x), spikes.shape[0]
        twists, cells, y = (self._plain_cells if is_plain() else self._fused_cells)(rows, steps, state)
        return twists, NetworkState(membranes, cells, y)

    @torch.inference_mode()
    def together(
        self, spikes: Tensor | sparse.Counts, states: Sequence[NetworkState]
    ) -> list[tuple[Tensor, NetworkState]]:
        """One window of each of B streams: the same as a call for each, of eight in 0.8 of the time.

        The feature extractor takes all at once; cells and readout take each stream alone, so that no sum of a stream
        is grouped by what another one does. Answers are those of single calls bit for bit in int8, and over spikes
        alone (sparse.py); a dense convolution of several maps may round otherwise than one of a single map.

        Args:
            spikes: (1, B, 2n, H, W), as in a call.
            states: of the streams, each of a batch of one.

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
            own = tuple(LIFState(membrane.v[b : b + 1].clone()) for membrane in membranes)  # a view would keep all
            answers.append((twists, NetworkState(own, cells, y)))
        return answers

    @torch.inference_mode()
    def features(self, spikes: Tensor | sparse.Counts, state: NetworkState) -> tuple[Tensor, tuple[LIFState, ...]]:
        """Spikes (T * B, C, H', W') of the last map of the feature extractor alone, and its membranes after them."""
        x, membranes = self._features(spikes, state)
        return spike_lists.maps_of(x) if isinstance(x, spike_lists.Fired) else x.float(), membranes

    def _features(
        self, spikes: Tensor | sparse.Counts, state: NetworkState
    ) -> tuple[Tensor | spike_lists.Fired, tuple[LIFState, ...]]:
        if self._sparse is not None and not is_plain():
            return self._sparse(spikes, state.membranes)
        if isinstance(spikes, sparse.Counts):
            spikes = spikes.spikes()
        if self._extractor is not None:
            return self._extractor(spikes.flatten(0, 1), state.membranes)
        x = spikes.flatten(0, 1).contiguous(memory_format=torch.channels_last)
        fire = self._plain_fire if is_plain() else self._fused_fire
        membranes = []
        for convolve, membrane in zip(self._convolutions, state.membranes, strict=True):
            x, after = fire(convolve(x), membrane.v)
            membranes.append(LIFState(after))
        return x, tuple(membranes)

    def _rows(self, x: Tensor | spike_lists.Fired) -> Tensor | Array:
        """What the cells are given of the last map (R, C, H, W): its spikes (R, I), or their projection (R, F)."""
        if isinstance(x, spike_lists.Fired):
            if isinstance(self._project, int8.Projection):
                return self._project(x)
            assert self._sparse is not None  # it made them
            return self._sparse.project(x)
        rows = x.permute(0, 2, 3, 1).flatten(1)  # as it lies in memory
        return self._project(rows) if isinstance(self._project, int8.Projection) else rows

    def _over_lists(self, blocks: list[SpikingBlock], sizes: list[tuple[int, int]]) -> sparse.Extractor | None:
        layers = [
            sparse.Layer(*folded(block.conv.weight, block.norm), convolve, *size)
            for block, convolve, size in zip(blocks, self._convolutions, sizes, strict=False)
        ]
        return sparse.extractor(layers, self._project, self._lif) if isinstance(self._project, Folded) else None

    def _fused_fire(self, currents: Tensor, v: Tensor) -> tuple[Tensor, Tensor]:
        return scan.scan_in_place(currents, v, self._lif.decay, self._lif.v_th)

    def _plain_fire(self, currents: Tensor, v: Tensor) -> tuple[Tensor, Tensor]:
        spikes, after = lif_scan_reference(currents.view(-1, *v.shape), LIFState(v), self._lif)
        return spikes.flatten(0, 1), after.v

    def _fused_cells(
        self, rows: Tensor | Array, steps: int, state: NetworkState
    ) -> tuple[Tensor, tuple[ASLSTMState, ...], Tensor]:
        x: Array = rows.numpy() if isinstance(rows, Tensor) else rows
        carried = torch.stack([field for cell in state.cells for field in cell])  # (3 L, B, N): c, v, s of each layer
        y = state.readout.clone()
        answers = np.empty((steps, *y.shape), np.float32)
        run_cells(x, self._weights, self._features_inside, self._constants, carried.numpy(), y.numpy(), answers)
        fields = carried.unbind()
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


# --- the compiled pass from the last map to the answers ---------------------------------------------------------------
