"""NeuroVE as the service runs it: the norms folded into the weights, each part in its fastest form, same state.

    Engine(network)(spikes, state) -> (twists, state)

is what the network in evaluation mode computes, up to rounding: folding a norm moves the last bits of a current, and a
spike that hangs on them. What holds bit for bit is tested against the engine inside `neurons.plain()`: the same folded
weights through `lif_step`, `aslstm_step` and `readout_step`. State goes to and fro between all of them. Convolutions
and projection are sums over the neurons that fired where widths allow it (sparse.py, sparse_int8.py), else dense.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn.functional import linear

from neurove_core.engine import int8, sparse
from neurove_core.engine.convolution import Convolution, convolution
from neurove_core.networks.neurove import NetworkState, NeuroVE, SpikingBlock
from neurove_core.spiking.aslstm import ASLSTM, ASLSTMParams, ASLSTMState, aslstm_step, readout_step
from neurove_core.spiking.fused import scan
from neurove_core.spiking.fused.activations import fused, sigmoid, tanh
from neurove_core.spiking.lif import LIFParams, LIFState, diffuse, is_plain, lif_scan_reference

Array = NDArray[np.float32]


class Folded(NamedTuple):
    """One layer of weights with the norm that follows it inside."""

    weight: Tensor
    bias: Tensor


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
                    [_int8_layer(block, at=i) for i, block in enumerate(blocks)], sizes, self._lif
                )
            else:
                self._convolutions = [_convolution(block, *size) for block, size in zip(blocks, sizes, strict=False)]
            self._project: Folded | int8.Projection
            if net.precision == "int8":
                self._project = int8.Projection(_int8_projection(network, net.channels[-1], *sizes[-1]))
            else:
                self._project = _projection(network, net.channels[-1], *sizes[-1])
                self._sparse = self._over_lists(blocks, sizes)
            self._readout = Folded(*(tensor.detach().clone() for tensor in network.outputs()))
            self._kappa = float(torch.sigmoid(network.kappa_logit))
            cells = [cell for cell in network.cells if isinstance(cell, ASLSTM)]
            self._params = [_copied(cell.params()) for cell in cells]
            self._d_space = network.d_space.detach().clone()
        inside = self._project if isinstance(self._project, Folded) and self._sparse is None else None
        self._features_inside = inside.bias.numel() if inside else 0  # of a projection that `_cells` computes
        self._weights = _flattened(inside, self._params, self._d_space, self._readout)
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
        return sparse.maps_of(x) if isinstance(x, sparse.Fired) else x.float(), membranes

    def _features(
        self, spikes: Tensor | sparse.Counts, state: NetworkState
    ) -> tuple[Tensor | sparse.Fired, tuple[LIFState, ...]]:
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

    def _rows(self, x: Tensor | sparse.Fired) -> Tensor | Array:
        """What the cells are given of the last map (R, C, H, W): its spikes (R, I), or their projection (R, F)."""
        if isinstance(x, sparse.Fired):
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
        _cells(x, self._weights, self._features_inside, self._constants, carried.numpy(), y.numpy(), answers)
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


def folded(weight: Tensor, norm: nn.BatchNorm1d | nn.BatchNorm2d) -> Folded:
    """Weights whose first axis a norm in evaluation mode follows, with that norm inside.

    gamma (w x - mean) / sqrt(var + eps) + beta = (w k) x + (beta - mean k), k = gamma / sqrt(var + eps); in float64,
    so that folding itself adds one rounding.
    """
    mean, variance, gamma, beta = (
        tensor.double()
        for tensor in (norm.running_mean, norm.running_var, norm.weight, norm.bias)
        if tensor is not None
    )
    k = gamma / torch.sqrt(variance + norm.eps)
    scaled = weight.double() * k.view(-1, *[1] * (weight.dim() - 1))
    return Folded(scaled.to(weight.dtype), (beta - mean * k).to(weight.dtype))


def _convolution(block: SpikingBlock, rows: int, columns: int) -> Convolution:
    return convolution(*folded(block.conv.weight, block.norm), rows, columns)


def _int8_layer(block: SpikingBlock, at: int) -> int8.Layer:
    """A block in whole numbers: the norm's factor takes the step of the weights, and that of the input, with it."""
    weights = int8.quantised(block.conv.weight)
    steps = weights.step.double() / (int8.LEVELS if at == 0 else 1)
    factor, offset = folded(steps.view(-1, 1), block.norm)
    return int8.Layer(weights, factor.view(-1).float(), offset.float())


def _projection(network: NeuroVE, channels: int, rows: int, columns: int) -> Folded:
    """The projection for maps that are flattened with their channels last."""
    weight, bias = folded(network.project.weight, network.project_norm)
    return Folded(weight.view(-1, channels, rows, columns).permute(0, 2, 3, 1).flatten(1).contiguous(), bias)


def _int8_projection(network: NeuroVE, channels: int, rows: int, columns: int) -> int8.Layer:
    """The same in whole numbers; the norm's factor takes the step of the weights with it."""
    (q, step), norm = int8.quantised(network.project.weight), network.project_norm
    factor, offset = folded(step.double().view(-1, 1), norm)
    q = q.view(-1, channels, rows, columns).permute(0, 2, 3, 1).flatten(1)
    return int8.Layer(int8.Quantised(q, step), factor.view(-1).float(), offset.float())


def _copied(params: ASLSTMParams) -> ASLSTMParams:
    w_x, w_v, b, d_time = (tensor.detach().clone() for tensor in (params.w_x, params.w_v, params.b, params.d_time))
    return ASLSTMParams(w_x, w_v, b, d_time, params.alpha, params.v_th)


def _flattened(project: Folded | None, cells: list[ASLSTMParams], d_space: Tensor, readout: Folded) -> Array:
    """All weights of the compiled pass in one vector, in the order in which `_cells` takes them off it.

    Matrices are transposed, so that a row is what one input gives to all outputs; one array is handed over in a few
    microseconds, twenty would take longer than a layer. A projection of its own is none of it.
    """
    tensors = [project.weight.T, project.bias] if project else []
    for params, d in zip(cells, d_space, strict=True):
        tensors += [params.w_x.T, params.w_v.T, params.b, params.d_time, d]
    tensors += [readout.weight.T, readout.bias]
    return torch.cat([tensor.reshape(-1) for tensor in tensors]).numpy()


# --- the compiled pass from the last map to the answers ---------------------------------------------------------------


@fused
def _add_product(x, w, out):  # type: ignore[no-untyped-def]  # compiled for its arguments
    """Out (R, J) += x (R, I) w (I, J), four rows of w at a time, each read once for all R.

    Rows of w that no x asks for are not read: where weights come from far memory, that is most of the time. Every
    out[r, j] is summed in the order of I, whatever the width of the machine's vectors.
    """
    rows, inputs = x.shape
    active = np.empty(inputs, np.int64)
    found = 0
    for i in range(inputs):
        asked = False
        for r in range(rows):
            asked |= x[r, i] != 0
        active[found] = i
        found += asked
    whole = found - found % 4
    for n in range(0, whole, 4):
        i0, i1, i2, i3 = active[n], active[n + 1], active[n + 2], active[n + 3]
        w0, w1, w2, w3 = w[i0], w[i1], w[i2], w[i3]
        for r in range(rows):
            y, x0, x1, x2, x3 = out[r], x[r, i0], x[r, i1], x[r, i2], x[r, i3]
            for j in range(y.size):
                y[j] += x0 * w0[j] + x1 * w1[j] + x2 * w2[j] + x3 * w3[j]
    for n in range(whole, found):
        i = active[n]
        wi = w[i]
        for r in range(rows):
            y, xi = out[r], x[r, i]
            for j in range(y.size):
                y[j] += xi * wi[j]


@fused
def _matrix(weights, at, rows, columns):  # type: ignore[no-untyped-def]  # compiled for its arguments
    """The next matrix of the vector of weights, and where the one after it begins."""
    end = at + rows * columns
    return weights[at:end].reshape(rows, columns), end


@fused
def _rows_of(bias, rows):  # type: ignore[no-untyped-def]  # compiled for its arguments
    """Rows of a bias, to add products to."""
    out = np.empty((rows, bias.size), bias.dtype)
    for r in range(rows):
        for j in range(bias.size):  # assigning a whole row would take seconds to compile
            out[r, j] = bias[j]
    return out


@fused
def _layer(x, weights, at, c, v, s, alpha, v_th):  # type: ignore[no-untyped-def]  # compiled for its arguments
    """One ASLSTM layer over a sequence: inputs (T * B, I) to what goes up (T * B, N); c, v, s (B, N) move on."""
    rows, inputs = x.shape
    batch, hidden = c.shape
    one, none = c.dtype.type(1), c.dtype.type(0)
    w_x, at = _matrix(weights, at, inputs, 5 * hidden)
    w_v, at = _matrix(weights, at, hidden, 4 * hidden)
    b_x, at = _matrix(weights, at, 1, 5 * hidden)
    diffusion, at = _matrix(weights, at, 2, hidden)
    d_time, d_space = diffusion[0], diffusion[1]
    from_x = _rows_of(b_x[0], rows)
    _add_product(x, w_x, from_x)
    up = np.empty((rows, hidden), c.dtype)
    gates, tc = np.empty((batch, 4 * hidden), c.dtype), np.empty((batch, hidden), c.dtype)
    for first in range(0, rows, batch):
        for b in range(batch):
            for j in range(4 * hidden):
                gates[b, j] = from_x[first + b, j]
        _add_product(v, w_v, gates)
        for b in range(batch):
            for j in range(2 * hidden, 3 * hidden):
                gates[b, j] += gates[b, j]  # tanh(g) = 2 sigmoid(2 g) - 1: one pass for all gates
        sigmoid(gates, one, True)
        for b in range(batch):
            for j in range(hidden):
                g = gates[b, 2 * hidden + j] + gates[b, 2 * hidden + j] - one
                c[b, j] = gates[b, hidden + j] * c[b, j] + gates[b, j] * g
                tc[b, j] = c[b, j]
        tanh(tc, True)
        for b in range(batch):
            for j in range(hidden):
                h = gates[b, 3 * hidden + j] * tc[b, j]
                u = alpha * (one - s[b, j]) * h + from_x[first + b, 4 * hidden + j] + d_time[j] * v[b, j]
                fired = one if u - v_th >= none else none
                v[b, j] = u
                s[b, j] = fired
                up[first + b, j] = fired + d_space[j] * u
    return up, at


@fused
def _cells(rows, weights, features, constants, carried, y, answers):  # type: ignore[no-untyped-def]  # compiled for its arguments
    """From the last map's spikes (T * B, cells of it) to answers (T, B, R); features 0: rows are projected already.

    The carried c, v, s of each layer (3 L, B, N) and the potentials y (B, R) of the readout move on in place.
    """
    steps, batch, outputs = answers.shape
    layers, _, hidden = carried.shape
    alpha, v_th, kappa = constants
    x, at = rows, 0
    if features:
        project, at = _matrix(weights, at, rows.shape[1], features)
        bias, at = _matrix(weights, at, 1, features)
        x = _rows_of(bias[0], steps * batch)
        _add_product(rows, project, x)
    for layer in range(0, layers, 3):
        x, at = _layer(x, weights, at, carried[layer], carried[layer + 1], carried[layer + 2], alpha, v_th)
    readout, at = _matrix(weights, at, hidden, outputs)
    bias, at = _matrix(weights, at, 1, outputs)
    from_x = _rows_of(bias[0], steps * batch)
    _add_product(x, readout, from_x)
    for t in range(steps):
        for b in range(batch):
            for k in range(outputs):
                y[b, k] = kappa * y[b, k] + from_x[t * batch + b, k]
                answers[t, b, k] = y[b, k]
