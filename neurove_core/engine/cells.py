"""The compiled pass from the last feature map to the twists: projection, ASLSTM layers and readout."""

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from neurove_core.spiking.fused.activations import fused, sigmoid, tanh

if TYPE_CHECKING:  # this module needs no torch
    from neurove_core.spiking.aslstm import ASLSTMParams

Array = NDArray[np.float32]


def copied_params(params: "ASLSTMParams") -> "ASLSTMParams":
    """A copy of a cell's weights, independent of later changes of the network."""
    w_x, w_v, b, d_time = (tensor.detach().clone() for tensor in (params.w_x, params.w_v, params.b, params.d_time))
    return params._replace(w_x=w_x, w_v=w_v, b=b, d_time=d_time)


def flattened_weights(project: Any, cells: Sequence[Any], d_space: Any, readout: Any) -> Array:
    """All weights of the compiled pass in one vector, in the order in which `run_cells` reads them.

    Matrices are transposed, so that a row has the weights of one input to all outputs. Passing one array to compiled
    code takes a few microseconds; twenty arrays would take longer than a layer.

    Args:
        project: the projection, with weight (F, I) and bias (F); None where the rows are projected elsewhere.
        cells: of each layer w_x (5N, I), w_v (4N, N), b (5N) and d_time (N), as arrays or as tensors on the CPU.
        d_space: diffusion (L, N) to the next layer.
        readout: weight (R, N) and bias (R).
    """
    parts = [project.weight.T, project.bias] if project else []
    for params, d in zip(cells, d_space, strict=True):
        parts += [params.w_x.T, params.w_v.T, params.b, params.d_time, d]
    parts += [readout.weight.T, readout.bias]
    return np.concatenate([np.asarray(part).reshape(-1) for part in parts])


@fused
def _add_product(x, w, out):  # type: ignore[no-untyped-def]  # compiled for its arguments
    """Out (R, J) += x (R, I) w (I, J), four rows of w at a time, each read once for all R.

    Rows of w whose inputs are all 0 are not read, because reading weights from main memory takes most of the time.
    Every out[r, j] is summed in the order of I, for any width of the machine's vectors.
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
    """The next matrix of the vector of weights, and the index behind it."""
    end = at + rows * columns
    return weights[at:end].reshape(rows, columns), end


@fused
def _rows_of(bias, rows):  # type: ignore[no-untyped-def]  # compiled for its arguments
    """Copies of a bias as rows, to which products are added."""
    out = np.empty((rows, bias.size), bias.dtype)
    for r in range(rows):
        for j in range(bias.size):  # assigning a row at once would take seconds to compile
            out[r, j] = bias[j]
    return out


@fused
def _layer(x, weights, at, c, v, s, alpha, v_th):  # type: ignore[no-untyped-def]  # compiled for its arguments
    """One ASLSTM layer over a sequence: inputs (T * B, I) to outputs (T * B, N); updates c, v, s (B, N) in place."""
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
                gates[b, j] += gates[b, j]  # tanh(g) = 2 sigmoid(2 g) - 1, so that one pass computes all gates
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
def run_cells(rows, weights, features, constants, state, y, answers):  # type: ignore[no-untyped-def]  # compiled for its arguments
    """From the last map's spikes (T * B, I), or with features 0 from their projection, to outputs (T, B, R).

    The state c, v, s of each layer (3 L, B, N) and the potentials y (B, R) of the readout are updated in place.
    """
    steps, batch, outputs = answers.shape
    layers, _, hidden = state.shape
    alpha, v_th, kappa = constants
    x, at = rows, 0
    if features:
        project, at = _matrix(weights, at, rows.shape[1], features)
        bias, at = _matrix(weights, at, 1, features)
        x = _rows_of(bias[0], steps * batch)
        _add_product(rows, project, x)
    for layer in range(0, layers, 3):
        x, at = _layer(x, weights, at, state[layer], state[layer + 1], state[layer + 2], alpha, v_th)
    readout, at = _matrix(weights, at, hidden, outputs)
    bias, at = _matrix(weights, at, 1, outputs)
    from_x = _rows_of(bias[0], steps * batch)
    _add_product(x, readout, from_x)
    for t in range(steps):
        for b in range(batch):
            for k in range(outputs):
                y[b, k] = kappa * y[b, k] + from_x[t * batch + b, k]
                answers[t, b, k] = y[b, k]
