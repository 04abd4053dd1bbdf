"""Widths of the vector code in vectors.py: constants and the choice of a tile. Needs no private module of numba."""

from typing import Final

LANES: Final = 16
"""Numbers of 32 bits in one vector. Widths of tiles are multiples of it."""

BYTES: Final = 64
"""Numbers of 8 bits in one vector."""


def tile_of(channels: int, most: int = 8) -> tuple[int, ...]:
    """The widest tile that divides a number of channels, as the argument `like` of the kernels.

    Args:
        channels: number to divide, a multiple of LANES.
        most: largest number of vectors in a tile, a power of two. Eight vectors fill half of AVX-512's registers.

    Returns:
        a tuple with one 0 for each vector of the tile.
    """
    count = most
    while channels % (count * LANES):
        count //= 2
    return (0,) * count
