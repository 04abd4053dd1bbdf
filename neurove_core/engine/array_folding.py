"""Batch norms folded into the weights before them, on arrays: as folding.py, bit for bit, without torch."""

from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from neurove_core.engine.tiles import LANES
from neurove_core.networks import tables
from neurove_core.networks.arrays import Array, Weights, map_sizes

_EPS: Final = 1e-5  # of torch's batch norms


class ArrayLayer(NamedTuple):
    """A layer of weights with its norm: kernel rows (3, 3, C, C') of a convolution, or (I, F) of the projection.

    Its current is sum * factor + offset; a float32 layer has its factor within the weights, and factor None. Output
    channels, and input channels after the first layer, are filled with zeros up to a multiple of LANES. Such neurons
    never fire, so the sums of the others stay the same.
    """

    weight: NDArray[Any]  # float32, or int8
    factor: Array | None
    offset: Array

    @property
    def outputs(self) -> int:
        """Number of output channels, with those that fill it up."""
        return self.offset.size


class Cell(NamedTuple):
    """Weights of an ASLSTM layer, as `ASLSTMParams` names them."""

    w_x: Array
    w_v: Array
    b: Array
    d_time: Array


class Linear(NamedTuple):
    """Weight (R, N) and bias (R)."""

    weight: Array
    bias: Array


def filled(count: int) -> int:
    """The next multiple of LANES."""
    return -(-count // LANES) * LANES


def convolutions(weights: Weights) -> list[ArrayLayer]:
    """The blocks of the feature extractor."""
    found = []
    for at in range(len(weights.config.network.channels)):
        weight = weights.tensors[f"blocks.{at}.conv.weight"]
        steps = tables.LEVELS if at == 0 else 1
        folded, factor, offset = _folded(weights, weight, f"blocks.{at}.norm", steps)
        rows = folded.transpose(2, 3, 1, 0)
        inputs = rows.shape[2] if at == 0 else filled(rows.shape[2])
        found.append(_layer(rows, (3, 3, inputs, filled(rows.shape[3])), factor, offset))
    return found


def projection(weights: Weights) -> ArrayLayer:
    """The projection, for maps that are flattened with channels last."""
    channels, (rows, columns) = weights.config.network.channels[-1], map_sizes(weights.config)[-1]
    folded, factor, offset = _folded(weights, weights.tensors["project.weight"], "project_norm", 1)
    cells = folded.reshape(-1, channels, rows, columns).transpose(2, 3, 1, 0)
    features = filled(cells.shape[3])
    layer = _layer(cells, (rows, columns, filled(channels), features), factor, offset)
    return layer._replace(weight=layer.weight.reshape(-1, features))


def cells(weights: Weights) -> list[Cell]:
    """The ASLSTM layers."""
    hidden = weights.config.network.hidden
    found = []
    for at in range(weights.config.network.cells):
        w_x, w_v, b = (weights.tensors[f"cells.{at}.{name}"] for name in ("w_x", "w_v", "b"))
        found.append(Cell(w_x, w_v, b, weights.tensors.get(f"cells.{at}.d_time", np.zeros(hidden, np.float32))))
    return found


def between(weights: Weights) -> Array:
    """Diffusion (L, N) from each ASLSTM layer to the next one."""
    net = weights.config.network
    return np.asarray(weights.tensors.get("d_space", np.zeros((net.cells, net.hidden), np.float32)))


def readout(weights: Weights) -> Linear:
    """All output neurons."""
    names = ("readout", "spread") if weights.spread else ("readout",)
    parts = [[weights.tensors[f"{name}.{part}"] for name in names] for part in ("weight", "bias")]
    return Linear(np.concatenate(parts[0]), np.concatenate(parts[1]))


def _folded(weights: Weights, weight: Array, norm: str, steps: int) -> tuple[NDArray[Any], Array | None, Array]:
    """Weights, factor and offset with a norm folded in, in float64 and rounded once.

    gamma (w x - mean) / sqrt(var + eps) + beta = (w k) x + (beta - mean k), k = gamma / sqrt(var + eps).
    """
    gamma, beta, mean, variance = (
        weights.tensors[f"{norm}.{part}"].astype(np.float64)
        for part in ("weight", "bias", "running_mean", "running_var")
    )
    with np.errstate(all="ignore"):  # a broken norm gives nan, which the warm-up reports
        k = gamma / np.sqrt(variance + _EPS)
        offset = (beta - mean * k).astype(np.float32)
        if weights.config.network.precision == "int8":
            q, step = tables.quantised(weight)
            return q, (step.astype(np.float64) / steps * k).astype(np.float32), offset
        scaled = weight.astype(np.float64) * k.reshape(-1, *[1] * (weight.ndim - 1))
        return scaled.astype(np.float32), None, offset


def _layer(rows: NDArray[Any], shape: tuple[int, ...], factor: Array | None, offset: Array) -> ArrayLayer:
    """A layer with its rows in the corner of zeros of this shape."""
    whole = np.zeros(shape, rows.dtype)
    whole[tuple(slice(size) for size in rows.shape)] = rows
    padding = (0, shape[-1] - offset.size)
    return ArrayLayer(whole, None if factor is None else np.pad(factor, padding), np.pad(offset, padding))
