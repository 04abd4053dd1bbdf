"""Vectors in compiled loops: sums that stay in registers, for floats and integers, and lists of neurons that fire.

numba vectorises each inner loop on its own, and a loop over 64 channels is too short for that. Here a tile of up to 128
channels is one value of a compiled function. LLVM maps it to the machine's vectors. Nothing is reordered or fused
unless the docstring says so: each lane is rounded as the same lines on single numbers would be.

The type of `like`, a tuple with one number for each vector of 16 lanes, sets the width of a tile; see tiles.tile_of.

Integers wrap on overflow, so a sum that fits in the end is right whatever its partial sums were.

This module imports private modules of numba and llvmlite, which a new release may change. It is therefore imported only
by the kernels, and these only where `fallback.vectors_work()`.
"""

from typing import Any

import numpy as np
from llvmlite import ir
from numba import types
from numba.core.datamodel import models
from numba.core.registry import cpu_target
from numba.extending import intrinsic, register_model
from numpy.typing import NDArray

from neurove_core.compiled import compiled
from neurove_core.engine.llvm import (
    FLOAT,
    INT,
    SHORT,
    array_element,
    constant_vector,
    function_of,
    in_every_lane,
    joined_vectors,
    lane_numbers,
    sums_of_pairs,
    vector_address,
    with_appended,
)
from neurove_core.engine.tiles import LANES, tile_of

instructions: Any = intrinsic  # for a type checker: compiled code calls the result without the first argument


class FloatTile(types.Type):
    """numba's type of a tile of float32: `count` vectors of LANES numbers."""

    def __init__(self, count: int) -> None:  # pragma: no cover (compiler)
        self.count = count
        super().__init__(f"FloatTile({count})")


@register_model(FloatTile)
class _FloatTileModel(models.PrimitiveModel):
    def __init__(self, manager: Any, kind: FloatTile) -> None:  # pragma: no cover (compiler)
        super().__init__(manager, kind, ir.VectorType(FLOAT, LANES * kind.count))  # type: ignore[no-untyped-call]  # numba's


class IntegerTile(types.Type):
    """numba's type of a tile of integers: `count` vectors of LANES numbers."""

    def __init__(self, count: int, bits: int) -> None:  # pragma: no cover (compiler)
        self.count, self.bits = count, bits
        super().__init__(f"IntegerTile({count}, {bits})")


@register_model(IntegerTile)
class _IntegerTileModel(models.PrimitiveModel):
    def __init__(self, manager: Any, kind: IntegerTile) -> None:  # pragma: no cover (compiler)
        super().__init__(manager, kind, ir.VectorType(ir.IntType(kind.bits), LANES * kind.count))  # type: ignore[no-untyped-call]  # numba's


def has_byte_products() -> bool:
    """Whether numba may use the instruction of `add_dot_products` on this processor (AVX-512 VNNI)."""
    return "+avx512vnni" in cpu_target.target_context.codegen().magic_tuple()[2]


def cells_tile(channels: int) -> tuple[int, ...]:
    """The tile of kernels that compute six cells at a time: their sums fit into the registers of this processor."""
    return tile_of(channels, most=2 if _wide() else 1)


def list_tile(channels: int) -> tuple[int, ...]:
    """The tile of kernels over spike lists: its sums fill at most half of the registers of this processor."""
    return tile_of(channels, most=8 if _wide() else 4)


def _wide() -> bool:
    """Whether a vector of LANES numbers is one register; AVX2 needs two, NEON four."""
    return "+avx512f" in cpu_target.target_context.codegen().magic_tuple()[2]


# The functions below emit LLVM instructions. numba calls them while it compiles, not where its cache has the result.


@instructions
def zeros(typing, like):  # type: ignore[no-untyped-def]  # pragma: no cover (compiler)
    """A tile of zeros, float32."""

    def write(context, builder, signature, args):  # type: ignore[no-untyped-def]
        return constant_vector(0.0, LANES * like.count)

    return FloatTile(like.count)(like), write


@instructions
def add(typing, tile, numbers, at):  # type: ignore[no-untyped-def]  # pragma: no cover (compiler)
    """The tile plus the float32 numbers from numbers[at] on, of a flat array."""

    def write(context, builder, signature, args):  # type: ignore[no-untyped-def]
        where = vector_address(context, builder, signature.args[1], args[1], args[2], args[0].type)
        return builder.fadd(args[0], builder.load(where, align=4))

    return tile(tile, numbers, types.intp), write


@instructions
def add_product(typing, tile, values, i, numbers, at):  # type: ignore[no-untyped-def]  # pragma: no cover (compiler)
    """The tile plus values[i] times the float32 numbers from numbers[at] on: a fused multiply-add, rounded once."""

    def write(context, builder, signature, args):  # type: ignore[no-untyped-def]
        tile, values, i, numbers, at = args
        value = in_every_lane(
            builder, array_element(context, builder, signature.args[1], values, i), LANES * signature.args[0].count
        )
        factors = builder.load(vector_address(context, builder, signature.args[3], numbers, at, tile.type), align=4)
        kind = tile.type
        fused = function_of(builder.module, ir.FunctionType(kind, [kind] * 3), f"llvm.fma.v{kind.count}f32")
        return builder.call(fused, [value, factors, tile])

    return tile(tile, values, types.intp, numbers, types.intp), write


@instructions
def zeros_int16(typing, like):  # type: ignore[no-untyped-def]  # pragma: no cover (compiler)
    """A tile of zeros, integers of 16 bits."""

    def write(context, builder, signature, args):  # type: ignore[no-untyped-def]
        return ir.Constant(ir.VectorType(SHORT, LANES * like.count), [0] * LANES * like.count)

    return IntegerTile(like.count, 16)(like), write


@instructions
def zeros_int32(typing, like):  # type: ignore[no-untyped-def]  # pragma: no cover (compiler)
    """A tile of zeros, integers of 32 bits."""

    def write(context, builder, signature, args):  # type: ignore[no-untyped-def]
        return ir.Constant(ir.VectorType(INT, LANES * like.count), [0] * LANES * like.count)

    return IntegerTile(like.count, 32)(like), write


@instructions
def add_int16(typing, tile, numbers, at):  # type: ignore[no-untyped-def]  # pragma: no cover (compiler)
    """A tile of 16-bit integers plus the int8 or int16 from numbers[at] on, of a flat array."""

    def write(context, builder, signature, args):  # type: ignore[no-untyped-def]
        kind = ir.VectorType(ir.IntType(signature.args[1].dtype.bitwidth), LANES * signature.args[0].count)
        where = vector_address(context, builder, signature.args[1], args[1], args[2], kind)
        numbers = builder.load(where, align=1)
        return builder.add(args[0], builder.sext(numbers, args[0].type) if numbers.type != args[0].type else numbers)

    return tile(tile, numbers, types.intp), write


@instructions
def add_int32(typing, tile, numbers, at):  # type: ignore[no-untyped-def]  # pragma: no cover (compiler)
    """A tile of 32-bit integers plus the int32 from numbers[at] on, of a flat array."""

    def write(context, builder, signature, args):  # type: ignore[no-untyped-def]
        where = vector_address(context, builder, signature.args[1], args[1], args[2], args[0].type)
        return builder.add(args[0], builder.load(where, align=4))

    return tile(tile, numbers, types.intp), write


@instructions
def scale_and_offset(typing, tile, factor, offset, at):  # type: ignore[no-untyped-def]  # pragma: no cover (compiler)
    """A tile of float32 times the factors from factor[at] on, plus the offsets from offset[at] on: rounded twice."""

    def write(context, builder, signature, args):  # type: ignore[no-untyped-def]
        tile, factor, offset, at = args
        factors = builder.load(vector_address(context, builder, signature.args[1], factor, at, tile.type), align=4)
        offsets = builder.load(vector_address(context, builder, signature.args[2], offset, at, tile.type), align=4)
        return builder.fadd(builder.fmul(tile, factors), offsets)

    return tile(tile, factor, offset, types.intp), write


@instructions
def add_widened(typing, tile, part):  # type: ignore[no-untyped-def]  # pragma: no cover (compiler)
    """A tile of 32-bit integers plus one of 16-bit integers."""

    def write(context, builder, signature, args):  # type: ignore[no-untyped-def]
        return builder.add(args[0], builder.sext(args[1], args[0].type))

    return tile(tile, part), write


@instructions
def add_dot_products(typing, tile, values, i, numbers, at):  # type: ignore[no-untyped-def]  # pragma: no cover (compiler)
    """Add to each lane the dot product of a group of values and the lane's own numbers, from numbers[at] on.

    A group has four values from 0 to 255 where values and numbers have 8 bits, two where they have 16 bits.

    Args:
        typing: numba's typing context.
        tile: 32-bit integers to add to.
        values: int8, read as uint8, or int16; flat.
        i: index of the first value of the group, in any alignment.
        numbers: int8 or int16, flat; a group for each lane.
        at: index of the first lane's numbers.
    """

    def write(context, builder, signature, args):  # type: ignore[no-untyped-def]
        tile, values, i, numbers, at = args
        in_bytes = signature.args[3].dtype.bitwidth == 8
        lanes, group = (LANES, 4) if in_bytes else (LANES // 2, 2)
        where = vector_address(context, builder, signature.args[1], values, i, ir.VectorType(INT, 1))
        value = builder.extract_element(builder.load(where, align=1), ir.Constant(INT, 0))
        value, one = in_every_lane(builder, value, lanes), ir.VectorType(INT, lanes)
        given = ir.VectorType(ir.IntType(32 // group), group * lanes)
        parts = []
        for start in range(0, tile.type.count, lanes):
            own = lane_numbers(range(start, start + lanes))
            own = builder.shuffle_vector(tile, ir.Constant(tile.type, ir.Undefined), own)
            first = builder.add(at, ir.Constant(at.type, group * start))
            weights = builder.load(vector_address(context, builder, signature.args[3], numbers, first, given), align=1)
            if in_bytes:
                dots = function_of(builder.module, ir.FunctionType(one, [one] * 3), "llvm.x86.avx512.vpdpbusd.512")
                parts.append(builder.call(dots, [own, value, builder.bitcast(weights, one)]))
            else:
                parts.append(builder.add(own, sums_of_pairs(builder, context, builder.bitcast(value, given), weights)))
        return joined_vectors(builder, parts)

    return tile(tile, values, types.intp, numbers, types.intp), write


@instructions
def to_float(typing, tile):  # type: ignore[no-untyped-def]  # pragma: no cover (compiler)
    """A tile of 32-bit integers as float32, rounded from 2**24 on."""

    def write(context, builder, signature, args):  # type: ignore[no-untyped-def]
        return builder.sitofp(args[0], ir.VectorType(FLOAT, args[0].type.count))

    return FloatTile(tile.count)(tile), write


@instructions
def element(typing, numbers, i):  # type: ignore[no-untyped-def]  # pragma: no cover (compiler)
    """numbers[i] of a flat array, i not negative; numba's own indexing tests the sign each time."""

    def write(context, builder, signature, args):  # type: ignore[no-untyped-def]
        return array_element(context, builder, signature.args[0], *args)

    return numbers.dtype(numbers, types.intp), write


@instructions
def store(typing, tile, numbers, at):  # type: ignore[no-untyped-def]  # pragma: no cover (compiler)
    """Write the tile from numbers[at] on."""

    def write(context, builder, signature, args):  # type: ignore[no-untyped-def]
        where = vector_address(context, builder, signature.args[1], args[1], args[2], args[0].type)
        builder.store(args[0], where, align=4)
        return context.get_dummy_value()

    return types.none(tile, numbers, types.intp), write


@instructions
def store_row_starts(typing, indices, i, shift, factor, numbers, at):  # type: ignore[no-untyped-def]  # pragma: no cover (compiler)
    """Write (indices + shift) * factor, for 2 * LANES int32 from indices[i] on, from numbers[at] on."""

    def write(context, builder, signature, args):  # type: ignore[no-untyped-def]
        indices, i, shift, factor, numbers, at = args
        kind = ir.VectorType(INT, 2 * LANES)
        given = builder.load(vector_address(context, builder, signature.args[0], indices, i, kind), align=4)
        shift, factor = (in_every_lane(builder, builder.trunc(one, INT), 2 * LANES) for one in (shift, factor))
        rows = builder.mul(builder.add(given, shift), factor)
        builder.store(rows, vector_address(context, builder, signature.args[4], numbers, at, kind), align=4)
        return context.get_dummy_value()

    whole = types.intp
    return types.none(indices, whole, whole, whole, numbers, whole), write


@instructions
def store_repeated(typing, number, numbers, at):  # type: ignore[no-untyped-def]  # pragma: no cover (compiler)
    """Write one number LANES times from numbers[at] on, int32."""

    def write(context, builder, signature, args):  # type: ignore[no-untyped-def]
        kind = ir.VectorType(INT, LANES)
        where = vector_address(context, builder, signature.args[1], args[1], args[2], kind)
        builder.store(in_every_lane(builder, builder.trunc(args[0], INT), LANES), where, align=4)
        return context.get_dummy_value()

    return types.none(types.intp, numbers, types.intp), write


@instructions
def fire_tile(typing, currents, before, after, at, decay, v_th, fired, found, first):  # type: ignore[no-untyped-def]  # pragma: no cover (compiler)
    """One step of the LIF neurons of a tile, as scan.scan_in_place, and a list of the neurons that fire.

    Args:
        typing: numba's typing context.
        currents: input currents, a tile.
        before: membrane potentials before the step, float32, flat.
        after: potentials after the step, written; may be `before`.
        at: index of the tile's first potential.
        decay: leak per step, float32.
        v_th: firing threshold, float32.
        fired: int32, the indices of neurons that fire are appended; up to LANES numbers behind the last are
            overwritten.
        found: number of indices in `fired`.
        first: index of the tile's first neuron, as written to `fired`.

    Returns:
        number of indices in `fired` afterwards.
    """

    def write(context, builder, signature, args):  # type: ignore[no-untyped-def]
        current, before, after, at, decay, v_th, fired, found, first = args
        lanes = LANES * currents.count
        v = builder.load(vector_address(context, builder, signature.args[1], before, at, current.type), align=4)
        leaked = builder.fmul(in_every_lane(builder, decay, lanes), v)
        u = builder.fadd(leaked, current)
        none, one = constant_vector(0.0, lanes), constant_vector(1.0, lanes)
        fires = builder.fcmp_ordered(">=", builder.fsub(u, in_every_lane(builder, v_th, lanes)), none)
        where = vector_address(context, builder, signature.args[2], after, at, current.type)
        builder.store(builder.fmul(u, builder.select(fires, none, one)), where, align=4)
        for start in range(0, lanes, LANES):
            own = lane_numbers(range(start, start + LANES))
            some = builder.shuffle_vector(fires, ir.Constant(fires.type, ir.Undefined), own)
            base = builder.add(builder.trunc(first, INT), ir.Constant(INT, start))
            found = with_appended(builder, context, signature.args[6], fired, found, base, some)
        return found

    single = types.float32, types.float32
    return types.intp(currents, before, after, types.intp, *single, fired, types.intp, types.intp), write


def check() -> None:
    """Compile and run a small kernel of these functions.

    Raises:
        Exception: whatever numba raises, or RuntimeError where a sum is wrong.
    """
    values = np.arange(LANES, dtype=np.float32)
    twice = np.empty_like(values)
    _add_twice(tile_of(LANES), values, twice)
    if not np.array_equal(twice, 2 * values):
        raise RuntimeError("a vector sum is wrong")


@compiled
def _add_twice(
    like: tuple[int, ...], values: NDArray[np.float32], out: NDArray[np.float32]
) -> None:  # pragma: no cover (machine code)
    store(add(add(zeros(like), values, 0), values, 0), out, 0)
