"""Convolutions and projection over the neurons that fired, and no others: as the dense ones in float32, bit for bit.

A spike is 0 or 1, and most are 0. The dense convolution adds w * x to each sum in the order of rows, columns and
channels, and the bias last; where x is 0 that changes nothing, where it is 1 it adds w. So adding the weights of those
that fired, in the same order, gives the same sums, with a seventh of the work where a seventh fires. Between layers
goes a list of who fired. Neurons fire where their current is summed up: it never goes to memory.

Which order oneDNN takes is written nowhere: at load each layer is tried against its dense form, and where one bit
differs the dense ones serve, slower; that is said once in the log.
"""

import math
from collections.abc import Sequence
from typing import Any, Final, NamedTuple

import numpy as np
import torch
from numba.core.errors import NumbaError
from numpy.typing import NDArray
from torch import Tensor

from neurove_core.compiled import compiled
from neurove_core.engine.convolution import LARGE, Convolution, say_once
from neurove_core.engine.spike_lists import (
    Array,
    Fired,
    Places,
    allocate_list,
    cells_of,
    in_maps,
    listed,
    maps_of,
    shape_after,
    values_of,
)
from neurove_core.engine.vectors import LANES, entry, fire, nothing, plus, plus_product, put, put_floats, tile_of
from neurove_core.spiking.lif import LIFParams, LIFState

_MANY: Final = 0.4
"""Share of spikes from which maps are convolved dense: with AVX-512 large ones take as long then (with AVX2 at 0.7)."""

_FEW: Final = 1 << 14  # that fired: fewer are summed up sooner than a dense convolution of a small map has begun


_CHUNK: Final = 512  # inputs of the projection whose weights, 512 KiB for 256 features, stay in the second cache


class Counts(NamedTuple):
    """Input as counts, each for its entry of a table: encoded row by row as the first layer reads it."""

    counts: Tensor  # (T, B, 2n, H, W) uint8
    table: Tensor  # (256) float32

    @property
    def shape(self) -> torch.Size:
        """Of the input."""
        return self.counts.shape

    def spikes(self) -> Tensor:
        """The input itself."""
        return self.table[self.counts.to(torch.int64)]


class Counted(NamedTuple):
    """The same, of maps (R, C, H, W)."""

    counts: NDArray[np.uint8]
    table: Array


class Layer(NamedTuple):
    """A folded convolution of the extractor."""

    weight: Tensor  # (C', C, 3, 3)
    bias: Tensor  # (C')
    dense: Convolution
    rows: int  # of the map that it mostly sees
    columns: int


class Extractor:
    """The feature extractor of one network and the projection behind it, over lists of who fired.

    Args:
        layers: its blocks; the first sees numbers, the others spikes.
        projection: weight (F, I), in the order in which spikes lie in memory, and bias (F).
        lif: of its neurons.
    """

    def __init__(self, layers: Sequence[Layer], projection: tuple[Tensor, Tensor], lif: LIFParams) -> None:
        self._decay, self._v_th = np.float32(lif.decay), np.float32(lif.v_th)
        self._first, self._layers = OverValues(layers[0]), [OverList(layer) for layer in layers[1:]]
        weight, bias = projection
        self._rows, self._bias, self._tile = weight.T.reshape(-1).numpy(), bias.numpy(), tile_of(bias.numel())

    def __call__(self, spikes: Tensor | Counts, membranes: Sequence[LIFState]) -> tuple[Fired, tuple[LIFState, ...]]:
        """Input (T, B, 2n, H, W) to who fired in the last map, and the potentials after the last reset."""
        constants = self._decay, self._v_th
        if isinstance(spikes, Counts):
            counts = np.ascontiguousarray(values_of(spikes.counts))
            given: Array | Counted = Counted(counts.reshape(-1, *counts.shape[2:]), spikes.table.numpy())
        else:
            x = np.ascontiguousarray(values_of(spikes).transpose(0, 1, 3, 4, 2))
            given = x.reshape(-1, *x.shape[2:])
        fired, v = self._first(given, cells_of(membranes[0].v), *constants)
        after = [v]
        for layer, membrane in zip(self._layers, membranes[1:], strict=True):
            fired, v = layer(fired, cells_of(membrane.v), *constants)
            after.append(v)
        return fired, tuple([LIFState(in_maps(v)) for v in after])

    def project(self, fired: Fired) -> Array:
        """What the projection makes of each map (R, F)."""
        maps, rows, columns, channels = fired.shape
        out = np.empty((maps, self._bias.size), np.float32)
        chunk = max(1, _CHUNK // channels)
        _project(self._tile, fired.places, fired.starts, rows * columns, self._rows, self._bias, chunk, out)
        return out


def extractor(layers: Sequence[Layer], projection: tuple[Tensor, Tensor], lif: LIFParams) -> Extractor | None:
    """An extractor over lists, where all widths suit its vectors and it computes what the dense layers do."""
    if any(bias.numel() % LANES for bias in (*(layer.bias for layer in layers), projection[1])):
        return None
    try:
        if all(_agrees(layer, first=layer is layers[0]) for layer in layers):
            return Extractor(layers, projection, lif)
        reason = "they compute something else"
    except (RuntimeError, NumbaError) as error:
        reason = str(error).partition("\n")[0]
    say_once("convolutions over spikes alone", reason)
    return None


class OverValues:
    """The first layer: maps (R, H, W, C) of any float32, or counts, to who fires in (R, H', W', C')."""

    def __init__(self, layer: Layer) -> None:
        self._weight, self._bias = _by_input(layer.weight), layer.bias.numpy()
        self._widths = layer.weight.shape[1], layer.weight.shape[0]
        self._tile, self._firing = tile_of(self._bias.size, most=2), tile_of(self._bias.size)

    def __call__(self, x: Array | Counted, v: Array, decay: np.float32, v_th: np.float32) -> tuple[Fired, Array]:
        """Potentials (B, H', W', C') before, to who fires and the potentials after."""
        if isinstance(x, Counted):
            maps, channels, rows, columns = x.counts.shape
            whole, given = (maps, rows, columns, channels), (_NO_VALUES, x.counts.reshape(-1), x.table)
        else:
            whole, given = x.shape, (x.reshape(-1), _NO_COUNTS, _NO_VALUES)
        shape = shape_after(whole, self._widths, v)
        (places, starts), after = allocate_list(shape), np.empty_like(v)
        layer = self._tile, self._firing, whole, *given, self._weight, self._bias
        found = _convolve_values(*layer, v, after, decay, v_th, places, starts)
        return Fired(places, starts, shape, found), after


_NO_VALUES, _NO_COUNTS = np.empty(0, np.float32), np.empty(0, np.uint8)


class OverList:
    """One layer over a list: (R, H, W, C) to who fires in (R, H', W', C')."""

    def __init__(self, layer: Layer) -> None:
        self._dense = layer.dense
        self._weight, self._bias = _by_input(layer.weight), layer.bias.numpy()
        self._widths = layer.weight.shape[1], layer.weight.shape[0]
        self._tile = tile_of(self._bias.size)

    def __call__(self, fired: Fired, v: Array, decay: np.float32, v_th: np.float32) -> tuple[Fired, Array]:
        """Potentials (B, H', W', C') before, to who fires and the potentials after."""
        if fired.found > max(_FEW, _MANY * math.prod(fired.shape)):
            shape_after(fired.shape, self._widths, v)
            return _fired(self._dense(maps_of(fired)), v, decay, v_th)
        return self.over_list(fired, v, decay, v_th)

    def over_list(self, fired: Fired, v: Array, decay: np.float32, v_th: np.float32) -> tuple[Fired, Array]:
        """The same, however many fired."""
        shape = shape_after(fired.shape, self._widths, v)
        (places, starts), after = allocate_list(shape), np.empty_like(v)
        given = self._tile, fired.places, fired.starts, fired.shape, self._weight, self._bias
        found = _convolve(*given, v, after, decay, v_th, places, starts)
        return Fired(places, starts, shape, found), after


def _by_input(weight: Tensor) -> Array:
    """Weights (C', C, 3, 3) as one row after the other, each what one input gives to all C'."""
    return weight.permute(2, 3, 1, 0).reshape(-1).numpy()


def _fired(currents: Tensor, v: Array, decay: np.float32, v_th: np.float32) -> tuple[Fired, Array]:
    """Who fires of currents (R, C, H, W), and the potentials (B, H, W, C) after v."""
    rows = cells_of(currents)
    (places, starts), after = allocate_list(rows.shape), np.empty_like(v)
    channels = rows.shape[3]
    found = _fire(tile_of(channels), rows.reshape(-1), channels, v, after, decay, v_th, places, starts)
    return Fired(places, starts, rows.shape, found), after


@torch.inference_mode()
def _agrees(layer: Layer, *, first: bool) -> bool:
    """Whether a layer sums as its dense form, bit for bit: of few inputs and of all, one map and, if small, three."""
    generator = torch.Generator().manual_seed(0)
    outputs, inputs = layer.weight.shape[:2]
    silent = np.float32(0), np.float32(np.inf)  # nobody fires, and potentials become the currents
    for count in (1, 3) if inputs * layer.rows * layer.columns <= LARGE else (1,):
        for share in (0.15, 1.0):
            drawn = torch.rand(2, count, layer.rows, layer.columns, inputs, generator=generator)
            x = ((drawn[0] < share) * (drawn[1] if first else 1.0)).permute(0, 3, 1, 2)
            v = np.zeros((count, (layer.rows + 1) // 2, (layer.columns + 1) // 2, outputs), np.float32)
            if first:
                _, found = OverValues(layer)(cells_of(x), v, *silent)
            else:
                _, found = OverList(layer).over_list(listed(x), v, *silent)
            if not torch.equal(in_maps(found), layer.dense(x)):
                return False
    return True


# --- machine code -----------------------------------------------------------------------------------------------------


@compiled
def _convolve_values(
    like: tuple[int, ...],
    firing: tuple[int, ...],
    shape: tuple[int, int, int, int],
    x: Array,
    counts: NDArray[np.uint8],
    table: Array,
    weight: Array,
    bias: Array,
    before: Array,
    after: Array,
    decay: Any,
    v_th: Any,
    places: Places,
    starts: Places,
) -> int:  # pragma: no cover (machine code)
    """Who fires of a convolution of any numbers, as `_convolve` otherwise; six cells side by side at a time.

    Each sum is one chain of fused products, and a processor needs some ten of them under way.

    Args:
        like: width of a tile of six cells; all twelve fit into registers with two vectors.
        firing: width of a tile that fires.
        shape: R, H, W, C.
        x: R * H * W * C.
        counts: R * C * H * W, or none; where there are some x is not read, but their entries of the table.
        table: 256.
        weight: 3, 3, C, C'.
        bias: C'.
        before: potentials (B, H', W', C').
        after: the same, written.
        decay: per step.
        v_th: firing threshold.
        places: written, as `starts`; see Fired.
        starts: of R * H' * W' and 1.

    Returns:
        how many fire.
    """
    maps, rows, columns, channels = shape
    outputs, width = bias.size, LANES * len(like)
    batch = before.shape[0]
    n = before.size // batch
    v, v_after, found, cell = before.reshape(-1), after.reshape(-1), 0, 0
    line, encoded = channels * columns, counts.size > 0
    values = np.empty(3 * line, np.float32) if encoded else x  # rows of the kernel, by number modulo three
    aside, apart = (1, columns) if encoded else (channels, 1)  # from a cell to the next, from a channel to the next
    step, currents = 2 * aside, np.empty(6 * outputs, np.float32)
    for r in range(maps):
        if r == batch:
            v = v_after
        at = 0  # in the new map
        for row in range(-1, rows - 1, 2):  # the kernel's first
            top, bottom = max(row, 0), min(row + 3, rows)
            if encoded:
                for y in range(top if row < 0 else row + 1, bottom):
                    _encode_row(counts, (r * channels * rows + y) * columns, rows, columns, table, values, y % 3 * line)
            column = -1
            while column < columns - 1:
                cells = 6 if column >= 0 and column + 13 <= columns else 1  # at an edge one by one
                left, right = max(column, 0), min(column + 3, columns)
                for tile in range(0, outputs, width):
                    a, b, c = nothing(like), nothing(like), nothing(like)
                    d, e, f = nothing(like), nothing(like), nothing(like)
                    for y in range(top, bottom):
                        begin = y % 3 * line if encoded else (r * rows + y) * line
                        w = ((y - row) * 3 + left - column) * channels * outputs + tile
                        for i in range(left, right):
                            k = begin + i * aside
                            for _ in range(channels):
                                a = plus_product(a, values, k, weight, w)
                                if cells == 6:
                                    b = plus_product(b, values, k + step, weight, w)
                                    c = plus_product(c, values, k + 2 * step, weight, w)
                                    d = plus_product(d, values, k + 3 * step, weight, w)
                                    e = plus_product(e, values, k + 4 * step, weight, w)
                                    f = plus_product(f, values, k + 5 * step, weight, w)
                                k += apart
                                w += outputs
                    put(plus(a, bias, tile), currents, tile)
                    if cells == 6:
                        put(plus(b, bias, tile), currents, outputs + tile)
                        put(plus(c, bias, tile), currents, 2 * outputs + tile)
                        put(plus(d, bias, tile), currents, 3 * outputs + tile)
                        put(plus(e, bias, tile), currents, 4 * outputs + tile)
                        put(plus(f, bias, tile), currents, 5 * outputs + tile)
                for i in range(cells):
                    starts[cell] = found
                    cell += 1
                    for first in range(i * outputs, (i + 1) * outputs, LANES * len(firing)):
                        current = plus(nothing(firing), currents, first)
                        found = fire(current, v, v_after, r % batch * n + at, decay, v_th, places, found, at)
                        at += LANES * len(firing)
                column += 2 * cells
    starts[cell] = found
    return found


@compiled
def _encode_row(
    counts: NDArray[np.uint8], begin: int, rows: int, columns: int, table: Array, values: Array, into: int
) -> None:  # pragma: no cover (machine code)
    """Write the entries of a row of counts, channel after channel; the next channel's begins rows * columns later."""
    for _ in range(into, into + values.size // 3, columns):
        if columns < LANES:
            for i in range(columns):
                values[into + i] = table[counts[begin + i]]
        else:
            for column in range(0, columns, LANES):
                i = min(column, columns - LANES)
                put_floats(table, counts, begin + i, values, into + i)
        begin += rows * columns
        into += columns


@compiled
def _fire(
    like: tuple[int, ...],
    currents: Array,
    channels: int,
    before: Array,
    after: Array,
    decay: Any,
    v_th: Any,
    places: Places,
    starts: Places,
) -> int:  # pragma: no cover (machine code)
    """Who fires of currents (R * cells * channels), R a multiple of B.

    Args:
        like: width of a tile.
        currents: channels vary fastest.
        channels: a multiple of the tile's width.
        before: potentials (B, H, W, C).
        after: the same, written.
        decay: per step.
        v_th: firing threshold.
        places: written, as `starts`; see Fired.
        starts: of R * cells and 1.

    Returns:
        how many fire.
    """
    batch = before.shape[0]
    n = before.size // batch
    v, v_after, cells, width = before.reshape(-1), after.reshape(-1), n // channels, LANES * len(like)
    found = 0
    for r in range(currents.size // n):
        if r == batch:
            v = v_after
        for cell in range(cells):
            starts[r * cells + cell] = found
            for first in range(cell * channels, (cell + 1) * channels, width):
                current = plus(nothing(like), currents, r * n + first)
                found = fire(current, v, v_after, r % batch * n + first, decay, v_th, places, found, first)
    starts[starts.size - 1] = found
    return found


@compiled
def _convolve(
    like: tuple[int, ...],
    given: Places,
    given_starts: Places,
    shape: tuple[int, int, int, int],
    weight: Array,
    bias: Array,
    before: Array,
    after: Array,
    decay: Any,
    v_th: Any,
    places: Places,
    starts: Places,
) -> int:  # pragma: no cover (machine code)
    """Who fires of a convolution of 3x3, stride 2, one cell of zeros around.

    The three cells of a row under a kernel lie side by side, so those of them that fired are one piece of the list, and
    its rows of weights lie in the same order.

    Args:
        like: width of a tile.
        given: who fired before, as `given_starts` and `shape`; see Fired.
        given_starts: of R * H * W and 1.
        shape: R, H, W, C.
        weight: 3, 3, C, C'.
        bias: C'.
        before: potentials (B, H', W', C').
        after: the same, written.
        decay: per step.
        v_th: firing threshold.
        places: written, as `starts`; see Fired.
        starts: of R * H' * W' and 1.

    Returns:
        how many fire.
    """
    maps, rows, columns, channels = shape
    outputs, width = bias.size, LANES * len(like)
    batch = before.shape[0]
    n = before.size // batch
    v, v_after, found, cell = before.reshape(-1), after.reshape(-1), 0, 0
    for r in range(maps):
        if r == batch:
            v = v_after
        at = 0  # in the new map
        for row in range(-1, rows - 1, 2):  # the kernel's first
            for column in range(-1, columns - 1, 2):
                starts[cell] = found
                cell += 1
                left, right = max(column, 0), min(column + 3, columns)
                for tile in range(0, outputs, width):
                    current = nothing(like)
                    for y in range(max(row, 0), min(row + 3, rows)):
                        line = (r * rows + y) * columns
                        shift = ((y - row) * 3 - (y * columns + column)) * channels
                        for i in range(given_starts[line + left], given_starts[line + right]):
                            current = plus(current, weight, (entry(given, i) + shift) * outputs + tile)
                    current = plus(current, bias, tile)
                    found = fire(current, v, v_after, r % batch * n + at, decay, v_th, places, found, at)
                    at += width
    starts[cell] = found
    return found


@compiled
def _project(
    like: tuple[int, ...],
    given: Places,
    starts: Places,
    cells: int,
    weight: Array,
    bias: Array,
    chunk: int,
    out: Array,
) -> None:  # pragma: no cover (machine code)
    """Out (R, F) = bias + the weights of those that fired, added up one after the other for each map alone.

    Args:
        like: width of a tile.
        given: who fired, as `starts`; see Fired.
        starts: of R * cells and 1.
        cells: of a map.
        weight: I, F.
        bias: F.
        chunk: cells whose weights stay in the cache while all maps have their turn.
        out: written.
    """
    maps, features = out.shape
    width, sums = LANES * len(like), out.reshape(-1)
    for r in range(maps):
        for first in range(0, features, width):
            put(plus(nothing(like), bias, first), sums, r * features + first)
    for start in range(0, cells, chunk):
        stop = min(start + chunk, cells)
        for r in range(maps):
            begin, end = starts[r * cells + start], starts[r * cells + stop]
            for first in range(0, features, width):
                total = plus(nothing(like), sums, r * features + first)
                for i in range(begin, end):
                    total = plus(total, weight, entry(given, i) * features + first)
                put(total, sums, r * features + first)
