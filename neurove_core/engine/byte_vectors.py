"""Vectors of bytes in compiled loops: table look-ups of counts, and rows of channels interleaved.

As vectors.py, from which this module takes its way to write LLVM code; import it only where `fallback.vectors_work()`.
"""

from llvmlite import ir
from numba import types

from neurove_core.engine.llvm import (
    FLOAT,
    INT,
    SHORT,
    array_element,
    entry_of_two,
    has,
    joined_vectors,
    lane_numbers,
    table_entries,
    vector_address,
)
from neurove_core.engine.tiles import BYTES, LANES
from neurove_core.engine.vectors import instructions


@instructions
def store_lookup_bytes(typing, table, numbers, i, out):  # type: ignore[no-untyped-def]  # pragma: no cover (compiler)
    """Write table[numbers[i]] to out[i], for BYTES numbers from i on; all uint8 and flat, the table of 256."""

    def write(context, builder, signature, args):  # type: ignore[no-untyped-def]
        table, numbers, i, out = args
        kind = ir.VectorType(ir.IntType(8), BYTES)
        given = builder.load(vector_address(context, builder, signature.args[1], numbers, i, kind), align=1)
        if "+avx512vbmi" in context.codegen().magic_tuple()[2]:
            found = table_entries(context, builder, signature.args[0], table, given)
        else:
            found = ir.Constant(kind, ir.Undefined)
            for lane in range(BYTES):
                at = builder.zext(builder.extract_element(given, ir.Constant(INT, lane)), ir.IntType(64))
                value = array_element(context, builder, signature.args[0], table, at)
                found = builder.insert_element(found, value, ir.Constant(INT, lane))
        builder.store(found, vector_address(context, builder, signature.args[3], out, i, kind), align=1)
        return context.get_dummy_value()

    return types.none(table, numbers, types.intp, out), write


@instructions
def store_lookup(typing, table, numbers, i, out, at):  # type: ignore[no-untyped-def]  # pragma: no cover (compiler)
    """Write table[numbers[i]] to out[at], for LANES numbers; a flat table of 256 float32, numbers uint8."""

    def write(context, builder, signature, args):  # type: ignore[no-untyped-def]
        table, numbers, i, out, at = args
        bytes_, kind = ir.VectorType(ir.IntType(8), LANES), ir.VectorType(FLOAT, LANES)
        given = builder.load(vector_address(context, builder, signature.args[1], numbers, i, bytes_), align=1)
        given = builder.zext(given, ir.VectorType(INT, LANES))
        where = vector_address(context, builder, signature.args[3], out, at, kind)

        def one_by_one() -> None:
            found = ir.Constant(kind, ir.Undefined)
            for lane in range(LANES):
                entry = builder.zext(builder.extract_element(given, ir.Constant(INT, lane)), ir.IntType(64))
                value = array_element(context, builder, signature.args[0], table, entry)
                found = builder.insert_element(found, value, ir.Constant(INT, lane))
            builder.store(found, where, align=4)

        lanes = LANES if has(context, "avx512f") else LANES // 2 if has(context, "avx2") else 0  # of one look-up
        if not lanes:
            one_by_one()
            return context.get_dummy_value()
        half = ir.VectorType(FLOAT, lanes)
        few = builder.icmp_unsigned("<", given, ir.Constant(given.type, [2 * lanes] * LANES))
        whole = ir.IntType(LANES)
        every = builder.icmp_unsigned("==", builder.bitcast(few, whole), ir.Constant(whole, (1 << LANES) - 1))
        with builder.if_else(every, likely=True) as (in_two_vectors, otherwise):
            with in_two_vectors:
                halves = [
                    builder.load(
                        vector_address(
                            context, builder, signature.args[0], table, ir.Constant(ir.IntType(64), begin), half
                        ),
                        align=4,
                    )
                    for begin in (0, lanes)
                ]
                parts = [
                    builder.shuffle_vector(
                        given, ir.Constant(given.type, ir.Undefined), lane_numbers(range(start, start + lanes))
                    )
                    for start in range(0, LANES, lanes)
                ]
                found = [entry_of_two(builder, halves, part) for part in parts]
                builder.store(joined_vectors(builder, found), where, align=4)
            with otherwise:
                one_by_one()
        return context.get_dummy_value()

    return types.none(table, numbers, types.intp, out, types.intp), write


@instructions
def store_interleaved(typing, numbers, first, second, third, fourth, out, at):  # type: ignore[no-untyped-def]  # pragma: no cover (compiler)
    """Interleave four rows of LANES uint8, which begin at the given indices, and write them from out[at] on."""

    def write(context, builder, signature, args):  # type: ignore[no-untyped-def]
        numbers, *begins, out, at = args
        row, kind = (ir.VectorType(ir.IntType(8), count * LANES) for count in (1, 4))
        rows = [
            builder.load(vector_address(context, builder, signature.args[0], numbers, begin, row), align=1)
            for begin in begins
        ]
        order = ir.Constant(ir.VectorType(INT, 4 * LANES), [lane // 4 + lane % 4 * LANES for lane in range(4 * LANES)])
        joined = joined_vectors(builder, rows)
        mixed = builder.shuffle_vector(joined, ir.Constant(joined.type, ir.Undefined), order)
        builder.store(mixed, vector_address(context, builder, signature.args[5], out, at, kind), align=1)
        return context.get_dummy_value()

    whole = types.intp
    return types.none(numbers, whole, whole, whole, whole, out, whole), write


@instructions
def store_pairs(typing, numbers, first, second, out, at):  # type: ignore[no-untyped-def]  # pragma: no cover (compiler)
    """Interleave two rows of LANES uint8, which begin at the given indices, and write them as int16 from out[at] on."""

    def write(context, builder, signature, args):  # type: ignore[no-untyped-def]
        numbers, *begins, out, at = args
        row, kind = ir.VectorType(ir.IntType(8), LANES), ir.VectorType(SHORT, 2 * LANES)
        rows = [
            builder.load(vector_address(context, builder, signature.args[0], numbers, begin, row), align=1)
            for begin in begins
        ]
        joined = builder.zext(joined_vectors(builder, rows), kind)
        order = ir.Constant(ir.VectorType(INT, 2 * LANES), [lane // 2 + lane % 2 * LANES for lane in range(2 * LANES)])
        mixed = builder.shuffle_vector(joined, ir.Constant(kind, ir.Undefined), order)
        builder.store(mixed, vector_address(context, builder, signature.args[3], out, at, kind), align=2)
        return context.get_dummy_value()

    return types.none(numbers, types.intp, types.intp, out, types.intp), write
