"""Int8 convolutions and projection over spike lists: the sums of int8.py, as sparse.py computes them in float32.

Weights are added for each spike, in 16 bits over few inputs and in 32 bits over all. Integer sums are exact in any
order, so the results equal the dense form bit for bit. The first layer reads 8-bit codes. It uses the processor's dot
product of four codes where there is one, else that of two numbers of 16 bits, for six output cells at a time, as
sparse.FirstConvolution does.

When a model is loaded, each layer is compared with the plain sums. Where one differs, or where a width is no multiple
of LANES, the dense layers are used.

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
from neurove_core.engine.fallback import reason_of, warn_once
from neurove_core.engine.sparse_int8_kernels import (
    SHORT,
    Codes,
    convolve_codes,
    convolve_list,
    fire_sums,
    project_list,
)
from neurove_core.engine.spike_lists import (
    Array,
    SpikeList,
    channels_first,
    channels_last,
    empty_list,
    in_groups,
    output_shape,
    to_list,
    to_maps,
)
from neurove_core.engine.tiles import LANES, tile_of
from neurove_core.engine.vectors import cells_tile, has_byte_products, list_tile
from neurove_core.spiking.lif import LIFParams, LIFState

_MANY: Final = 0.45
"""Share of spikes above which a large map is convolved dense; for small maps both take as long at 0.7."""

_FEW: Final = 1 << 14  # as in sparse.py

_CHUNK: Final = 512  # as in sparse.py: inputs of the projection whose weights stay in the cache


class SparseInt8Layer(NamedTuple):
    """A convolution of the feature extractor with int8 weights."""

    q: Tensor  # (C', C, 3, 3) int8
    factor: Tensor  # (C') float32
    offset: Tensor  # (C') float32
    dense: Convolution  # the dense form of its integer sums
    rows: int  # rows of the usual input map
    columns: int  # columns of the usual input map


class SparseInt8Extractor:
    """The feature extractor of one network in 8-bit integers, over spike lists.

    Args:
        layers: its blocks. The first one reads codes, the others read spikes.
        lif: parameters of its neurons.
    """

    def __init__(self, layers: Sequence[SparseInt8Layer], lif: LIFParams) -> None:
        self._decay, self._v_th = np.float32(lif.decay), np.float32(lif.v_th)
        self._first, self._layers = (
            Int8FirstConvolution(layers[0]),
            [Int8ListConvolution(layer) for layer in layers[1:]],
        )

    def __call__(self, codes: Tensor, membranes: Sequence[LIFState]) -> tuple[SpikeList, tuple[LIFState, ...]]:
        """Codes (T * B, 2n, H, W), uint8, to the spikes of the last map, and the potentials after the reset."""
        constants = self._decay, self._v_th
        fired, v = self._first(np.ascontiguousarray(codes.numpy()), channels_last(membranes[0].v), *constants)
        after = [v]
        for layer, membrane in zip(self._layers, membranes[1:], strict=True):
            fired, v = layer(fired, channels_last(membrane.v), *constants)
            after.append(v)
        return fired, tuple([LIFState(channels_first(v)) for v in after])


def sparse_int8_extractor(layers: Sequence[SparseInt8Layer], lif: LIFParams) -> SparseInt8Extractor | None:
    """An extractor over spike lists, or None where a width is no multiple of LANES or a result differs from dense."""
    if any(layer.q.shape[0] % LANES for layer in layers):
        return None
    try:
        made = SparseInt8Extractor(layers, lif)
        if all(_agrees(layer, first=layer is layers[0]) for layer in layers):
            return made
        reason = "its results differ"
    except Exception as error:  # noqa: BLE001  # numba raises anything while it compiles
        reason = reason_of(error)
    warn_once("8-bit convolutions over spike lists", reason)
    return None


class Int8DenseConvolution:
    """A layer by its dense sums: maps (R, C, H, W) of codes, in any layout, to the spikes of (R, H', W', C')."""

    def __init__(self, layer: SparseInt8Layer) -> None:
        self._dense, self._factor, self._offset = layer.dense, layer.factor.numpy(), layer.offset.numpy()
        self._widths = layer.q.shape[1], layer.q.shape[0]
        self._tile = tile_of(self._factor.size)

    def __call__(self, x: Codes, v: Array, decay: np.float32, v_th: np.float32) -> tuple[SpikeList, Array]:
        """Potentials v (B, H', W', C') before the step to spikes and potentials after it."""
        shape = output_shape(cells_shape(x), self._widths, v)
        sums = channels_last(self._dense(torch.from_numpy(x).contiguous(memory_format=torch.channels_last)))
        (indices, starts), after = empty_list(shape), np.empty_like(v)
        given = self._tile, sums.reshape(-1), self._factor, self._offset
        return SpikeList(indices, starts, shape, fire_sums(*given, v, after, decay, v_th, indices, starts)), after


class Int8FirstConvolution:
    """The first layer by dot products: maps (R, C, H, W) of codes, contiguous, to the spikes of (R, H', W', C')."""

    def __init__(self, layer: SparseInt8Layer) -> None:
        outputs, inputs = layer.q.shape[:2]
        self._weight = in_groups(layer.q.permute(2, 3, 1, 0).numpy(), 4 if has_byte_products() else 2)
        self._factor, self._offset = layer.factor.numpy(), layer.offset.numpy()
        self._widths = inputs, outputs
        self._tile = cells_tile(outputs)

    def __call__(self, x: Codes, v: Array, decay: np.float32, v_th: np.float32) -> tuple[SpikeList, Array]:
        """Potentials v (B, H', W', C') before the step to spikes and potentials after it."""
        shape = output_shape(cells_shape(x), self._widths, v)
        (indices, starts), after = empty_list(shape), np.empty_like(v)
        given = self._tile, x, self._weight, self._factor, self._offset
        count = convolve_codes(*given, v, after, decay, v_th, indices, starts)
        return SpikeList(indices, starts, shape, count), after


def cells_shape(maps: Codes) -> tuple[int, int, int, int]:
    """(R, H, W, C) of maps (R, C, H, W)."""
    count, channels, rows, columns = maps.shape
    return count, rows, columns, channels


class Int8ListConvolution:
    """A layer over a spike list: spikes of (R, H, W, C) to the spikes of (R, H', W', C')."""

    def __init__(self, layer: SparseInt8Layer) -> None:
        self._dense = Int8DenseConvolution(layer)
        outputs, inputs = layer.q.shape[:2]
        self._weight = torch.cat([layer.q.permute(2, 3, 1, 0).reshape(-1), layer.q.new_zeros(outputs)]).numpy()
        ends = layer.q.int().clamp(min=0), layer.q.int().clamp(max=0)
        fits = max(int(end.flatten(1).sum(dim=1).abs().max()) for end in ends) < 1 << 15  # then every partial sum fits
        self._most = 12 * inputs if fits else SHORT
        self._factor, self._offset = layer.factor.numpy(), layer.offset.numpy()
        self._widths = inputs, outputs
        self._tile = list_tile(outputs)

    def __call__(self, spikes: SpikeList, v: Array, decay: np.float32, v_th: np.float32) -> tuple[SpikeList, Array]:
        """Potentials v (B, H', W', C') before the step to spikes and potentials after it; dense for many spikes."""
        if spikes.total > max(_FEW, _MANY * math.prod(spikes.shape)):
            return self._dense(to_maps(spikes, np.uint8).numpy(), v, decay, v_th)
        return self.over_list(spikes, v, decay, v_th)

    def over_list(self, spikes: SpikeList, v: Array, decay: np.float32, v_th: np.float32) -> tuple[SpikeList, Array]:
        """The same result, always over the list."""
        shape = output_shape(spikes.shape, self._widths, v)
        (indices, starts), after = empty_list(shape), np.empty_like(v)
        given = self._tile, spikes.indices, spikes.starts, spikes.shape, self._weight, self._most
        count = convolve_list(*given, self._factor, self._offset, v, after, decay, v_th, indices, starts)
        return SpikeList(indices, starts, shape, count), after


def project(spikes: SpikeList, rows: NDArray[np.int8], factor: Array, offset: Array) -> Array:
    """Currents (R, F) of each map: the sum of the rows (I, F) of its spikes, times factor (F) plus offset (F)."""
    maps, height, width, channels = spikes.shape
    currents = np.empty((maps, factor.size), np.float32)
    chunk = max(1, _CHUNK // channels)
    given = list_tile(factor.size), spikes.indices, spikes.starts, height * width, rows.reshape(-1), factor, offset
    project_list(*given, chunk, currents)
    return currents


def projects(rows: NDArray[np.int8], factor: Array, offset: Array) -> bool:
    """Whether `project` is exact on this machine, for a map with three spikes; it also compiles the kernel."""
    inputs = rows.shape[0]
    x = np.zeros((1, 1, 1, inputs), np.uint8)
    x[..., :: max(1, inputs // 3)] = 1
    sums = rows[x.reshape(-1) != 0].astype(np.int64).sum(axis=0)
    got = project(to_list(torch.from_numpy(x).permute(0, 3, 1, 2)), rows, factor, offset)
    return np.array_equal(got[0], sums.astype(np.float32) * factor + offset, equal_nan=True)


@torch.inference_mode()
def _agrees(layer: SparseInt8Layer, *, first: bool) -> bool:
    """Whether a layer equals the plain form bit for bit: few inputs and all, one map and, where small, three."""
    generator = torch.Generator().manual_seed(0)
    outputs, inputs = layer.q.shape[:2]
    top = 255 if first else 1
    silent = np.float32(0), np.float32(np.inf)  # no neuron fires, and the potentials equal the currents
    factor, offset = layer.factor.view(-1, 1, 1), layer.offset.view(-1, 1, 1)
    for count in (1, 3) if inputs * layer.rows * layer.columns <= LARGE else (1,):
        for share in (0.15, 1.0):
            drawn = torch.rand(2, count, layer.rows, layer.columns, inputs, generator=generator)
            x = ((drawn[0] < share) * (1 + drawn[1] * top).clamp_(max=top)).to(torch.uint8)
            v = np.zeros((count, (layer.rows + 1) // 2, (layer.columns + 1) // 2, outputs), np.float32)
            maps = x.permute(0, 3, 1, 2)
            if first:
                _, found = Int8FirstConvolution(layer)(maps.contiguous().numpy(), v, *silent)
            else:
                _, found = Int8ListConvolution(layer).over_list(to_list(maps), v, *silent)
            if not torch.equal(channels_first(found), layer.dense(maps) * factor + offset):
                return False
    return True
