"""Columns of numbers from MATLAB 5 files; scipy's reader of them ends the whole process over some broken files."""

import zlib
from collections.abc import Collection, Iterator
from math import prod
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

_HEADER_BYTES = 128
_MATRIX, _COMPRESSED = 14, 15
_NUMBERS = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 9: "f8", 12: "i8", 13: "u8"}


class MatFault(Exception):
    """The file can not be read beyond this byte."""

    def __init__(self, byte: int, why: str) -> None:
        super().__init__(f"at byte {byte}, {why}")
        self.byte, self.why = byte, why


class _Element(NamedTuple):
    kind: int
    data: bytes


def read_columns(path: Path, names: Collection[str], max_bytes: int) -> dict[str, NDArray[Any]]:
    """The arrays of these names that a file has, each as (N,) numbers of its own type.

    Source: MathWorks, MAT-File Format, level 5.

    Args:
        path: the file.
        names: what to read; the rest is passed over.
        max_bytes: how large one array may be [bytes].

    Raises:
        MatFault: the file is none, is not whole, or an array is too large or holds no numbers.
    """
    columns = {}
    with path.open("rb") as file:
        header = file.read(_HEADER_BYTES)
        if header[126:] != b"IM":  # the other order is of machines that nobody has any more
            raise MatFault(0, "the file does not begin as a MATLAB 5 file does")
        at = len(header)
        while tag := file.read(8):
            kind, size = np.frombuffer(tag.ljust(8, b"\0"), "<u4").tolist()
            if len(tag) < 8 or size > max_bytes:
                raise MatFault(at, f"an array of {size} bytes is cut or larger than {max_bytes}")
            data = file.read(size)
            if len(data) < size:
                raise MatFault(at, "the file ends within an array")
            try:
                name, values = _matrix(*_unpacked(kind, data, max_bytes), names)
            except (ValueError, KeyError, zlib.error) as error:
                raise MatFault(at, f"the array can not be read: {error}") from None
            if name is not None:
                columns[name] = values
            at += 8 + size
    return columns


def _unpacked(kind: int, data: bytes, max_bytes: int) -> tuple[int, bytes]:
    if kind != _COMPRESSED:
        return kind, data
    unpacker = zlib.decompressobj()
    data = unpacker.decompress(data, max_bytes + 256)  # its own tags come on top
    if not unpacker.eof:
        raise ValueError(f"what is packed is cut, or larger than {max_bytes} bytes")
    for element in _elements(data):
        return element
    raise ValueError("there is nothing in it")


def _matrix(kind: int, data: bytes, names: Collection[str]) -> tuple[str | None, NDArray[Any]]:
    """Name and numbers of an array; None for one that is not asked for."""
    nothing = np.empty(0)
    if kind != _MATRIX:
        return None, nothing
    parts = _elements(data)
    try:
        flags, dims, name = next(parts), next(parts), next(parts).data.decode("latin-1")
        if not flags.data:
            raise ValueError("it has no flags")
        if name not in names:
            return None, nothing
        numbers = next(parts)
    except StopIteration:
        raise ValueError("it lacks its flags, its size, its name or its numbers") from None
    shape = np.frombuffer(dims.data, "<i4").tolist()
    if not 6 <= flags.data[0] <= 15 or numbers.kind not in _NUMBERS:  # double to uint64
        raise ValueError(f"{name} holds no numbers")
    values: NDArray[Any] = np.frombuffer(numbers.data, "<" + _NUMBERS[numbers.kind])
    if min(shape, default=0) < 0 or prod(shape) != values.size:
        raise ValueError(f"{name} has {values.size} numbers and a size of {shape}")
    return name, values


def _elements(data: bytes) -> Iterator[_Element]:
    """The elements that lie one after the other in the data of an array; small ones have their data in their tag."""
    at = 0
    while at + 8 <= len(data):
        first, size = np.frombuffer(data, "<u4", 2, at).tolist()
        small = first >> 16
        start, kind, size = (at + 4, first & 0xFFFF, small) if small else (at + 8, first, size)
        if start + size > len(data) or small > 4:
            raise ValueError(f"an element of {size} bytes is cut")
        at = at + 8 if small else start + -(-size // 8) * 8
        if size == 0 and kind == 0:
            return
        yield _Element(kind, data[start : start + size])
