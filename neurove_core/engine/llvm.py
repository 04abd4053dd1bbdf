"""Pieces of LLVM code that vectors.py is made of; called while numba compiles.

This module uses private modules of numba and llvmlite, see vectors.py.
"""

from typing import Any, Final

from llvmlite import ir
from numba.core import cgutils

from neurove_core.engine.tiles import BYTES, LANES

FLOAT: Final[Any] = ir.FloatType()
SHORT: Final[Any] = ir.IntType(16)
INT: Final[Any] = ir.IntType(32)
function_of: Final[Any] = cgutils.get_or_insert_function


def constant_vector(value: float, lanes: int) -> Any:  # pragma: no cover (compiler)
    """A constant vector of one float32."""
    return ir.Constant(ir.VectorType(FLOAT, lanes), [value] * lanes)


def lane_numbers(values: range) -> Any:  # pragma: no cover (compiler)
    """A constant vector of these int32."""
    return ir.Constant(ir.VectorType(INT, len(values)), list(values))


def in_every_lane(builder: Any, value: Any, lanes: int) -> Any:  # pragma: no cover (compiler)
    """One number in every lane."""
    kind = ir.VectorType(value.type, lanes)
    single = builder.insert_element(ir.Constant(kind, ir.Undefined), value, ir.Constant(INT, 0))
    everywhere = ir.Constant(ir.VectorType(INT, lanes), [0] * lanes)
    return builder.shuffle_vector(single, ir.Constant(kind, ir.Undefined), everywhere)


def joined_vectors(builder: Any, parts: list[Any]) -> Any:  # pragma: no cover (compiler)
    """Join vectors into one; their number is a power of two."""
    while len(parts) > 1:
        lanes = lane_numbers(range(2 * parts[0].type.count))
        parts = [builder.shuffle_vector(a, b, lanes) for a, b in zip(parts[::2], parts[1::2], strict=True)]
    return parts[0]


def table_entries(context: Any, builder: Any, kind: Any, table: Any, given: Any) -> Any:  # pragma: no cover (compiler)
    """Look up entries of a table of 256 bytes, each half with one instruction."""
    vector = given.type
    look_up = function_of(builder.module, ir.FunctionType(vector, [vector] * 3), "llvm.x86.avx512.vpermi2var.qi.512")
    begins = [ir.Constant(ir.IntType(64), begin) for begin in range(0, 256, BYTES)]
    parts = [builder.load(vector_address(context, builder, kind, table, begin, vector), align=1) for begin in begins]
    low, high = (builder.call(look_up, [parts[half], given, parts[half + 1]]) for half in (0, 2))
    return builder.select(builder.icmp_signed("<", given, ir.Constant(vector, [0] * BYTES)), high, low)


def array_element(context: Any, builder: Any, kind: Any, array: Any, at: Any) -> Any:  # pragma: no cover (compiler)
    """Load array[at] of a flat array."""
    return builder.load(builder.gep(context.make_array(kind)(context, builder, array).data, [at]))


def vector_address(context: Any, builder: Any, kind: Any, array: Any, at: Any, vector: Any) -> Any:  # pragma: no cover
    """The address of array[at] as a pointer to a vector."""
    data = context.make_array(kind)(context, builder, array).data
    return builder.bitcast(builder.gep(data, [at]), vector.as_pointer())


def compressed(builder: Any, numbers: Any, some: Any) -> Any:  # pragma: no cover (compiler)
    """The selected int32 of a vector, moved to its front; the rest is undefined."""
    kind = numbers.type
    signature = ir.FunctionType(kind, [kind, some.type, kind])
    compress = function_of(builder.module, signature, f"llvm.experimental.vector.compress.v{LANES}i32")
    return builder.call(compress, [numbers, some, ir.Constant(kind, ir.Undefined)])


def count_true(builder: Any, some: Any) -> Any:  # pragma: no cover (compiler)
    """The number of lanes that are true."""
    kind = ir.IntType(LANES)
    ones = function_of(builder.module, ir.FunctionType(kind, [kind]), f"llvm.ctpop.i{LANES}")
    return builder.zext(builder.call(ones, [builder.bitcast(some, kind)]), ir.IntType(64))
