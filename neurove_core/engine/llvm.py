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


def entry_of_two(builder: Any, halves: list[Any], given: Any) -> Any:  # pragma: no cover (compiler)
    """Look up entries of a table of two vectors of float32, by the instructions of AVX-512 or AVX2."""
    kind, numbers = halves[0].type, given.type
    if kind.count == LANES:
        signature = ir.FunctionType(kind, [kind, numbers, kind])
        look_up = function_of(builder.module, signature, "llvm.x86.avx512.vpermi2var.ps.512")
        return builder.call(look_up, [halves[0], given, halves[1]])
    look_up = function_of(builder.module, ir.FunctionType(kind, [kind, numbers]), "llvm.x86.avx2.permps")
    low, high = (builder.call(look_up, [half, given]) for half in halves)  # by the lowest three bits
    return builder.select(builder.icmp_unsigned("<", given, ir.Constant(numbers, [kind.count] * kind.count)), low, high)


def sums_of_pairs(builder: Any, context: Any, a: Any, b: Any) -> Any:  # pragma: no cover (compiler)
    """Products of int16, each two neighbours added in 32 bits."""
    kind = ir.VectorType(INT, a.type.count // 2)
    if has(context, "avx2"):
        multiply = function_of(builder.module, ir.FunctionType(kind, [a.type] * 2), "llvm.x86.avx2.pmadd.wd")
        return builder.call(multiply, [a, b])
    halves = []
    for first in (0, 1):
        own = lane_numbers(range(first, a.type.count, 2))
        pair = [builder.shuffle_vector(one, ir.Constant(one.type, ir.Undefined), own) for one in (a, b)]
        halves.append(builder.mul(*(builder.sext(one, kind) for one in pair)))
    return builder.add(*halves)


def array_element(context: Any, builder: Any, kind: Any, array: Any, at: Any) -> Any:  # pragma: no cover (compiler)
    """Load array[at] of a flat array."""
    return builder.load(builder.gep(context.make_array(kind)(context, builder, array).data, [at]))


def vector_address(context: Any, builder: Any, kind: Any, array: Any, at: Any, vector: Any) -> Any:  # pragma: no cover
    """The address of array[at] as a pointer to a vector."""
    data = context.make_array(kind)(context, builder, array).data
    return builder.bitcast(builder.gep(data, [at]), vector.as_pointer())


def has(context: Any, feature: str) -> bool:  # pragma: no cover (compiler)
    """Whether code may use instructions of this name, such as avx512f."""
    return f"+{feature}" in context.codegen().magic_tuple()[2]


def with_appended(
    builder: Any, context: Any, kind: Any, fired: Any, found: Any, first: Any, some: Any
) -> Any:  # pragma: no cover (compiler)
    """Append to an array of int32 the numbers of those lanes that are true.

    Args:
        builder: LLVM's.
        context: numba's.
        kind: numba's type of the array.
        fired: the array; up to LANES numbers behind the appended ones are overwritten.
        found: number of entries before.
        first: int32, added to the lanes.
        some: LANES truth values.

    Returns:
        number of entries afterwards.
    """
    if has(context, "avx512f"):
        vector = ir.VectorType(INT, LANES)
        own = builder.add(in_every_lane(builder, first, LANES), lane_numbers(range(LANES)))
        builder.store(
            _compressed(builder, own, some), vector_address(context, builder, kind, fired, found, vector), align=4
        )
        return builder.add(found, _count_true(builder, some))
    table = _lanes_of_a_byte(builder.module)
    vector, base = ir.VectorType(INT, 8), in_every_lane(builder, first, 8)
    for start in range(0, LANES, 8):  # other processors have no such instruction: a table has the lanes of eight bits
        eight = builder.shuffle_vector(
            some, ir.Constant(some.type, ir.Undefined), lane_numbers(range(start, start + 8))
        )
        bits = builder.zext(builder.bitcast(eight, ir.IntType(8)), ir.IntType(64))
        entry = builder.load(builder.gep(table, [ir.Constant(ir.IntType(64), 0), bits], inbounds=True))
        lanes = builder.zext(builder.bitcast(entry, ir.VectorType(ir.IntType(8), 8)), vector)
        lanes = builder.add(lanes, builder.add(base, ir.Constant(vector, [start] * 8)))
        builder.store(lanes, vector_address(context, builder, kind, fired, found, vector), align=4)
        found = builder.add(found, builder.zext(builder.ctpop(builder.trunc(bits, ir.IntType(32))), found.type))
    return found


def _lanes_of_a_byte(module: Any) -> Any:  # pragma: no cover (compiler)
    """A table with the numbers of the bits that are set in each byte, ascending, eight bytes in an integer."""
    numbers = [[bit for bit in range(8) if byte >> bit & 1] for byte in range(256)]
    entries = [int.from_bytes(bytes(found).ljust(8, b"\0"), "little") for found in numbers]
    kind = ir.ArrayType(ir.IntType(64), 256)
    named: Any = cgutils.global_constant
    return named(module, "lanes_of_a_byte", ir.Constant(kind, entries))


def _compressed(builder: Any, numbers: Any, some: Any) -> Any:  # pragma: no cover (compiler)
    """The selected int32 of a vector, moved to its front; the rest is undefined."""
    kind = numbers.type
    signature = ir.FunctionType(kind, [kind, some.type, kind])
    compress = function_of(builder.module, signature, f"llvm.experimental.vector.compress.v{LANES}i32")
    return builder.call(compress, [numbers, some, ir.Constant(kind, ir.Undefined)])


def _count_true(builder: Any, some: Any) -> Any:  # pragma: no cover (compiler)
    """The number of lanes that are true."""
    kind = ir.IntType(LANES)
    ones = function_of(builder.module, ir.FunctionType(kind, [kind]), f"llvm.ctpop.i{LANES}")
    return builder.zext(builder.call(ones, [builder.bitcast(some, kind)]), ir.IntType(64))
