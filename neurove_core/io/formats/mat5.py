"""Reader of number columns in MATLAB 5 files; in scipy's reader some corrupt files end the whole process."""

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
    """The file cannot be read beyond this byte."""

    def __init__(self, byte: int, why: str) -> None:
        super().__init__(f"at byte {byte}, {why}")
        self.byte, self.why = byte, why


class _Element(NamedTuple):
    kind: int
    data: bytes


def read_columns(path: Path, names: Collection[str], max_bytes: int) -> dict[str, NDArray[Any]]:
    """The arrays of a file with these names, each as (N,) numbers of its own type.

    Source: MathWorks, MAT-File Format, level 5.

    Args:
        path: the file.
        names: the arrays to read; others are skipped.
        max_bytes: size limit of one array [bytes].

    Raises:
        MatFault: the file is not a MATLAB 5 file, is truncated or corrupt, or an array is too large or has no numbers.
    """
    columns = {}
    with path.open("rb") as file:
        header = file.read(_HEADER_BYTES)
        if header[126:] != b"IM":  # big-endian files are not supported
            raise MatFault(0, "the file does not start with a MATLAB 5 header")
        at = len(header)
        while tag := file.read(8):
            kind, size = np.frombuffer(tag.ljust(8, b"\0"), "<u4").tolist()
            if len(tag) < 8 or size > max_bytes:
                raise MatFault(at, f"an array of {size} bytes is truncated or larger than {max_bytes}")
            data = file.read(size)
            if len(data) < size:
                raise MatFault(at, "the file ends within an array")
            try:
                name, values = _matrix(*_unpacked(kind, data, max_bytes), names)
            except (ValueError, KeyError, zlib.error) as error:
                raise MatFault(at, f"the array cannot be read: {error}") from None
            if name is not None:
                columns[name] = values
            at += 8 + size
    return columns


def _unpacked(kind: int, data: bytes, max_bytes: int) -> tuple[int, bytes]:
    if kind != _COMPRESSED:
        return kind, data
    unpacker = zlib.decompressobj()
    data = unpacker.decompress(data, max_bytes + 256)  # 256 for the tags of the array
    if not unpacker.eof:
        raise ValueError(f"the compressed data is truncated, or larger than {max_bytes} bytes")
    for element in _elements(data):
        return element
    raise ValueError("it is empty")


def _matrix(kind: int, data: bytes, names: Collection[str]) -> tuple[str | None, NDArray[Any]]:
    """Name and numbers of an array; the name is None for an array that is not requested."""
    empty = np.empty(0)
    if kind != _MATRIX:
        return None, empty
    parts = _elements(data)
    try:
        flags, dims, name = next(parts), next(parts), next(parts).data.decode("latin-1")
        if not flags.data:
            raise ValueError("it has no flags")
        if name not in names:
            return None, empty
        numbers = next(parts)
    except StopIteration:
        raise ValueError("it lacks its flags, its size, its name or its numbers") from None
    shape = np.frombuffer(dims.data, "<i4").tolist()
    if not 6 <= flags.data[0] <= 15 or numbers.kind not in _NUMBERS:  # double to uint64
        raise ValueError(f"{name} is not an array of numbers")
    values: NDArray[Any] = np.frombuffer(numbers.data, "<" + _NUMBERS[numbers.kind])
    if min(shape, default=0) < 0 or prod(shape) != values.size:
        raise ValueError(f"{name} has {values.size} numbers and a size of {shape}")
    return name, values


def _elements(data: bytes) -> Iterator[_Element]:
    """The consecutive elements in the data of an array. A small element has its data in its tag."""
    at = 0
    while at + 8 <= len(data):
        first, size = np.frombuffer(data, "<u4", 2, at).tolist()
        small = first >> 16
        start, kind, size = (at + 4, first & 0xFFFF, small) if small else (at + 8, first, size)
        if start + size > len(data) or small > 4:
            raise ValueError(f"an element of {size} bytes is truncated")
        at = at + 8 if small else start + -(-size // 8) * 8
        if size == 0 and kind == 0:
            return
        yield _Element(kind, data[start : start + size])
