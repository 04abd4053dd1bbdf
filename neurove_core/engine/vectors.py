"""Vectors in compiled loops: sums that stay in registers, of floats or whole numbers, and lists of neurons that fire.

numba's own vectors begin anew with every inner loop, and a loop over 64 channels is too short for that. Here a tile of
up to 128 channels is one value of a compiled function. LLVM makes of it what the machine has, and nothing is reordered
or fused but where it says so: each lane is rounded as the same lines on single numbers would be.

A tile's width is told to compiled code by the type of `like`, a tuple of as many numbers as the tile has vectors of 16.

Whole numbers wrap where they overflow, so a sum that fits in the end is right whatever lay between.
"""

from typing import Any, Final

from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.core.datamodel import models
from numba.core.registry import cpu_target
from numba.extending import intrinsic, register_model

LANES: Final = 16
"""Of one vector; widths of tiles are multiples of it."""

BYTES: Final = 64
"""Of one vector of bytes."""

_FLOAT, _SHORT, _INT = ir.FloatType(), ir.IntType(16), ir.IntType(32)
_function_of: Any = cgutils.get_or_insert_function
instructions: Any = intrinsic  # for a type checker: compiled code calls what it gives without the first argument


def tile_of(channels: int, most: int = 8) -> tuple[int, ...]:
    """The widest tile that divides a number of channels, itself a multiple of LANES; `like` of compiled functions.

    Args:
        channels: to divide.
        most: vectors of a tile, a power of two; eight are half of AVX-512's registers.
    """
    count = most
    while channels % (count * LANES):
        count //= 2
    return (0,) * count


class Vector(types.Type):
    """Some vectors of LANES float32."""

    def __init__(self, count: int) -> None:  # pragma: no cover (compiler)
        self.count = count
        super().__init__(f"Vector({count})")


@register_model(Vector)
class _VectorModel(models.PrimitiveModel):
    def __init__(self, manager: Any, kind: Vector) -> None:  # pragma: no cover (compiler)
        super().__init__(manager, kind, ir.VectorType(_FLOAT, LANES * kind.count))  # type: ignore[no-untyped-call]  # numba's


class Whole(types.Type):
    """Some vectors of LANES whole numbers."""

    def __init__(self, count: int, bits: int) -> None:  # pragma: no cover (compiler)
        self.count, self.bits = count, bits
        super().__init__(f"Whole({count}, {bits})")


@register_model(Whole)
class _WholeModel(models.PrimitiveModel):
    def __init__(self, manager: Any, kind: Whole) -> None:  # pragma: no cover (compiler)
        super().__init__(manager, kind, ir.VectorType(ir.IntType(kind.bits), LANES * kind.count))  # type: ignore[no-untyped-call]  # numba's


def multiplies_bytes() -> bool:
    """Whether `plus_dots` has its instruction in the machine code that numba writes here."""
    return "+avx512vnni" in cpu_target.target_context.codegen().magic_tuple()[2]


# What follows writes LLVM's instructions; numba calls it while it compiles, and never where its cache has the result.


@instructions
def nothing(typing, like):  # type: ignore[no-untyped-def]  # pragma: no cover (compiler)
    """A tile of zeros."""

    def write(context, builder, signature, args):  # type: ignore[no-untyped-def]
        return _filled(0.0, LANES * like.count)

    return Vector(like.count)(like), write


@instructions
def plus(typing, tile, numbers, at):  # type: ignore[no-untyped-def]  # pragma: no cover (compiler)
    """The tile plus the float32 that begin at numbers[at], of a flat array."""

    def write(context, builder, signature, args):  # type: ignore[no-untyped-def]
        where = _address(context, builder, signature.args[1], args[1], args[2], args[0].type)
        return builder.fadd(args[0], builder.load(where, align=4))

    return tile(tile, numbers, types.intp), write


@instructions
def plus_product(typing, tile, values, i, numbers, at):  # type: ignore[no-untyped-def]  # pragma: no cover (compiler)
    """The tile plus values[i] times the float32 that begin at numbers[at], rounded once, as a fused product is."""

    def write(context, builder, signature, args):  # type: ignore[no-untyped-def]
        tile, values, i, numbers, at = args
        value = _spread(
            builder, _entry(context, builder, signature.args[1], values, i), LANES * signature.args[0].count
        )
        factors = builder.load(_address(context, builder, signature.args[3], numbers, at, tile.type), align=4)
        kind = tile.type
        fused = _function_of(builder.module, ir.FunctionType(kind, [kind] * 3), f"llvm.fma.v{kind.count}f32")
        return builder.call(fused, [value, factors, tile])

    return tile(tile, values, types.intp, numbers, types.intp), write


@instructions
def put_entries(typing, table, numbers, i, out):  # type: ignore[no-untyped-def]  # pragma: no cover (compiler)
    """Write table[numbers[i]] to out[i], of BYTES numbers from i on; all uint8 and flat, the table of 256."""

    def write(context, builder, signature, args):  # type: ignore[no-untyped-def]
        table, numbers, i, out = args
        kind = ir.VectorType(ir.IntType(8), BYTES)
        given = builder.load(_address(context, builder, signature.args[1], numbers, i, kind), align=1)
        if "+avx512vbmi" in context.codegen().magic_tuple()[2]:
            found = _by_vectors(context, builder, signature.args[0], table, given)
        else:
            found = ir.Constant(kind, ir.Undefined)
            for lane in range(BYTES):
                at = builder.zext(builder.extract_element(given, ir.Constant(_INT, lane)), ir.IntType(64))
                value = _entry(context, builder, signature.args[0], table, at)
                found = builder.insert_element(found, value, ir.Constant(_INT, lane))
        builder.store(found, _address(context, builder, signature.args[3], out, i, kind), align=1)
        return context.get_dummy_value()

    return types.none(table, numbers, types.intp, out), write


@instructions
def put_floats(typing, table, numbers, i, out, at):  # type: ignore[no-untyped-def]  # pragma: no cover (compiler)
    """Write table[numbers[i]] to out[at], and so on for LANES; a flat table of 256 float32, numbers uint8."""

    def write(context, builder, signature, args):  # type: ignore[no-untyped-def]
        table, numbers, i, out, at = args
        bytes_, kind = ir.VectorType(ir.IntType(8), LANES), ir.VectorType(_FLOAT, LANES)
        given = builder.load(_address(context, builder, signature.args[1], numbers, i, bytes_), align=1)
        given = builder.zext(given, ir.VectorType(_INT, LANES))
        where = _address(context, builder, signature.args[3], out, at, kind)

        def one_by_one() -> None:
            found = ir.Constant(kind, ir.Undefined)
            for lane in range(LANES):
                entry = builder.zext(builder.extract_element(given, ir.Constant(_INT, lane)), ir.IntType(64))
                value = _entry(context, builder, signature.args[0], table, entry)
                found = builder.insert_element(found, value, ir.Constant(_INT, lane))
            builder.store(found, where, align=4)

        if "+avx512f" not in context.codegen().magic_tuple()[2]:
            one_by_one()
            return context.get_dummy_value()
        few = builder.icmp_unsigned("<", given, ir.Constant(given.type, [2 * LANES] * LANES))
        whole = ir.IntType(LANES)
        every = builder.icmp_unsigned("==", builder.bitcast(few, whole), ir.Constant(whole, (1 << LANES) - 1))
        with builder.if_else(every, likely=True) as (in_two_vectors, otherwise):
            with in_two_vectors:
                signature_ = ir.FunctionType(kind, [kind, given.type, kind])
                look_up = _function_of(builder.module, signature_, "llvm.x86.avx512.vpermi2var.ps.512")
                halves = [
                    builder.load(
                        _address(context, builder, signature.args[0], table, ir.Constant(ir.IntType(64), half), kind),
                        align=4,
                    )
                    for half in (0, LANES)
                ]
                builder.store(builder.call(look_up, [halves[0], given, halves[1]]), where, align=4)
            with otherwise:
                one_by_one()
        return context.get_dummy_value()

    return types.none(table, numbers, types.intp, out, types.intp), write


@instructions
def put_fours(typing, numbers, first, second, third, fourth, out, at):  # type: ignore[no-untyped-def]  # pragma: no cover (compiler)
    """Write one number each of the four rows of LANES uint8 that begin there to out[at], then the next of each."""

    def write(context, builder, signature, args):  # type: ignore[no-untyped-def]
        numbers, *begins, out, at = args
        row, kind = (ir.VectorType(ir.IntType(8), count * LANES) for count in (1, 4))
        rows = [
            builder.load(_address(context, builder, signature.args[0], numbers, begin, row), align=1)
            for begin in begins
        ]
        order = ir.Constant(ir.VectorType(_INT, 4 * LANES), [lane // 4 + lane % 4 * LANES for lane in range(4 * LANES)])
        joined = _joined(builder, rows)
        mixed = builder.shuffle_vector(joined, ir.Constant(joined.type, ir.Undefined), order)
        builder.store(mixed, _address(context, builder, signature.args[5], out, at, kind), align=1)
        return context.get_dummy_value()

    whole = types.intp
    return types.none(numbers, whole, whole, whole, whole, out, whole), write


@instructions
def no_shorts(typing, like):  # type: ignore[no-untyped-def]  # pragma: no cover (compiler)
    """A tile of zeros, whole numbers of 16 bits."""

    def write(context, builder, signature, args):  # type: ignore[no-untyped-def]
        return ir.Constant(ir.VectorType(_SHORT, LANES * like.count), [0] * LANES * like.count)

    return Whole(like.count, 16)(like), write


@instructions
def no_sums(typing, like):  # type: ignore[no-untyped-def]  # pragma: no cover (compiler)
    """A tile of zeros, whole numbers of 32 bits."""

    def write(context, builder, signature, args):  # type: ignore[no-untyped-def]
        return ir.Constant(ir.VectorType(_INT, LANES * like.count), [0] * LANES * like.count)

    return Whole(like.count, 32)(like), write


@instructions
def plus_shorts(typing, tile, numbers, at):  # type: ignore[no-untyped-def]  # pragma: no cover (compiler)
    """A tile of 16 bits plus the int8 or int16 that begin at numbers[at], of a flat array."""

    def write(context, builder, signature, args):  # type: ignore[no-untyped-def]
        kind = ir.VectorType(ir.IntType(signature.args[1].dtype.bitwidth), LANES * signature.args[0].count)
        where = _address(context, builder, signature.args[1], args[1], args[2], kind)
        numbers = builder.load(where, align=1)
        return builder.add(args[0], builder.sext(numbers, args[0].type) if numbers.type != args[0].type else numbers)

    return tile(tile, numbers, types.intp), write


@instructions
def plus_sums(typing, tile, numbers, at):  # type: ignore[no-untyped-def]  # pragma: no cover (compiler)
    """A tile of 32 bits plus the int32 that begin at numbers[at], of a flat array."""

    def write(context, builder, signature, args):  # type: ignore[no-untyped-def]
        where = _address(context, builder, signature.args[1], args[1], args[2], args[0].type)
        return builder.add(args[0], builder.load(where, align=4))

    return tile(tile, numbers, types.intp), write


@instructions
def scaled(typing, tile, factor, offset, at):  # type: ignore[no-untyped-def]  # pragma: no cover (compiler)
    """A tile of float32 times factor[at] and what follows, plus offset[at]: rounded twice."""

    def write(context, builder, signature, args):  # type: ignore[no-untyped-def]
        tile, factor, offset, at = args
        factors = builder.load(_address(context, builder, signature.args[1], factor, at, tile.type), align=4)
        offsets = builder.load(_address(context, builder, signature.args[2], offset, at, tile.type), align=4)
        return builder.fadd(builder.fmul(tile, factors), offsets)

    return tile(tile, factor, offset, types.intp), write


@instructions
def plus_wide(typing, tile, part):  # type: ignore[no-untyped-def]  # pragma: no cover (compiler)
    """A tile of 32 bits plus one of 16."""

    def write(context, builder, signature, args):  # type: ignore[no-untyped-def]
        return builder.add(args[0], builder.sext(args[1], args[0].type))

    return tile(tile, part), write


@instructions
def plus_dots(typing, tile, values, i, numbers, at):  # type: ignore[no-untyped-def]  # pragma: no cover (compiler)
    """A tile of 32 bits plus four products for each lane: of values[i : i + 4] and its own four of numbers[at :].

    Args:
        typing: numba's.
        tile: to add to.
        values: uint8, flat.
        i: of the first of the four, whatever its alignment.
        numbers: int8, flat; four for each lane.
        at: of the first lane's.
    """

    def write(context, builder, signature, args):  # type: ignore[no-untyped-def]
        tile, values, i, numbers, at = args
        four, one = ir.VectorType(_INT, 1), ir.VectorType(_INT, LANES)
        where = _address(context, builder, signature.args[1], values, i, four)
        value = _spread(builder, builder.extract_element(builder.load(where, align=1), ir.Constant(_INT, 0)), LANES)
        dots = _function_of(builder.module, ir.FunctionType(one, [one] * 3), "llvm.x86.avx512.vpdpbusd.512")
        parts, bytes_ = [], ir.VectorType(ir.IntType(8), 4 * LANES)
        for start in range(0, tile.type.count, LANES):
            own = _numbers(range(start, start + LANES))
            own = builder.shuffle_vector(tile, ir.Constant(tile.type, ir.Undefined), own)
            first = builder.add(at, ir.Constant(at.type, 4 * start))
            weights = builder.load(_address(context, builder, signature.args[3], numbers, first, bytes_), align=1)
            parts.append(builder.call(dots, [own, value, builder.bitcast(weights, one)]))
        return _joined(builder, parts)

    return tile(tile, values, types.intp, numbers, types.intp), write


@instructions
def in_float(typing, tile):  # type: ignore[no-untyped-def]  # pragma: no cover (compiler)
    """A tile of 32 bits as float32, rounded where it is 2**24 or more."""

    def write(context, builder, signature, args):  # type: ignore[no-untyped-def]
        return builder.sitofp(args[0], ir.VectorType(_FLOAT, args[0].type.count))

    return Vector(tile.count)(tile), write


@instructions
def entry(typing, numbers, i):  # type: ignore[no-untyped-def]  # pragma: no cover (compiler)
    """numbers[i] of a flat array, i not negative: numba would ask each time whether it is."""

    def write(context, builder, signature, args):  # type: ignore[no-untyped-def]
        return _entry(context, builder, signature.args[0], *args)

    return numbers.dtype(numbers, types.intp), write


@instructions
def put(typing, tile, numbers, at):  # type: ignore[no-untyped-def]  # pragma: no cover (compiler)
    """Write the tile to numbers[at] and what follows."""

    def write(context, builder, signature, args):  # type: ignore[no-untyped-def]
        where = _address(context, builder, signature.args[1], args[1], args[2], args[0].type)
        builder.store(args[0], where, align=4)
        return context.get_dummy_value()

    return types.none(tile, numbers, types.intp), write


@instructions
def put_rows(typing, places, i, shift, factor, numbers, at):  # type: ignore[no-untyped-def]  # pragma: no cover (compiler)
    """Write (places + shift) * factor of 2 * LANES int32 from places[i] on to numbers[at] and what follows."""

    def write(context, builder, signature, args):  # type: ignore[no-untyped-def]
        places, i, shift, factor, numbers, at = args
        kind = ir.VectorType(_INT, 2 * LANES)
        given = builder.load(_address(context, builder, signature.args[0], places, i, kind), align=4)
        shift, factor = (_spread(builder, builder.trunc(one, _INT), 2 * LANES) for one in (shift, factor))
        rows = builder.mul(builder.add(given, shift), factor)
        builder.store(rows, _address(context, builder, signature.args[4], numbers, at, kind), align=4)
        return context.get_dummy_value()

    whole = types.intp
    return types.none(places, whole, whole, whole, numbers, whole), write


@instructions
def put_number(typing, number, numbers, at):  # type: ignore[no-untyped-def]  # pragma: no cover (compiler)
    """Write LANES times one number to numbers[at] and what follows, int32."""

    def write(context, builder, signature, args):  # type: ignore[no-untyped-def]
        kind = ir.VectorType(_INT, LANES)
        where = _address(context, builder, signature.args[1], args[1], args[2], kind)
        builder.store(_spread(builder, builder.trunc(args[0], _INT), LANES), where, align=4)
        return context.get_dummy_value()

    return types.none(types.intp, numbers, types.intp), write


@instructions
def fire(typing, currents, before, after, at, decay, v_th, fired, found, first):  # type: ignore[no-untyped-def]  # pragma: no cover (compiler)
    """One step of the LIF neurons of a tile, as scan._in_place; which of them fire is written down.

    Args:
        typing: numba's.
        currents: a tile.
        before: potentials, float32, flat.
        after: the same, written; may be `before`.
        at: where the tile's begin.
        decay: float32, per step.
        v_th: float32, firing threshold.
        fired: int32, gets the places of those that fire; up to LANES numbers behind the last are overwritten.
        found: how many it holds already.
        first: place of the tile's first neuron.

    Returns:
        how many `fired` holds now.
    """

    def write(context, builder, signature, args):  # type: ignore[no-untyped-def]
        current, before, after, at, decay, v_th, fired, found, first = args
        lanes = LANES * currents.count
        v = builder.load(_address(context, builder, signature.args[1], before, at, current.type), align=4)
        leaked = builder.fmul(_spread(builder, decay, lanes), v)
        u = builder.fadd(leaked, current)
        none, one = _filled(0.0, lanes), _filled(1.0, lanes)
        fires = builder.fcmp_ordered(">=", builder.fsub(u, _spread(builder, v_th, lanes)), none)
        where = _address(context, builder, signature.args[2], after, at, current.type)
        builder.store(builder.fmul(u, builder.select(fires, none, one)), where, align=4)
        places = _spread(builder, builder.trunc(first, _INT), LANES)
        for start in range(0, lanes, LANES):
            own = _numbers(range(start, start + LANES))
            some = builder.shuffle_vector(fires, ir.Constant(fires.type, ir.Undefined), own)
            where = _address(context, builder, signature.args[6], fired, found, places.type)
            builder.store(_packed(builder, builder.add(places, own), some), where, align=4)
            found = builder.add(found, _count(builder, some))
        return found

    single = types.float32, types.float32
    return types.intp(currents, before, after, types.intp, *single, fired, types.intp, types.intp), write


def _filled(value: float, lanes: int) -> Any:  # pragma: no cover (compiler)
    return ir.Constant(ir.VectorType(_FLOAT, lanes), [value] * lanes)


def _numbers(values: range) -> Any:  # pragma: no cover (compiler)
    return ir.Constant(ir.VectorType(_INT, len(values)), list(values))


def _spread(builder: Any, value: Any, lanes: int) -> Any:  # pragma: no cover (compiler)
    """One number in all lanes."""
    kind = ir.VectorType(value.type, lanes)
    single = builder.insert_element(ir.Constant(kind, ir.Undefined), value, ir.Constant(_INT, 0))
    everywhere = ir.Constant(ir.VectorType(_INT, lanes), [0] * lanes)
    return builder.shuffle_vector(single, ir.Constant(kind, ir.Undefined), everywhere)


def _joined(builder: Any, parts: list[Any]) -> Any:  # pragma: no cover (compiler)
    """One vector of two to the power of something."""
    while len(parts) > 1:
        lanes = _numbers(range(2 * parts[0].type.count))
        parts = [builder.shuffle_vector(a, b, lanes) for a, b in zip(parts[::2], parts[1::2], strict=True)]
    return parts[0]


def _by_vectors(context: Any, builder: Any, kind: Any, table: Any, given: Any) -> Any:  # pragma: no cover (compiler)
    """Entries of a table of 256 bytes, two halves of which are looked up at once."""
    vector = given.type
    look_up = _function_of(builder.module, ir.FunctionType(vector, [vector] * 3), "llvm.x86.avx512.vpermi2var.qi.512")
    begins = [ir.Constant(ir.IntType(64), begin) for begin in range(0, 256, BYTES)]
    parts = [builder.load(_address(context, builder, kind, table, begin, vector), align=1) for begin in begins]
    low, high = (builder.call(look_up, [parts[half], given, parts[half + 1]]) for half in (0, 2))
    return builder.select(builder.icmp_signed("<", given, ir.Constant(vector, [0] * BYTES)), high, low)


def _entry(context: Any, builder: Any, kind: Any, array: Any, at: Any) -> Any:  # pragma: no cover (compiler)
    return builder.load(builder.gep(context.make_array(kind)(context, builder, array).data, [at]))


def _address(context: Any, builder: Any, kind: Any, array: Any, at: Any, vector: Any) -> Any:  # pragma: no cover
    data = context.make_array(kind)(context, builder, array).data
    return builder.bitcast(builder.gep(data, [at]), vector.as_pointer())


def _packed(builder: Any, numbers: Any, some: Any) -> Any:  # pragma: no cover (compiler)
    """Those of a vector's int32 that are asked for, moved together; what follows them is anything."""
    kind = numbers.type
    signature = ir.FunctionType(kind, [kind, some.type, kind])
    compress = _function_of(builder.module, signature, f"llvm.experimental.vector.compress.v{LANES}i32")
    return builder.call(compress, [numbers, some, ir.Constant(kind, ir.Undefined)])


def _count(builder: Any, some: Any) -> Any:  # pragma: no cover (compiler)
    kind = ir.IntType(LANES)
    ones = _function_of(builder.module, ir.FunctionType(kind, [kind]), f"llvm.ctpop.i{LANES}")
    return builder.zext(builder.call(ones, [builder.bitcast(some, kind)]), ir.IntType(64))
