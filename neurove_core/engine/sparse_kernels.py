"""Compiled kernels of sparse.py: convolutions of float32 maps and spike lists with the LIF step, and the projection.

They use vectors.py and are imported only where `fallback.vectors_work()`.
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from neurove_core.compiled import compiled
from neurove_core.engine.byte_vectors import store_lookup
from neurove_core.engine.spike_lists import Array, Indices
from neurove_core.engine.tiles import LANES
from neurove_core.engine.vectors import add, add_product, element, fire_tile, store, zeros


@compiled
def convolve_values(
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
    indices: Indices,
    starts: Indices,
) -> int:  # pragma: no cover (machine code)
    """Convolution of real-valued maps, 3x3, stride 2, zero padding of 1, followed by one LIF step.

    Six output cells are computed at a time. Each sum is a chain of fused multiply-adds, and a processor needs about ten
    of these in flight to run at full rate.

    Args:
        like: tuple whose length is the number of vectors in a tile of six cells; two vectors for each of six cells fit
            into the registers.
        firing: the same for a tile of the LIF step.
        shape: R, H, W, C.
        x: input (R * H * W * C); not read where there are counts.
        counts: (R * C * H * W) counts to encode by the table, or empty.
        table: (256) encoding of a count.
        weight: (3, 3, C, C'), flat.
        bias: (C').
        before: membrane potentials (B, H', W', C') before the step.
        after: potentials after the step, written.
        decay: leak per step.
        v_th: firing threshold.
        indices: indices of the output's spikes, written; see SpikeList.
        starts: (R * H' * W' + 1) where each cell's spikes begin, written.

    Returns:
        number of spikes.
    """
    maps, rows, columns, channels = shape
    outputs, width = bias.size, LANES * len(like)
    batch = before.shape[0]
    n = before.size // batch
    v, v_after, found, cell = before.reshape(-1), after.reshape(-1), 0, 0
    line, encoded = channels * columns, counts.size > 0
    values = np.empty(3 * line, np.float32) if encoded else x  # the kernel's rows, by row number modulo three
    next_cell, next_channel = (1, columns) if encoded else (channels, 1)  # distances in `values`
    step, currents = 2 * next_cell, np.empty(6 * outputs, np.float32)
    for r in range(maps):
        if r == batch:
            v = v_after
        at = 0  # index in the output map
        for row in range(-1, rows - 1, 2):  # first row of the kernel
            top, bottom = max(row, 0), min(row + 3, rows)
            if encoded:
                for y in range(top if row < 0 else row + 1, bottom):
                    _encode_row(counts, (r * channels * rows + y) * columns, rows, columns, table, values, y % 3 * line)
            column = -1
            while column < columns - 1:
                cells = 6 if column >= 0 and column + 13 <= columns else 1  # one by one at an edge
                left, right = max(column, 0), min(column + 3, columns)
                for tile in range(0, outputs, width):
                    a, b, c = zeros(like), zeros(like), zeros(like)
                    d, e, f = zeros(like), zeros(like), zeros(like)
                    for y in range(top, bottom):
                        begin = y % 3 * line if encoded else (r * rows + y) * line
                        w = ((y - row) * 3 + left - column) * channels * outputs + tile
                        for i in range(left, right):
                            k = begin + i * next_cell
                            for _ in range(channels):
                                a = add_product(a, values, k, weight, w)
                                if cells == 6:
                                    b = add_product(b, values, k + step, weight, w)
                                    c = add_product(c, values, k + 2 * step, weight, w)
                                    d = add_product(d, values, k + 3 * step, weight, w)
                                    e = add_product(e, values, k + 4 * step, weight, w)
                                    f = add_product(f, values, k + 5 * step, weight, w)
                                k += next_channel
                                w += outputs
                    store(add(a, bias, tile), currents, tile)
                    if cells == 6:
                        store(add(b, bias, tile), currents, outputs + tile)
                        store(add(c, bias, tile), currents, 2 * outputs + tile)
                        store(add(d, bias, tile), currents, 3 * outputs + tile)
                        store(add(e, bias, tile), currents, 4 * outputs + tile)
                        store(add(f, bias, tile), currents, 5 * outputs + tile)
                for i in range(cells):
                    starts[cell] = found
                    cell += 1
                    for first in range(i * outputs, (i + 1) * outputs, LANES * len(firing)):
                        current = add(zeros(firing), currents, first)
                        found = fire_tile(current, v, v_after, r % batch * n + at, decay, v_th, indices, found, at)
                        at += LANES * len(firing)
                column += 2 * cells
    starts[cell] = found
    return found


@compiled
def _encode_row(
    counts: NDArray[np.uint8], begin: int, rows: int, columns: int, table: Array, values: Array, into: int
) -> None:  # pragma: no cover (machine code)
    """Encode one row of counts by the table, channel by channel; channels are rows * columns next_channel."""
    for _ in range(into, into + values.size // 3, columns):
        if columns < LANES:
            for i in range(columns):
                values[into + i] = table[counts[begin + i]]
        else:
            for column in range(0, columns, LANES):
                i = min(column, columns - LANES)
                store_lookup(table, counts, begin + i, values, into + i)
        begin += rows * columns
        into += columns


@compiled
def fire_currents(
    like: tuple[int, ...],
    currents: Array,
    channels: int,
    before: Array,
    after: Array,
    decay: Any,
    v_th: Any,
    indices: Indices,
    starts: Indices,
) -> int:  # pragma: no cover (machine code)
    """One LIF step of currents (R * cells * channels), R a multiple of B.

    Args:
        like: tuple whose length is the number of vectors in a tile.
        currents: input currents, channels last.
        channels: a multiple of the tile's width.
        before: membrane potentials (B, H, W, C) before the step.
        after: potentials after the step, written.
        decay: leak per step.
        v_th: firing threshold.
        indices: indices of the spikes, written; see SpikeList.
        starts: (R * cells + 1) where each cell's spikes begin, written.

    Returns:
        number of spikes.
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
                current = add(zeros(like), currents, r * n + first)
                found = fire_tile(current, v, v_after, r % batch * n + first, decay, v_th, indices, found, first)
    starts[starts.size - 1] = found
    return found


@compiled
def convolve_list(
    like: tuple[int, ...],
    given: Indices,
    given_starts: Indices,
    shape: tuple[int, int, int, int],
    weight: Array,
    bias: Array,
    before: Array,
    after: Array,
    decay: Any,
    v_th: Any,
    indices: Indices,
    starts: Indices,
) -> int:  # pragma: no cover (machine code)
    """Convolution of a spike list, 3x3, stride 2, zero padding of 1, followed by one LIF step.

    The three cells of a row under the kernel are neighbours in memory. Their spikes are one contiguous part of the
    list, and their rows of weights are in the same order.

    Args:
        like: tuple whose length is the number of vectors in a tile.
        given: indices of the input's spikes; see SpikeList.
        given_starts: (R * H * W + 1) of the input.
        shape: R, H, W, C of the input.
        weight: (3, 3, C, C'), flat.
        bias: (C').
        before: membrane potentials (B, H', W', C') before the step.
        after: potentials after the step, written.
        decay: leak per step.
        v_th: firing threshold.
        indices: indices of the output's spikes, written; see SpikeList.
        starts: (R * H' * W' + 1) where each cell's spikes begin, written.

    Returns:
        number of spikes.
    """
    maps, rows, columns, channels = shape
    outputs, width = bias.size, LANES * len(like)
    batch = before.shape[0]
    n = before.size // batch
    v, v_after, found, cell = before.reshape(-1), after.reshape(-1), 0, 0
    for r in range(maps):
        if r == batch:
            v = v_after
        at = 0  # index in the output map
        for row in range(-1, rows - 1, 2):  # first row of the kernel
            for column in range(-1, columns - 1, 2):
                starts[cell] = found
                cell += 1
                left, right = max(column, 0), min(column + 3, columns)
                for tile in range(0, outputs, width):
                    current = zeros(like)
                    for y in range(max(row, 0), min(row + 3, rows)):
                        line = (r * rows + y) * columns
                        shift = ((y - row) * 3 - (y * columns + column)) * channels
                        for i in range(given_starts[line + left], given_starts[line + right]):
                            current = add(current, weight, (element(given, i) + shift) * outputs + tile)
                    current = add(current, bias, tile)
                    found = fire_tile(current, v, v_after, r % batch * n + at, decay, v_th, indices, found, at)
                    at += width
    starts[cell] = found
    return found


@compiled
def project_list(
    like: tuple[int, ...],
    given: Indices,
    starts: Indices,
    cells: int,
    weight: Array,
    bias: Array,
    chunk: int,
    out: Array,
) -> None:  # pragma: no cover (machine code)
    """Out (R, F) = bias + the sum of the weight rows of the spikes, in the order of the list, for each map alone.

    Args:
        like: tuple whose length is the number of vectors in a tile.
        given: indices of the spikes; see SpikeList.
        starts: (R * cells + 1).
        cells: number of cells of a map.
        weight: (I, F), flat.
        bias: (F).
        chunk: number of cells whose weights stay in the cache while all maps are processed.
        out: written.
    """
    maps, features = out.shape
    width, sums = LANES * len(like), out.reshape(-1)
    for r in range(maps):
        for first in range(0, features, width):
            store(add(zeros(like), bias, first), sums, r * features + first)
    for start in range(0, cells, chunk):
        stop = min(start + chunk, cells)
        for r in range(maps):
            begin, end = starts[r * cells + start], starts[r * cells + stop]
            for first in range(0, features, width):
                total = add(zeros(like), sums, r * features + first)
                for i in range(begin, end):
                    total = add(total, weight, element(given, i) * features + first)
                store(total, sums, r * features + first)
