"""The feature extractor and the projection over spike lists, on arrays: compiled, without torch.

The kernels are those of sparse.py and sparse_int8.py, which compare them with torch's dense form. Here they are
compared with plain numpy (array_plain.py), which sums in the same order. Every layer runs over its list, however many
neurons fire.

This module needs vectors.py: import it only where `fallback.vectors_work()`.
"""

import math
from collections.abc import Sequence
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from neurove_core.engine import array_plain, sparse_int8_kernels, sparse_kernels
from neurove_core.engine.array_folding import ArrayLayer
from neurove_core.engine.spike_lists import SpikeList, empty_list, fill_spikes, in_groups, list_of, output_shape
from neurove_core.engine.tiles import tile_of
from neurove_core.engine.vectors import cells_tile, has_byte_products, list_tile
from neurove_core.networks import tables
from neurove_core.networks.arrays import Array

Counts = NDArray[np.uint8]

_CHUNK: Final = 512  # inputs of the projection whose weights stay in the second-level cache
_NO_VALUES: Final = np.empty(0, np.float32)
_NO_COUNTS: Final = np.empty(0, np.uint8)
_EXACT: Final = 1 << 24  # integers below this are exact in float32
_SILENT: Final = np.float32(0), np.float32(np.inf)  # no neuron fires, and the potentials equal the currents


class FirstLayer:
    """The first block: counts (R, C, H, W) to the spikes of (R, H', W', C').

    Args:
        layer: its weights.
        encoding: `encoding` of NetworkConfig.
    """

    def __init__(self, layer: ArrayLayer, encoding: str) -> None:
        self._layer, self._inputs = layer, layer.weight.shape[2]
        self._tile, self._firing = cells_tile(layer.outputs), tile_of(layer.outputs)
        self._table = tables.of_encoding(encoding)
        self._codes = tables.codes_of(encoding)
        if layer.factor is None:
            self._weight: NDArray[Any] = layer.weight.reshape(-1)
        else:
            self._weight = in_groups(layer.weight, 4 if has_byte_products() else 2)

    def __call__(self, counts: Counts, v: Array, decay: np.float32, v_th: np.float32) -> tuple[SpikeList, Array]:
        """Potentials v (B, H', W', C') before the step to spikes and potentials after it."""
        maps, channels, rows, columns = counts.shape
        given = maps, rows, columns, channels
        shape = output_shape(given, (self._inputs, self._layer.outputs), v)
        (indices, starts), after = empty_list(shape), np.empty_like(v)
        factor, offset = self._layer.factor, self._layer.offset
        written: Any = v, after, decay, v_th, indices, starts
        if factor is None:
            layer: Any = given, _NO_VALUES, counts.reshape(-1), self._table, self._weight, offset
            count = sparse_kernels.convolve_values(self._tile, self._firing, *layer, *written)
        else:
            codes = np.empty(counts.size, np.uint8)
            sparse_int8_kernels.look_up(counts.reshape(-1), self._codes, codes)
            weights: Any = self._weight, factor, offset
            count = sparse_int8_kernels.convolve_codes(self._tile, codes.reshape(counts.shape), *weights, *written)
        return SpikeList(indices, starts, shape, count), after

    def agrees(self) -> bool:
        """Whether it equals plain numpy bit for bit, on a small map."""
        rng = np.random.default_rng(0)
        counts = rng.integers(0, 256, (2, self._inputs, 5, 17), dtype=np.uint8)
        counts[0, :, :, 9:] *= rng.random((self._inputs, 5, 8)) < 0.2
        _, found = self(counts, np.zeros((2, 3, 9, self._layer.outputs), np.float32), *_SILENT)
        table = self._table if self._layer.factor is None else self._codes.astype(np.float32)
        maps = np.ascontiguousarray(table[counts].transpose(0, 2, 3, 1))
        return np.array_equal(found, array_plain.convolve(maps, self._layer), equal_nan=True)


class ListLayer:
    """A later block: the spikes of (R, H, W, C) to those of (R, H', W', C').

    Args:
        layer: its weights.
    """

    def __init__(self, layer: ArrayLayer) -> None:
        self._layer, self._widths = layer, (layer.weight.shape[2], layer.outputs)
        self._tile, self._weight = list_tile(layer.outputs), layer.weight.reshape(-1)
        if layer.factor is not None:
            self._weight = np.concatenate([self._weight, np.zeros(layer.outputs, np.int8)])
            wide = layer.weight.astype(np.int32).reshape(-1, layer.outputs)
            ends = wide.clip(min=0).sum(axis=0), wide.clip(max=0).sum(axis=0)
            fits = max(int(np.abs(end).max()) for end in ends) < 1 << 15  # then every partial sum fits into 16 bits
            self._most = 12 * self._widths[0] if fits else sparse_int8_kernels.SHORT

    def __call__(self, spikes: SpikeList, v: Array, decay: np.float32, v_th: np.float32) -> tuple[SpikeList, Array]:
        """Potentials v (B, H', W', C') before the step to spikes and potentials after it."""
        shape = output_shape(spikes.shape, self._widths, v)
        (indices, starts), after = empty_list(shape), np.empty_like(v)
        given = self._tile, spikes.indices, spikes.starts, spikes.shape, self._weight
        written: Any = v, after, decay, v_th, indices, starts
        factor, offset = self._layer.factor, self._layer.offset
        if factor is None:
            count = sparse_kernels.convolve_list(*given, offset, *written)
        else:
            count = sparse_int8_kernels.convolve_list(*given, self._most, factor, offset, *written)
        return SpikeList(indices, starts, shape, count), after

    def agrees(self) -> bool:
        """Whether it equals plain numpy bit for bit, on small maps with few spikes and with all."""
        shape = (2, 5, 7, self._widths[0])
        for count in (70 * self._widths[0] // 7, 70 * self._widths[0]):
            maps = array_plain.maps_of(shape, count, seed=0)
            _, found = self(list_of(maps), np.zeros((2, 3, 4, self._layer.outputs), np.float32), *_SILENT)
            want = array_plain.convolve(maps.astype(np.float32), self._layer)
            if not np.array_equal(found, want, equal_nan=True):
                return False
        return True


class DenseLayer:
    """A later block over all neurons, which is faster where many fire; its sums equal those of `ListLayer`.

    Args:
        layer: its weights.
    """

    def __init__(self, layer: ArrayLayer) -> None:
        self._layer, self._widths = layer, (layer.weight.shape[2], layer.outputs)
        self._tile, self._firing = cells_tile(layer.outputs), tile_of(layer.outputs)
        whole = layer.factor is None
        self._weight = layer.weight.reshape(-1) if whole else in_groups(layer.weight, 4 if has_byte_products() else 2)

    def __call__(self, spikes: SpikeList, v: Array, decay: np.float32, v_th: np.float32) -> tuple[SpikeList, Array]:
        """Potentials v (B, H', W', C') before the step to spikes and potentials after it."""
        shape = output_shape(spikes.shape, self._widths, v)
        (indices, starts), after = empty_list(shape), np.empty_like(v)
        written: Any = v, after, decay, v_th, indices, starts
        factor, offset = self._layer.factor, self._layer.offset
        maps = np.zeros((spikes.shape[0], math.prod(spikes.shape[1:])), np.float32 if factor is None else np.uint8)
        fill_spikes(spikes.indices, spikes.starts, maps)
        if factor is None:
            given: Any = spikes.shape, maps.reshape(-1), _NO_COUNTS, _NO_VALUES, self._weight, offset
            count = sparse_kernels.convolve_values(self._tile, self._firing, *given, *written)
        else:
            codes = np.ascontiguousarray(maps.reshape(spikes.shape).transpose(0, 3, 1, 2))
            count = sparse_int8_kernels.convolve_codes(self._tile, codes, self._weight, factor, offset, *written)
        return SpikeList(indices, starts, shape, count), after


class WideFirstLayer:
    """The first block of an int8 model with its integers in float32, where all sums are exact; see `is_exact`.

    Args:
        layer: its weights, with a factor.
        encoding: `encoding` of NetworkConfig.
    """

    def __init__(self, layer: ArrayLayer, encoding: str) -> None:
        self._layer, self._inputs = layer, layer.weight.shape[2]
        self._tile, self._firing = cells_tile(layer.outputs), tile_of(layer.outputs)
        self._table, self._weight = tables.codes_of(encoding).astype(np.float32), _wide(layer)
        self._none = np.zeros(layer.outputs, np.float32)

    def __call__(self, counts: Counts, v: Array, decay: np.float32, v_th: np.float32) -> tuple[SpikeList, Array]:
        """Potentials v (B, H', W', C') before the step to spikes and potentials after it."""
        maps, channels, rows, columns = counts.shape
        given = maps, rows, columns, channels
        shape = output_shape(given, (self._inputs, self._layer.outputs), v)
        lists, sums = empty_list(shape), np.empty_like(v)
        layer: Any = given, _NO_VALUES, counts.reshape(-1), self._table, self._weight, self._none
        written: Any = np.zeros_like(v), sums, *_SILENT, *lists
        sparse_kernels.convolve_values(self._tile, self._firing, *layer, *written)
        return _fired(self._firing, self._layer, sums, shape, v, decay, v_th)


class WideListLayer:
    """A later block of an int8 model with its integers in float32, where all sums are exact; see `is_exact`.

    Args:
        layer: its weights, with a factor.
    """

    def __init__(self, layer: ArrayLayer) -> None:
        self._layer, self._widths = layer, (layer.weight.shape[2], layer.outputs)
        self._tile, self._firing, self._weight = list_tile(layer.outputs), tile_of(layer.outputs), _wide(layer)
        self._none = np.zeros(layer.outputs, np.float32)

    def __call__(self, spikes: SpikeList, v: Array, decay: np.float32, v_th: np.float32) -> tuple[SpikeList, Array]:
        """Potentials v (B, H', W', C') before the step to spikes and potentials after it."""
        shape = output_shape(spikes.shape, self._widths, v)
        lists, sums = empty_list(shape), np.empty_like(v)
        given: Any = self._tile, spikes.indices, spikes.starts, spikes.shape, self._weight, self._none
        written: Any = np.zeros_like(v), sums, *_SILENT, *lists
        sparse_kernels.convolve_list(*given, *written)
        return _fired(self._firing, self._layer, sums, shape, v, decay, v_th)


def is_exact(layers: Sequence[ArrayLayer]) -> bool:
    """Whether float32 holds every integer sum of these convolutions."""
    tops = [255, *[1] * (len(layers) - 1)]
    return all(_largest_sum(layer) * top < _EXACT for layer, top in zip(layers, tops, strict=True))


def _wide(layer: ArrayLayer) -> Array:
    return layer.weight.astype(np.float32).reshape(-1)


def _fired(
    tile: tuple[int, ...],
    layer: ArrayLayer,
    sums: Array,
    shape: tuple[int, int, int, int],
    v: Array,
    decay: np.float32,
    v_th: np.float32,
) -> tuple[SpikeList, Array]:
    """Spikes and potentials of integer sums in float32."""
    assert layer.factor is not None
    (indices, starts), after = empty_list(shape), np.empty_like(v)
    given = tile, sums.reshape(-1), layer.factor, layer.offset, v, after, decay, v_th, indices, starts
    return SpikeList(indices, starts, shape, sparse_int8_kernels.fire_sums(*given)), after


class ListProjection:
    """The projection: the spikes of (R, H, W, C) to currents (R, F).

    Args:
        layer: its weights (I, F).
    """

    def __init__(self, layer: ArrayLayer) -> None:
        self._layer, self._tile, self._rows = layer, list_tile(layer.outputs), layer.weight.reshape(-1)

    def __call__(self, spikes: SpikeList) -> Array:
        """The currents."""
        maps, height, width, channels = spikes.shape
        out = np.empty((maps, self._layer.outputs), np.float32)
        chunk, factor, offset = max(1, _CHUNK // channels), self._layer.factor, self._layer.offset
        given = self._tile, spikes.indices, spikes.starts, height * width, self._rows
        if factor is None:
            sparse_kernels.project_list(*given, offset, chunk, out)
        else:
            sparse_int8_kernels.project_list(*given, factor, offset, chunk, out)
        return out

    def agrees(self) -> bool:
        """Whether it equals plain numpy bit for bit, for a map of some spikes."""
        maps = array_plain.maps_of((2, 1, 1, len(self._layer.weight)), 2 * 40, seed=0)
        found = self(list_of(maps))
        return np.array_equal(found, array_plain.project(maps, self._layer), equal_nan=True)


def fits(layers: Sequence[ArrayLayer], projection: ArrayLayer) -> bool:
    """Whether the integer sums of all layers are exact in the numbers that the kernels use."""
    if projection.factor is None:
        return True
    first, *_ = layers
    return (
        _largest_sum(first) * 255 < 1 << 31
        and all(_largest_sum(layer) < 1 << 31 for layer in layers)
        and _largest_sum(projection) < 1 << 31
    )


def _largest_sum(layer: ArrayLayer) -> int:
    return int(np.abs(layer.weight.astype(np.int64)).reshape(-1, layer.outputs).sum(axis=0).max())
