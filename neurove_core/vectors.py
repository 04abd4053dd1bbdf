"""Float vectors in compiled loops: sums that stay in registers, and lists of the neurons that fire.

numba's own vectors begin anew with every inner loop, and a loop over 64 channels is too short for that. Here a tile of
up to 128 channels is one value of a compiled function. LLVM makes of it what the machine has, and nothing is reordered
or fused but where it says so: each lane is rounded as the same lines on single numbers would be.

A tile's width is told to compiled code by the type of `like`, a tuple of as many numbers as the tile has vectors of 16.
"""

from typing import Any, Final

from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.core.datamodel import models
from numba.extending import intrinsic, register_model

LANES: Final = 16
"""Of one vector; widths of tiles are multiples of it."""

_FLOAT, _INT = ir.FloatType(), ir.IntType(32)
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
