"""The reference implementation of array_fast.py in plain numpy: the same sums in the same order."""

import math

import numpy as np
from numpy.typing import NDArray

from neurove_core.engine.array_folding import ArrayLayer, Cell, Linear
from neurove_core.networks.arrays import Array

Maps = NDArray[np.uint8]


def convolve(maps: Array, layer: ArrayLayer) -> Array:
    """Currents (R, H', W', C') of maps (R, H, W, C), channels last: 3x3, stride 2, zero padding of 1.

    In float32 each product is added with one rounding (a fused multiply-add, here in float64), in the order of rows,
    columns and channels, and the offset last. In int8 the sum is exact.
    """
    count, rows, columns, inputs = maps.shape
    size = (rows + 1) // 2, (columns + 1) // 2
    padded = np.zeros((count, 2 * size[0] + 1, 2 * size[1] + 1, inputs))
    padded[:, 1 : rows + 1, 1 : columns + 1] = maps
    weight = layer.weight.astype(np.float64)
    sums = np.zeros((count, *size, layer.outputs), np.float64 if layer.factor is not None else np.float32)
    for y in range(3):
        for x in range(3):
            part = padded[:, y : y + 2 * size[0] : 2, x : x + 2 * size[1] : 2]
            if layer.factor is not None:
                sums += part @ weight[y, x]
                continue
            for channel in range(inputs):
                sums = (sums + part[..., channel : channel + 1] * weight[y, x, channel]).astype(np.float32)
    return _current(sums, layer)


def fire(currents: Array, v: Array, decay: np.float32, v_th: np.float32) -> tuple[NDArray[np.bool_], Array]:
    """One LIF step: spikes, and potentials after the reset; as `lif_step`."""
    u = decay * v + currents
    spikes = u - v_th >= 0
    return spikes, u * (np.float32(1) - spikes.astype(np.float32))


def project(spikes: NDArray[np.bool_], layer: ArrayLayer) -> Array:
    """Currents (R, F) of spikes (R, H, W, C): in float32 the offset first, then the rows of the spikes in order."""
    rows = spikes.reshape(spikes.shape[0], -1)
    if layer.factor is not None:
        sums = np.stack([layer.weight[row].sum(axis=0, dtype=np.int64) for row in rows])
        return _current(sums, layer)
    out = np.repeat(layer.offset[None], len(rows), axis=0)
    for total, row in zip(out, rows, strict=True):
        for at in np.flatnonzero(row):
            total += layer.weight[at]
    return out


def run_cells(
    x: Array, cells: list[Cell], between: Array, readout: Linear, constants: Array, state: Array, y: Array
) -> Array:
    """From the projection (1, F) to the outputs (1, R), by `aslstm_step`, `diffuse` and `readout_step`.

    Args:
        x: of the projection.
        cells: weights of the layers.
        between: diffusion (L, N) to the next layer.
        readout: of the output neurons.
        constants: alpha, v_th and kappa.
        state: c, v, s of each layer (3 L, 1, N), updated in place.
        y: potentials (1, R) of the output neurons, updated in place.
    """
    alpha, v_th, kappa = constants
    for at, (cell, d) in enumerate(zip(cells, between, strict=True)):
        c, v, s = state[3 * at : 3 * at + 3]
        from_x = x @ cell.w_x.T + cell.b
        i, f, g, o, rest = np.split(from_x, 5, axis=1)
        of_v = np.split(v @ cell.w_v.T, 4, axis=1)
        c[:] = _sigmoid(f + of_v[1]) * c + _sigmoid(i + of_v[0]) * np.tanh(g + of_v[2])
        h = _sigmoid(o + of_v[3]) * np.tanh(c)
        v[:] = alpha * (np.float32(1) - s) * h + rest + cell.d_time * v
        s[:] = v - v_th >= 0
        x = s + d * v
    y[:] = kappa * y + (x @ readout.weight.T + readout.bias)
    return y.copy()


def maps_of(shape: tuple[int, ...], spikes: int, seed: int) -> NDArray[np.bool_]:
    """Random maps of this shape with about so many spikes, to try a form with."""
    rng = np.random.default_rng(seed)
    found: NDArray[np.bool_] = rng.random(shape) < spikes / math.prod(shape)
    return found


def _current(sums: NDArray[np.generic], layer: ArrayLayer) -> Array:
    whole = sums.astype(np.float32)
    return whole + layer.offset if layer.factor is None else whole * layer.factor + layer.offset


def _sigmoid(x: Array) -> Array:
    with np.errstate(over="ignore"):
        return np.float32(1) / (np.float32(1) + np.exp(-x))
