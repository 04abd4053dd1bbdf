"""The cell of an event by two products of 32 bits, as instructions for compiled code.

numba widens every integer to 64 bits. A processor then multiplies half as many at a time, and AVX2 has no product of 64
bits that keeps them in order. These instructions keep 32 bits, so a loop over events becomes vectors of them.
"""

from typing import Any

from numba import types
from numba.extending import intrinsic

from neurove_core.ingest.scaling import SHIFT

_instructions: Any = intrinsic  # for a type checker: compiled code calls the result without the first argument


@_instructions
def scaled_cell(typing, y, x, p, rows, columns, width, on):  # type: ignore[no-untyped-def]  # pragma: no cover (compiler)
    """The cell of an event: (y * rows >> SHIFT) * width + (x * columns >> SHIFT), plus `on` where p is not 0.

    Args:
        typing: numba's typing context.
        y: row of the pixel, uint16.
        x: column of the pixel, uint16.
        p: polarity, any integer.
        rows: factor of `scaling.Scale`, uint32.
        columns: factor of `scaling.Scale`, uint32.
        width: columns of the grid, uint32.
        on: number of cells of the grid, uint32.

    Returns:
        uint32; sums and products wrap.
    """

    def write(context, builder, signature, args):  # type: ignore[no-untyped-def]
        y, x, p, rows, columns, width, on = args
        word = on.type  # a type called with a number is a constant, so that no private module is needed
        row, column = (
            builder.lshr(builder.mul(builder.zext(pixel, word), factor), word(SHIFT))
            for pixel, factor in ((y, rows), (x, columns))
        )
        is_on = builder.icmp_unsigned("!=", p, p.type(0))
        plane = builder.select(is_on, on, word(0))
        return builder.add(builder.add(builder.mul(row, width), column), plane)

    return types.uint32(types.uint16, types.uint16, p, *[types.uint32] * 4), write
