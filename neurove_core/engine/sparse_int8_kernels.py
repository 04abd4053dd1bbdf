"""Compiled kernels of sparse_int8.py: int8 convolutions with the LIF step, the projection, and the table look-up.

They use vectors.py and are imported only where `fallback.vectors_work()`.
"""

from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from neurove_core.compiled import compiled
from neurove_core.engine.byte_vectors import store_interleaved, store_lookup_bytes, store_pairs
from neurove_core.engine.spike_lists import Array, Indices
from neurove_core.engine.tiles import BYTES, LANES
from neurove_core.engine.vectors import (
    add,
    add_dot_products,
    add_int16,
    add_int32,
    add_widened,
    element,
    fire_tile,
    scale_and_offset,
    store,
    store_repeated,
    store_row_starts,
    to_float,
    zeros,
    zeros_int16,
    zeros_int32,
)

Codes = NDArray[np.uint8]

SHORT: Final = 256
"""Number of weights whose sum fits into 16 bits: 256 * 127 < 2**15."""

SIDE: Final = 6
"""Number of cells of the first layer that are computed at a time."""


@compiled
def look_up(counts: Codes, table: Codes, codes: Codes) -> None:  # pragma: no cover (machine code)
    """Write table[counts] to codes; all flat, the table of 256."""
    whole = counts.size - counts.size % BYTES
    for i in range(0, whole, BYTES):
        store_lookup_bytes(table, counts, i, codes)
    for i in range(whole, counts.size):
        codes[i] = table[counts[i]]


@compiled
def convolve_codes(
    like: tuple[int, ...],
    x: Codes,
    weight: NDArray[np.signedinteger[Any]],
    factor: Array,
    offset: Array,
    before: Array,
    after: Array,
    decay: Any,
    v_th: Any,
    indices: Indices,
    starts: Indices,
) -> int:  # pragma: no cover (machine code)
    """Convolution of 8-bit codes, 3x3, stride 2, zero padding of 1, followed by one LIF step.

    Six output cells are computed at a time; the last group may contain cells beyond the row.

    Args:
        like: tuple whose length is the number of vectors in a tile of six cells.
        x: codes (R, C, H, W).
        weight: (3, groups of channels, 3, C', G), flat; zeros for channels that fill the last group. A group has four
            channels with int8 weights, which needs `vectors.has_byte_products`, and two with int16 weights.
        factor: (C') scale of the integer sums.
        offset: (C') added after scaling.
        before: membrane potentials (B, H', W', C') before the step.
        after: potentials after the step, written.
        decay: leak per step.
        v_th: firing threshold.
        indices: indices of the output's spikes, written; see SpikeList.
        starts: (R * H' * W' + 1) where each cell's spikes begin, written.

    Returns:
        number of spikes.
    """
    maps, channels, rows, columns = x.shape
    outputs, width, plane = factor.size, LANES * len(like), rows * columns
    batch = before.shape[0]
    n = before.size // batch
    v, v_after, found, cell = before.reshape(-1), after.reshape(-1), 0, 0
    group = 4 // weight.itemsize
    codes, groups, across = x.reshape(-1), (channels + group - 1) // group, (columns + 1) // 2
    wide, next_cell = group * (2 * (across + SIDE) + 3), 2 * group  # with zero padding left and right
    lines = np.zeros(
        3 * groups * wide, weight.dtype
    )  # the kernel's rows, by row number modulo three; a group of channels for each column
    currents = np.empty(SIDE * outputs, np.float32)
    for r in range(maps):
        if r == batch:
            v = v_after
        at = 0  # index in the output map
        for row in range(-1, rows - 1, 2):  # first row of the kernel
            top, bottom = max(row, 0), min(row + 3, rows)
            for y in range(top if row < 0 else row + 1, bottom):
                begin = (r * channels * rows + y) * columns
                _interleave_row(codes, begin, plane, channels, columns, lines, y % 3 * groups * wide + group, wide)
            for first in range(0, across, SIDE):
                for tile in range(0, outputs, width):
                    a, b, c = zeros_int32(like), zeros_int32(like), zeros_int32(like)
                    d, e, f = zeros_int32(like), zeros_int32(like), zeros_int32(like)
                    for y in range(top, bottom):
                        w = ((y - row) * groups * 3 * outputs + tile) * group
                        for q in range(groups):
                            k = (y % 3 * groups + q) * wide + next_cell * first
                            for _ in range(3):
                                a = add_dot_products(a, lines, k, weight, w)
                                b = add_dot_products(b, lines, k + next_cell, weight, w)
                                c = add_dot_products(c, lines, k + 2 * next_cell, weight, w)
                                d = add_dot_products(d, lines, k + 3 * next_cell, weight, w)
                                e = add_dot_products(e, lines, k + 4 * next_cell, weight, w)
                                f = add_dot_products(f, lines, k + 5 * next_cell, weight, w)
                                k += group
                                w += group * outputs
                    store(scale_and_offset(to_float(a), factor, offset, tile), currents, tile)
                    store(scale_and_offset(to_float(b), factor, offset, tile), currents, outputs + tile)
                    store(scale_and_offset(to_float(c), factor, offset, tile), currents, 2 * outputs + tile)
                    store(scale_and_offset(to_float(d), factor, offset, tile), currents, 3 * outputs + tile)
                    store(scale_and_offset(to_float(e), factor, offset, tile), currents, 4 * outputs + tile)
                    store(scale_and_offset(to_float(f), factor, offset, tile), currents, 5 * outputs + tile)
                for i in range(min(SIDE, across - first)):
                    starts[cell] = found
                    cell += 1
                    for tile in range(i * outputs, (i + 1) * outputs, width):
                        current = add(zeros(like), currents, tile)
                        found = fire_tile(current, v, v_after, r % batch * n + at, decay, v_th, indices, found, at)
                        at += width
    starts[cell] = found
    return found


@compiled
def _interleave_row(
    codes: Codes, begin: int, plane: int, channels: int, columns: int, lines: NDArray[Any], into: int, wide: int
) -> None:  # pragma: no cover (machine code)
    """Copy one row of all channels, a group of channels interleaved; missing ones hold any value, their weights are 0.

    Args:
        codes: codes of the maps, flat.
        begin: index of the row in the first channel.
        plane: distance from a channel to the next one.
        channels: number of channels of the map.
        columns: number of columns of the row.
        lines: output.
        into: index in `lines` of the first group.
        wide: distance from a group to the next one.
    """
    group = 4 // lines.itemsize
    for first in range(0, channels, group):
        most = channels - 1 - first
        a = begin + first * plane
        b, c, d = a + min(1, most) * plane, a + min(2, most) * plane, a + min(3, most) * plane
        if columns < LANES:
            for i in range(columns):
                at = into + group * i
                lines[at], lines[at + 1] = codes[a + i], codes[b + i]
                if group == 4:
                    lines[at + 2], lines[at + 3] = codes[c + i], codes[d + i]
        else:
            for column in range(0, columns, LANES):
                i = min(column, columns - LANES)
                if group == 4:
                    store_interleaved(codes, a + i, b + i, c + i, d + i, lines, into + 4 * i)
                else:
                    store_pairs(codes, a + i, b + i, lines, into + 2 * i)
        into += wide


@compiled
def fire_sums(
    like: tuple[int, ...],
    sums: Array,
    factor: Array,
    offset: Array,
    before: Array,
    after: Array,
    decay: Any,
    v_th: Any,
    indices: Indices,
    starts: Indices,
) -> int:  # pragma: no cover (machine code)
    """One LIF step of currents sums * factor + offset, sums (R * cells * C'); else as sparse_kernels.fire_currents."""
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
                current = scale_and_offset(add(zeros(like), sums, r * n + at + tile), factor, offset, tile)
                where = r % batch * n + at + tile
                found = fire_tile(current, v, v_after, where, decay, v_th, indices, found, at + tile)
    starts[starts.size - 1] = found
    return found


@compiled
def convolve_list(
    like: tuple[int, ...],
    given: Indices,
    given_starts: Indices,
    shape: tuple[int, int, int, int],
    weight: NDArray[np.int8],
    most: int,
    factor: Array,
    offset: Array,
    before: Array,
    after: Array,
    decay: Any,
    v_th: Any,
    indices: Indices,
    starts: Indices,
) -> int:  # pragma: no cover (machine code)
    """Convolution of a spike list with int8 weights, 3x3, stride 2, zero padding of 1, followed by one LIF step.

    The weight rows of all spikes under the kernel are first written into one array. One long loop then adds them,
    because a processor mispredicts the ends of short loops.

    Args:
        like: tuple whose length is the number of vectors in a tile.
        given: indices of the input's spikes; see SpikeList.
        given_starts: (R * H * W + 1) of the input.
        shape: R, H, W, C of the input.
        weight: (3, 3, C, C') and a row of C' zeros, flat.
        most: number of spikes, a multiple of four, whose weights can be summed in 16 bits.
        factor: (C') scale of the integer sums.
        offset: (C') added after scaling.
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
    outputs, width = factor.size, LANES * len(like)
    batch = before.shape[0]
    n = before.size // batch
    v, v_after, found, cell = before.reshape(-1), after.reshape(-1), 0, 0
    silent = 9 * channels * outputs  # the row of zeros
    rows_to_add = np.empty(9 * channels + 3 * LANES, np.int32)
    for r in range(maps):
        if r == batch:
            v = v_after
        at = 0  # index in the output map
        for row in range(-1, rows - 1, 2):  # first row of the kernel
            for column in range(-1, columns - 1, 2):
                starts[cell] = found
                cell += 1
                left, right = max(column, 0), min(column + 3, columns)
                count = 0
                for y in range(max(row, 0), min(row + 3, rows)):
                    line = (r * rows + y) * columns
                    shift = ((y - row) * 3 - (y * columns + column)) * channels
                    begin, end = given_starts[line + left], given_starts[line + right]
                    store_row_starts(given, begin, shift, outputs, rows_to_add, count)
                    for more in range(2 * LANES, end - begin, 2 * LANES):
                        store_row_starts(given, begin + more, shift, outputs, rows_to_add, count + more)
                    count += end - begin
                store_repeated(silent, rows_to_add, count)
                for tile in range(0, outputs, width):
                    total = zeros_int32(like)
                    for few in range(0, count, most):
                        part = zeros_int16(like)
                        for i in range(few, min(few + most, count), 4):
                            part = add_int16(part, weight, element(rows_to_add, i) + tile)
                            part = add_int16(part, weight, element(rows_to_add, i + 1) + tile)
                            part = add_int16(part, weight, element(rows_to_add, i + 2) + tile)
                            part = add_int16(part, weight, element(rows_to_add, i + 3) + tile)
                        total = add_widened(total, part)
                    current = scale_and_offset(to_float(total), factor, offset, tile)
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
    weight: NDArray[np.int8],
    factor: Array,
    offset: Array,
    chunk: int,
    currents: Array,
) -> None:  # pragma: no cover (machine code)
    """Currents (R, F): the sum of the weight rows of the spikes, times factor plus offset.

    Args:
        like: tuple whose length is the number of vectors in a tile.
        given: indices of the spikes; see SpikeList.
        starts: (R * cells + 1).
        cells: number of cells of a map.
        weight: (I, F), flat.
        factor: (F) scale of the integer sums.
        offset: (F) added after scaling.
        chunk: number of cells whose weights stay in the cache while all maps are processed.
        currents: written.
    """
    maps, features = currents.shape
    width, found, sums = LANES * len(like), currents.reshape(-1), np.zeros(currents.size, np.int32)
    for start in range(0, cells, chunk):
        stop = min(start + chunk, cells)
        for r in range(maps):
            begin, end = starts[r * cells + start], starts[r * cells + stop]
            for first in range(0, features, width):
                total = add_int32(zeros_int32(like), sums, r * features + first)
                for few in range(begin, end, SHORT):
                    part = zeros_int16(like)
                    for i in range(few, min(few + SHORT, end)):
                        part = add_int16(part, weight, element(given, i) * features + first)
                    total = add_widened(total, part)
                store(total, sums, r * features + first)
    for r in range(maps):
        for first in range(0, features, width):
            total = add_int32(zeros_int32(like), sums, r * features + first)
            store(scale_and_offset(to_float(total), factor, offset, first), found, r * features + first)
