"""Rows of NumPy arrays in files and .npz archives, read in blocks and without pickle.

Source: https://numpy.org/doc/stable/reference/generated/numpy.lib.format.html.
"""

import ast
import warnings
from collections.abc import Iterator, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import IO, Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from neurove_core.io.archive import Place
from neurove_core.io.errors import BrokenRecording, UnknownSource
from neurove_core.io.recording import BLOCK_BYTES

MAGIC: Final = b"\x93NUMPY"
_MAX_HEADER_BYTES: Final = 10_000
_MAX_ROW_BYTES: Final = 4096
_BAD_HEADER = (ValueError, TypeError, SyntaxError, KeyError, IndexError, MemoryError, RecursionError, OverflowError)


class Header(NamedTuple):
    """The header of an array."""

    dtype: np.dtype[Any]
    shape: tuple[int, ...]
    fortran: bool  # whether the first index changes fastest


class Series(NamedTuple):
    """Values in a file that follow each other from row to row."""

    name: str  # of the file
    skip: int  # values before the first row
    dtype: np.dtype[Any]  # of a value
    rows: int
    width: int = 1  # values in a row

    @property
    def row_bytes(self) -> int:
        """Size of a row [bytes]."""
        return self.dtype.itemsize * self.width


def read_header(path: Path, name: str, file: IO[bytes]) -> Header:
    """Read the header of an array, up to its first value.

    Args:
        path: the recording, for messages.
        name: the file of the array.
        file: opened at its beginning.

    Raises:
        UnknownSource: it is not an array, or not one of numbers or records.
    """
    start = file.read(8)
    if len(start) < 8 or not start.startswith(MAGIC) or start[6] not in (1, 2, 3):
        raise UnknownSource(path, f"{name} is not a NumPy array")
    size = int.from_bytes(file.read(2 if start[6] == 1 else 4), "little")
    if size > _MAX_HEADER_BYTES:
        raise UnknownSource(path, f"the header of {name} has {size} bytes; at most {_MAX_HEADER_BYTES} are allowed")
    text = file.read(size)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of a damaged text
            fields = ast.literal_eval(text.decode("utf-8" if start[6] == 3 else "latin1").strip())
            dtype = np.lib.format.descr_to_dtype(fields["descr"])
        shape, fortran = tuple(int(n) for n in fields["shape"]), bool(fields["fortran_order"])
    except _BAD_HEADER as error:
        raise UnknownSource(path, f"the header of {name} is not valid: {type(error).__name__}: {error}") from None
    if dtype.hasobject:
        raise UnknownSource(path, f"{name} holds Python objects, which are not read: save it as numbers")
    if not 0 < dtype.itemsize <= _MAX_ROW_BYTES or any(n < 0 for n in shape):
        raise UnknownSource(path, f"{name} holds {dtype} of shape {shape}, not events")
    return Header(dtype, shape, fortran)


def blocks(place: Place, series: Sequence[Series], block_bytes: int = BLOCK_BYTES // 2) -> Iterator[list[NDArray[Any]]]:
    """Rows of several series side by side, in blocks of about this size: (n,) or (n, width) of each.

    Raises:
        BrokenRecording: a file ends before its last row, or the series differ in length. All rows before were given.
    """
    rows = min(one.rows for one in series)
    step, at = max(block_bytes // sum(one.row_bytes for one in series), 1), 0
    with ExitStack() as stack:
        files = [stack.enter_context(place.open(one.name)) for one in series]
        for one, file in zip(series, files, strict=True):
            read_header(place.path, one.name, file)
            _skip(file, one.skip * one.dtype.itemsize)
        while at < rows:
            wanted = min(step, rows - at)
            parts = [_read(file, one, wanted) for one, file in zip(series, files, strict=True)]
            n = min(len(part) for part in parts)
            if n:
                yield [part[:n] for part in parts]
            at += n
            if n < wanted:
                short = series[[len(part) for part in parts].index(n)].name
                raise BrokenRecording(place.path, f"row {at} of {short}", f"the file ends here, expected {rows} rows")
    lengths = [one.rows for one in series]
    if max(lengths) > rows:
        raise BrokenRecording(place.path, f"row {rows}", f"the arrays have unequal lengths: {lengths}")


def _skip(file: IO[bytes], size: int) -> None:
    while size > 0 and (part := file.read(min(size, BLOCK_BYTES))):
        size -= len(part)


def _read(file: IO[bytes], one: Series, rows: int) -> NDArray[Any]:
    data = file.read(rows * one.row_bytes)
    n = len(data) // one.row_bytes
    values = np.frombuffer(data, one.dtype, n * one.width)
    return values.reshape(n, one.width) if one.width > 1 else values
