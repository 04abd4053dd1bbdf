"""Float32 convolutions and projection over spike lists: only neurons that fired are summed; bit for bit as dense.

A spike is 0 or 1, and most are 0. The dense convolution adds w * x to each sum in the order of rows, columns and
channels, and the bias last. Where x is 0 this changes nothing, where x is 1 it adds w. Adding only the weights of the
neurons that fired, in the same order, gives the same sums. Where one seventh of the neurons fire, this is one seventh
of the work. The layers exchange spike lists, and each neuron fires where its current is summed, so currents are never
written to memory.

The order of sums in oneDNN is not documented. When a model is loaded, each layer is compared with its dense form. Where
one bit differs, the dense layers are used and one warning is logged.

This module needs vectors.py: import it only where `fallback.vectors_work()`.
"""

import math
from collections.abc import Sequence
from typing import Final, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from neurove_core.engine.convolution import LARGE, Convolution
from neurove_core.engine.encoding import CountInput
from neurove_core.engine.fallback import reason_of, warn_once
from neurove_core.engine.sparse_kernels import convolve_list, convolve_values, fire_currents, project_list
from neurove_core.engine.spike_lists import (
    Array,
    SpikeList,
    as_numpy,
    channels_first,
    channels_last,
    empty_list,
    output_shape,
    to_list,
    to_maps,
)
from neurove_core.engine.tiles import LANES, tile_of
from neurove_core.engine.vectors import cells_tile, list_tile
from neurove_core.spiking.lif import LIFParams, LIFState

_MANY: Final = 0.4
"""Share of spikes above which a map is convolved dense: with AVX-512 a large map takes equally long (AVX2: 0.7)."""

_FEW: Final = 1 << 14  # with fewer spikes the list is faster than the start of a dense convolution of a small map


_CHUNK: Final = 512  # inputs of the projection whose weights, 512 KiB for 256 features, stay in the second-level cache


class CountMaps(NamedTuple):
    """Counts of maps (R, C, H, W) with the encoding table: CountInput as the kernels read it."""

    counts: NDArray[np.uint8]
    table: Array


class SparseLayer(NamedTuple):
    """A folded convolution of the feature extractor."""

    weight: Tensor  # (C', C, 3, 3)
    bias: Tensor  # (C')
    dense: Convolution
    rows: int  # rows of the usual input map
    columns: int  # columns of the usual input map


class SparseExtractor:
    """The feature extractor of one network and the projection behind it, over spike lists.

    Args:
        layers: its blocks. The first one reads real values, the others read spikes.
        projection: weight (F, I), inputs in the memory order of the spikes, and bias (F).
        lif: parameters of its neurons.
    """

    def __init__(self, layers: Sequence[SparseLayer], projection: tuple[Tensor, Tensor], lif: LIFParams) -> None:
        self._decay, self._v_th = np.float32(lif.decay), np.float32(lif.v_th)
        self._first, self._layers = FirstConvolution(layers[0]), [ListConvolution(layer) for layer in layers[1:]]
        weight, bias = projection
        self._rows, self._bias, self._tile = weight.T.reshape(-1).numpy(), bias.numpy(), list_tile(bias.numel())

    def __call__(
        self, spikes: Tensor | CountInput, membranes: Sequence[LIFState]
    ) -> tuple[SpikeList, tuple[LIFState, ...]]:
        """Input (T, B, 2n, H, W) to the spikes of the last map, and the membrane potentials after the reset."""
        constants = self._decay, self._v_th
        if isinstance(spikes, CountInput):
            counts = np.ascontiguousarray(as_numpy(spikes.counts))
            given: Array | CountMaps = CountMaps(counts.reshape(-1, *counts.shape[2:]), spikes.table.numpy())
        else:
            x = np.ascontiguousarray(as_numpy(spikes).transpose(0, 1, 3, 4, 2))
            given = x.reshape(-1, *x.shape[2:])
        fired, v = self._first(given, channels_last(membranes[0].v), *constants)
        after = [v]
        for layer, membrane in zip(self._layers, membranes[1:], strict=True):
            fired, v = layer(fired, channels_last(membrane.v), *constants)
            after.append(v)
        return fired, tuple([LIFState(channels_first(v)) for v in after])

    def project(self, spikes: SpikeList) -> Array:
        """The projection (R, F) of each map."""
        maps, rows, columns, channels = spikes.shape
        out = np.empty((maps, self._bias.size), np.float32)
        chunk = max(1, _CHUNK // channels)
        project_list(self._tile, spikes.indices, spikes.starts, rows * columns, self._rows, self._bias, chunk, out)
        return out


def sparse_extractor(
    layers: Sequence[SparseLayer], projection: tuple[Tensor, Tensor], lif: LIFParams
) -> SparseExtractor | None:
    """An extractor over spike lists, or None where a width is no multiple of LANES or a result differs from dense."""
    if any(bias.numel() % LANES for bias in (*(layer.bias for layer in layers), projection[1])):
        return None
    try:
        made = SparseExtractor(layers, projection, lif)
        if all(_agrees(layer, first=layer is layers[0]) for layer in layers) and _projects(made, layers, projection):
            return made
        reason = "its results differ"
    except Exception as error:  # noqa: BLE001  # numba raises anything while it compiles
        reason = reason_of(error)
    warn_once("convolutions over spike lists", reason)
    return None


class FirstConvolution:
    """The first layer: maps (R, H, W, C) of float32 values, or counts, to the spikes of (R, H', W', C')."""

    def __init__(self, layer: SparseLayer) -> None:
        self._weight, self._bias = _by_input(layer.weight), layer.bias.numpy()
        self._widths = layer.weight.shape[1], layer.weight.shape[0]
        self._tile, self._firing = cells_tile(self._bias.size), tile_of(self._bias.size)

    def __call__(self, x: Array | CountMaps, v: Array, decay: np.float32, v_th: np.float32) -> tuple[SpikeList, Array]:
        """Potentials v (B, H', W', C') before the step to spikes and potentials after it."""
        if isinstance(x, CountMaps):
            maps, channels, rows, columns = x.counts.shape
            whole, given = (maps, rows, columns, channels), (_NO_VALUES, x.counts.reshape(-1), x.table)
        else:
            whole, given = x.shape, (x.reshape(-1), _NO_COUNTS, _NO_VALUES)
        shape = output_shape(whole, self._widths, v)
        (indices, starts), after = empty_list(shape), np.empty_like(v)
        layer = self._tile, self._firing, whole, *given, self._weight, self._bias
        count = convolve_values(*layer, v, after, decay, v_th, indices, starts)
        return SpikeList(indices, starts, shape, count), after


_NO_VALUES, _NO_COUNTS = np.empty(0, np.float32), np.empty(0, np.uint8)


class ListConvolution:
    """A layer over a spike list: spikes of (R, H, W, C) to the spikes of (R, H', W', C')."""

    def __init__(self, layer: SparseLayer) -> None:
        self._dense = layer.dense
        self._weight, self._bias = _by_input(layer.weight), layer.bias.numpy()
        self._widths = layer.weight.shape[1], layer.weight.shape[0]
        self._tile = list_tile(self._bias.size)

    def __call__(self, spikes: SpikeList, v: Array, decay: np.float32, v_th: np.float32) -> tuple[SpikeList, Array]:
        """Potentials v (B, H', W', C') before the step to spikes and potentials after it; dense for many spikes."""
        if spikes.total > max(_FEW, _MANY * math.prod(spikes.shape)):
            output_shape(spikes.shape, self._widths, v)
            return _fire(self._dense(to_maps(spikes)), v, decay, v_th)
        return self.over_list(spikes, v, decay, v_th)

    def over_list(self, spikes: SpikeList, v: Array, decay: np.float32, v_th: np.float32) -> tuple[SpikeList, Array]:
        """The same result, always over the list."""
        shape = output_shape(spikes.shape, self._widths, v)
        (indices, starts), after = empty_list(shape), np.empty_like(v)
        given = self._tile, spikes.indices, spikes.starts, spikes.shape, self._weight, self._bias
        count = convolve_list(*given, v, after, decay, v_th, indices, starts)
        return SpikeList(indices, starts, shape, count), after


def _by_input(weight: Tensor) -> Array:
    """Weights (C', C, 3, 3) as rows, one for each input of the kernel, with its weights to all C'."""
    return weight.permute(2, 3, 1, 0).reshape(-1).numpy()


def _fire(currents: Tensor, v: Array, decay: np.float32, v_th: np.float32) -> tuple[SpikeList, Array]:
    """Spikes of currents (R, C, H, W), and the potentials (B, H, W, C) that follow v."""
    rows = channels_last(currents)
    (indices, starts), after = empty_list(rows.shape), np.empty_like(v)
    channels = rows.shape[3]
    count = fire_currents(tile_of(channels), rows.reshape(-1), channels, v, after, decay, v_th, indices, starts)
    return SpikeList(indices, starts, rows.shape, count), after


@torch.inference_mode()
def _agrees(layer: SparseLayer, *, first: bool) -> bool:
    """Whether a layer equals its dense form bit for bit: few inputs and all, one map and, where small, three."""
    generator = torch.Generator().manual_seed(0)
    outputs, inputs = layer.weight.shape[:2]
    silent = np.float32(0), np.float32(np.inf)  # no neuron fires, and the potentials equal the currents
    for count in (1, 3) if inputs * layer.rows * layer.columns <= LARGE else (1,):
        for share in (0.15, 1.0):
            drawn = torch.rand(2, count, layer.rows, layer.columns, inputs, generator=generator)
            x = ((drawn[0] < share) * (drawn[1] if first else 1.0)).permute(0, 3, 1, 2)
            v = np.zeros((count, (layer.rows + 1) // 2, (layer.columns + 1) // 2, outputs), np.float32)
            if first:
                _, found = FirstConvolution(layer)(channels_last(x), v, *silent)
            else:
                _, found = ListConvolution(layer).over_list(to_list(x), v, *silent)
            if not torch.equal(channels_first(found), layer.dense(x)):
                return False
    return True


@torch.inference_mode()
def _projects(made: SparseExtractor, layers: Sequence[SparseLayer], projection: tuple[Tensor, Tensor]) -> bool:
    """Whether the projection over a list equals the dense one up to rounding, for a map with three spikes."""
    weight, bias = projection
    channels = layers[-1].weight.shape[0]
    if weight.shape[1] % channels:
        return True  # a projection of other maps, whose shape is not known here
    x = torch.zeros(weight.shape[1])
    x[:: max(1, x.numel() // 3)] = 1
    got = torch.from_numpy(made.project(to_list(x.view(1, -1, 1, channels).permute(0, 3, 1, 2))))[0]
    want = weight @ x + bias
    return torch.allclose(got, want, rtol=1e-4, atol=1e-4 * float(want.nan_to_num().abs().max()), equal_nan=True)
