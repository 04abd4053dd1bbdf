"""The same sums as int8.py's, over the neurons that fired alone, as sparse.py has them in float32.

Weights are added up where a spike is, in 16 bits over few inputs and in 32 over all. Whole numbers are exact in any
order, so what is proven about the dense form holds here bit for bit. The first layer sees codes of 8 bits: products of
four of them at once, where the processor has such, six cells side by side, as in sparse.OverValues.

Each layer is tried at load against the plain sums; where one differs, or a width suits no vector, the dense ones serve.
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
)
from neurove_core.engine.vectors import (
    LANES,
    entry,
    fire,
    in_float,
    multiplies_bytes,
    no_shorts,
    no_sums,
    nothing,
    plus,
    plus_dots,
    plus_shorts,
    plus_sums,
    plus_wide,
    put,
    put_fours,
    put_number,
    put_rows,
    scaled,
    tile_of,
)
from neurove_core.spiking.lif import LIFParams, LIFState

Codes = NDArray[np.uint8]

SHORT: Final = 256
"""Weights that 16 bits hold the sum of: 256 * 127 < 2**15."""

_MANY: Final = 0.45
"""Share of spikes from which maps are convolved dense: of large layers; small ones take as long then at 0.7."""

_FEW: Final = 1 << 14  # as in sparse

_CHUNK: Final = 512  # as in sparse: inputs of the projection whose weights stay in the cache

_SIDE: Final = 6  # cells of the first layer side by side


class Layer(NamedTuple):
    """A convolution of the extractor in whole numbers."""

    q: Tensor  # (C', C, 3, 3) int8
    factor: Tensor  # (C') float32
    offset: Tensor  # (C') float32
    dense: Convolution  # its sums
    rows: int  # of the map that it mostly sees
    columns: int


class Extractor:
    """The feature extractor of one network in whole numbers, over lists of who fired.

    Args:
        layers: its blocks; the first sees codes, the others spikes.
        lif: of its neurons.
    """

    def __init__(self, layers: Sequence[Layer], lif: LIFParams) -> None:
        self._decay, self._v_th = np.float32(lif.decay), np.float32(lif.v_th)
        self._first, self._layers = over_codes(layers[0]), [OverList(layer) for layer in layers[1:]]

    def __call__(self, codes: Tensor, membranes: Sequence[LIFState]) -> tuple[Fired, tuple[LIFState, ...]]:
        """Input (T * B, 2n, H, W), uint8, to who fired in the last map, and the potentials after the last reset."""
        constants = self._decay, self._v_th
        fired, v = self._first(np.ascontiguousarray(codes.numpy()), cells_of(membranes[0].v), *constants)
        after = [v]
        for layer, membrane in zip(self._layers, membranes[1:], strict=True):
            fired, v = layer(fired, cells_of(membrane.v), *constants)
            after.append(v)
        return fired, tuple([LIFState(in_maps(v)) for v in after])


def extractor(layers: Sequence[Layer], lif: LIFParams) -> Extractor | None:
    """An extractor over lists, where all widths suit its vectors and it computes what the plain sums are."""
    if any(layer.q.shape[0] % LANES for layer in layers):
        return None
    try:
        made = Extractor(layers, lif)
        if all(_agrees(layer, first=layer is layers[0]) for layer in layers):
            return made
        reason = "they compute something else"
    except (RuntimeError, NumbaError) as error:
        reason = str(error).partition("\n")[0]
    say_once("8-bit convolutions over spikes alone", reason)
    return None


class OverDense:
    """A layer by its dense sums: maps (R, C, H, W) of codes, in any layout, to who fires in (R, H', W', C')."""

    def __init__(self, layer: Layer) -> None:
        self._dense, self._factor, self._offset = layer.dense, layer.factor.numpy(), layer.offset.numpy()
        self._widths = layer.q.shape[1], layer.q.shape[0]
        self._tile = tile_of(self._factor.size)

    def __call__(self, x: Codes, v: Array, decay: np.float32, v_th: np.float32) -> tuple[Fired, Array]:
        """Potentials (B, H', W', C') before, to who fires and the potentials after."""
        shape = shape_after(cells_shape(x), self._widths, v)
        sums = cells_of(self._dense(torch.from_numpy(x).contiguous(memory_format=torch.channels_last)))
        (places, starts), after = allocate_list(shape), np.empty_like(v)
        given = self._tile, sums.reshape(-1), self._factor, self._offset
        return Fired(places, starts, shape, _fire(*given, v, after, decay, v_th, places, starts)), after


class OverCodes:
    """The first layer: maps (R, C, H, W) of codes, contiguous, to who fires in (R, H', W', C')."""

    def __init__(self, layer: Layer) -> None:
        outputs, inputs = layer.q.shape[:2]
        fours = -(-inputs // 4)
        by_input = layer.q.new_zeros(3, fours * 4, 3, outputs)
        by_input[:, :inputs] = layer.q.permute(2, 1, 3, 0)
        self._weight = by_input.view(3, fours, 4, 3, outputs).permute(0, 1, 3, 4, 2).reshape(-1).numpy()
        self._factor, self._offset = layer.factor.numpy(), layer.offset.numpy()
        self._widths = inputs, outputs
        self._tile = tile_of(outputs, most=2)

    def __call__(self, x: Codes, v: Array, decay: np.float32, v_th: np.float32) -> tuple[Fired, Array]:
        """Potentials (B, H', W', C') before, to who fires and the potentials after."""
        shape = shape_after(cells_shape(x), self._widths, v)
        (places, starts), after = allocate_list(shape), np.empty_like(v)
        given = self._tile, x, self._weight, self._factor, self._offset
        return Fired(places, starts, shape, _convolve_codes(*given, v, after, decay, v_th, places, starts)), after


def cells_shape(maps: Codes) -> tuple[int, int, int, int]:
    """(R, H, W, C) of maps (R, C, H, W)."""
    count, channels, rows, columns = maps.shape
    return count, rows, columns, channels


def over_codes(layer: Layer) -> OverCodes | OverDense:
    """The first layer as this machine runs it."""
    return OverCodes(layer) if multiplies_bytes() else OverDense(layer)


class OverList:
    """One layer over a list: (R, H, W, C) to who fires in (R, H', W', C')."""

    def __init__(self, layer: Layer) -> None:
        self._dense = OverDense(layer)
        outputs, inputs = layer.q.shape[:2]
        self._weight = torch.cat([layer.q.permute(2, 3, 1, 0).reshape(-1), layer.q.new_zeros(outputs)]).numpy()
        ends = layer.q.int().clamp(min=0), layer.q.int().clamp(max=0)
        fits = max(int(end.flatten(1).sum(dim=1).abs().max()) for end in ends) < 1 << 15  # then any sum does
        self._most = 12 * inputs if fits else SHORT
        self._factor, self._offset = layer.factor.numpy(), layer.offset.numpy()
        self._widths = inputs, outputs
        self._tile = tile_of(outputs)

    def __call__(self, fired: Fired, v: Array, decay: np.float32, v_th: np.float32) -> tuple[Fired, Array]:
        """Potentials (B, H', W', C') before, to who fires and the potentials after."""
        if fired.found > max(_FEW, _MANY * math.prod(fired.shape)):
            return self._dense(maps_of(fired, np.uint8).numpy(), v, decay, v_th)
        return self.over_list(fired, v, decay, v_th)

    def over_list(self, fired: Fired, v: Array, decay: np.float32, v_th: np.float32) -> tuple[Fired, Array]:
        """The same, however many fired."""
        shape = shape_after(fired.shape, self._widths, v)
        (places, starts), after = allocate_list(shape), np.empty_like(v)
        given = (
            self._tile,
            fired.places,
            fired.starts,
            fired.shape,
            self._weight,
            self._most,
            self._factor,
            self._offset,
        )
        return Fired(places, starts, shape, _convolve(*given, v, after, decay, v_th, places, starts)), after


def project(fired: Fired, rows: NDArray[np.int8], factor: Array, offset: Array) -> Array:
    """Currents (R, F) of each map: rows (I, F) of those that fired, added up, times factor plus offset (F)."""
    maps, height, width, channels = fired.shape
    currents = np.empty((maps, factor.size), np.float32)
    chunk = max(1, _CHUNK // channels)
    given = tile_of(factor.size), fired.places, fired.starts, height * width, rows.reshape(-1), factor, offset
    _project(*given, chunk, currents)
    return currents


@torch.inference_mode()
def _agrees(layer: Layer, *, first: bool) -> bool:
    """Whether a layer sums as the plain form, bit for bit: of few inputs and of all, one map and, if small, three."""
    generator = torch.Generator().manual_seed(0)
    outputs, inputs = layer.q.shape[:2]
    top, silent = 255 if first else 1, (np.float32(0), np.float32(np.inf))  # nobody fires: potentials are the currents
    factor, offset = layer.factor.view(-1, 1, 1), layer.offset.view(-1, 1, 1)
    for count in (1, 3) if inputs * layer.rows * layer.columns <= LARGE else (1,):
        for share in (0.15, 1.0):
            drawn = torch.rand(2, count, layer.rows, layer.columns, inputs, generator=generator)
            x = ((drawn[0] < share) * (1 + drawn[1] * top).clamp_(max=top)).to(torch.uint8)
            v = np.zeros((count, (layer.rows + 1) // 2, (layer.columns + 1) // 2, outputs), np.float32)
            maps = x.permute(0, 3, 1, 2)
            if first:
                _, found = over_codes(layer)(maps.contiguous().numpy(), v, *silent)
            else:
                _, found = OverList(layer).over_list(listed(maps), v, *silent)
            if not torch.equal(in_maps(found), layer.dense(maps) * factor + offset):
                return False
    return True


# --- machine code -----------------------------------------------------------------------------------------------------


@compiled
def _convolve_codes(
    like: tuple[int, ...],
    x: Codes,
    weight: NDArray[np.int8],
    factor: Array,
    offset: Array,
    before: Array,
    after: Array,
    decay: Any,
    v_th: Any,
    places: Places,
    starts: Places,
) -> int:  # pragma: no cover (machine code)
    """Who fires of a convolution of codes, as `_convolve` otherwise; six cells at a time, the last perhaps of none.

    Args:
        like: width of a tile of six cells.
        x: R, C, H, W.
        weight: 3, fours of channels, 3, C', 4; zeros for channels that fill up the last four.
        factor: C'.
        offset: C'.
        before: potentials (B, H', W', C').
        after: the same, written.
        decay: per step.
        v_th: firing threshold.
        places: written, as `starts`; see Fired.
        starts: of R * H' * W' and 1.

    Returns:
        how many fire.
    """
    maps, channels, rows, columns = x.shape
    outputs, width, plane = factor.size, LANES * len(like), rows * columns
    batch = before.shape[0]
    n = before.size // batch
    v, v_after, found, cell = before.reshape(-1), after.reshape(-1), 0, 0
    codes, fours, across = x.reshape(-1), (channels + 3) // 4, (columns + 1) // 2
    wide = 4 * (2 * (across + _SIDE) + 3)  # with zeros left and right
    lines = np.zeros(3 * fours * wide, np.uint8)  # of the kernel, by number modulo three; columns of four channels each
    currents = np.empty(_SIDE * outputs, np.float32)
    for r in range(maps):
        if r == batch:
            v = v_after
        at = 0  # in the new map
        for row in range(-1, rows - 1, 2):  # the kernel's first
            top, bottom = max(row, 0), min(row + 3, rows)
            for y in range(top if row < 0 else row + 1, bottom):
                begin = (r * channels * rows + y) * columns
                _put_row(codes, begin, plane, channels, columns, lines, y % 3 * fours * wide + 4, wide)
            for first in range(0, across, _SIDE):
                for tile in range(0, outputs, width):
                    a, b, c = no_sums(like), no_sums(like), no_sums(like)
                    d, e, f = no_sums(like), no_sums(like), no_sums(like)
                    for y in range(top, bottom):
                        w = ((y - row) * fours * 3 * outputs + tile) * 4
                        for q in range(fours):
                            k = (y % 3 * fours + q) * wide + 8 * first
                            for _ in range(3):
                                a = plus_dots(a, lines, k, weight, w)
                                b = plus_dots(b, lines, k + 8, weight, w)
                                c = plus_dots(c, lines, k + 16, weight, w)
                                d = plus_dots(d, lines, k + 24, weight, w)
                                e = plus_dots(e, lines, k + 32, weight, w)
                                f = plus_dots(f, lines, k + 40, weight, w)
                                k += 4
                                w += 4 * outputs
                    put(scaled(in_float(a), factor, offset, tile), currents, tile)
                    put(scaled(in_float(b), factor, offset, tile), currents, outputs + tile)
                    put(scaled(in_float(c), factor, offset, tile), currents, 2 * outputs + tile)
                    put(scaled(in_float(d), factor, offset, tile), currents, 3 * outputs + tile)
                    put(scaled(in_float(e), factor, offset, tile), currents, 4 * outputs + tile)
                    put(scaled(in_float(f), factor, offset, tile), currents, 5 * outputs + tile)
                for i in range(min(_SIDE, across - first)):
                    starts[cell] = found
                    cell += 1
                    for tile in range(i * outputs, (i + 1) * outputs, width):
                        current = plus(nothing(like), currents, tile)
                        found = fire(current, v, v_after, r % batch * n + at, decay, v_th, places, found, at)
                        at += width
    starts[cell] = found
    return found


@compiled
def _put_row(
    codes: Codes, begin: int, plane: int, channels: int, columns: int, lines: Codes, into: int, wide: int
) -> None:  # pragma: no cover (machine code)
    """Write a row of all channels, four of them side by side; what fills up the last four is any, its weights are 0.

    Args:
        codes: of the maps, flat.
        begin: of the row in the first channel.
        plane: from there to the next channel's.
        channels: of the map.
        columns: of the row.
        lines: written.
        into: where the first four channels' begin.
        wide: from there to the next four's.
    """
    for first in range(0, channels, 4):
        most = channels - 1 - first
        a = begin + first * plane
        b, c, d = a + min(1, most) * plane, a + min(2, most) * plane, a + min(3, most) * plane
        if columns < LANES:
            for i in range(columns):
                four = lines[into + 4 * i : into + 4 * i + 4]
                four[0], four[1], four[2], four[3] = codes[a + i], codes[b + i], codes[c + i], codes[d + i]
        else:
            for column in range(0, columns, LANES):
                i = min(column, columns - LANES)
                put_fours(codes, a + i, b + i, c + i, d + i, lines, into + 4 * i)
        into += wide


@compiled
def _fire(
    like: tuple[int, ...],
    sums: Array,
    factor: Array,
    offset: Array,
    before: Array,
    after: Array,
    decay: Any,
    v_th: Any,
    places: Places,
    starts: Places,
) -> int:  # pragma: no cover (machine code)
    """Who fires of currents sums * factor + offset, sums (R * cells * C'), R a multiple of B; else as sparse._fire."""
    batch, channels = before.shape[0], factor.size
    n = before.size // batch
    v, v_after, cells, width = before.reshape(-1), after.reshape(-1), n // channels, LANES * len(like)
    found = 0
    for r in range(sums.size // n):
        if r == batch:
            v = v_after
        for cell in range(cells):
            starts[r * cells + cell] = found
            at = cell * channels
            for tile in range(0, channels, width):
                current = scaled(plus(nothing(like), sums, r * n + at + tile), factor, offset, tile)
                where = r % batch * n + at + tile
                found = fire(current, v, v_after, where, decay, v_th, places, found, at + tile)
    starts[starts.size - 1] = found
    return found


@compiled
def _convolve(
    like: tuple[int, ...],
    given: Places,
    given_starts: Places,
    shape: tuple[int, int, int, int],
    weight: NDArray[np.int8],
    most: int,
    factor: Array,
    offset: Array,
    before: Array,
    after: Array,
    decay: Any,
    v_th: Any,
    places: Places,
    starts: Places,
) -> int:  # pragma: no cover (machine code)
    """Who fires of a convolution of 3x3, stride 2, one cell of zeros around; as sparse._convolve, in whole numbers.

    Which rows of weights a cell asks for is written down first, for all rows of the kernel: one loop over them ends
    once, and the ends of short loops are what a processor guesses wrongly.

    Args:
        like: width of a tile.
        given: who fired before, as `given_starts` and `shape`; see Fired.
        given_starts: of R * H * W and 1.
        shape: R, H, W, C.
        weight: 3, 3, C, C', and C' zeros.
        most: spikes, a multiple of four, whose weights 16 bits hold the sum of.
        factor: C'.
        offset: C'.
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
    outputs, width = factor.size, LANES * len(like)
    batch = before.shape[0]
    n = before.size // batch
    v, v_after, found, cell = before.reshape(-1), after.reshape(-1), 0, 0
    silent = 9 * channels * outputs  # a row of zeros
    asked = np.empty(9 * channels + 3 * LANES, np.int32)
    for r in range(maps):
        if r == batch:
            v = v_after
        at = 0  # in the new map
        for row in range(-1, rows - 1, 2):  # the kernel's first
            for column in range(-1, columns - 1, 2):
                starts[cell] = found
                cell += 1
                left, right = max(column, 0), min(column + 3, columns)
                count = 0
                for y in range(max(row, 0), min(row + 3, rows)):
                    line = (r * rows + y) * columns
                    shift = ((y - row) * 3 - (y * columns + column)) * channels
                    begin, end = given_starts[line + left], given_starts[line + right]
                    put_rows(given, begin, shift, outputs, asked, count)
                    for more in range(2 * LANES, end - begin, 2 * LANES):
                        put_rows(given, begin + more, shift, outputs, asked, count + more)
                    count += end - begin
                put_number(silent, asked, count)
                for tile in range(0, outputs, width):
                    total = no_sums(like)
                    for few in range(0, count, most):
                        part = no_shorts(like)
                        for i in range(few, min(few + most, count), 4):
                            part = plus_shorts(part, weight, entry(asked, i) + tile)
                            part = plus_shorts(part, weight, entry(asked, i + 1) + tile)
                            part = plus_shorts(part, weight, entry(asked, i + 2) + tile)
                            part = plus_shorts(part, weight, entry(asked, i + 3) + tile)
                        total = plus_wide(total, part)
                    current = scaled(in_float(total), factor, offset, tile)
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
    weight: NDArray[np.int8],
    factor: Array,
    offset: Array,
    chunk: int,
    currents: Array,
) -> None:  # pragma: no cover (machine code)
    """Currents (R, F) of the weights of those that fired.

    Args:
        like: width of a tile.
        given: who fired, as `starts`; see Fired.
        starts: of R * cells and 1.
        cells: of a map.
        weight: I, F.
        factor: F.
        offset: F.
        chunk: cells whose weights stay in the cache while all maps have their turn.
        currents: written.
    """
    maps, features = currents.shape
    width, found, sums = LANES * len(like), currents.reshape(-1), np.zeros(currents.size, np.int32)
    for start in range(0, cells, chunk):
        stop = min(start + chunk, cells)
        for r in range(maps):
            begin, end = starts[r * cells + start], starts[r * cells + stop]
            for first in range(0, features, width):
                total = plus_sums(no_sums(like), sums, r * features + first)
                for few in range(begin, end, SHORT):
                    part = no_shorts(like)
                    for i in range(few, min(few + SHORT, end)):
                        part = plus_shorts(part, weight, entry(given, i) * features + first)
                    total = plus_wide(total, part)
                put(total, sums, r * features + first)
    for r in range(maps):
        for first in range(0, features, width):
            total = plus_sums(no_sums(like), sums, r * features + first)
            put(scaled(in_float(total), factor, offset, first), found, r * features + first)
