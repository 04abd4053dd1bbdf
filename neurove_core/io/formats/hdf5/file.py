"""Access to HDF5 files: open them with the filters that event data sets use, check data sets, read rows."""

import re
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from importlib import import_module
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from neurove_core.extras import MissingExtra
from neurove_core.files import pointer_fault
from neurove_core.io.errors import BrokenRecording, MissingFilter, UnknownSource
from neurove_core.io.formats.hdf5.heap import heap_fault
from neurove_core.io.unpack import FREE_BYTES, MAX_RATIO

MAX_CHUNK_BYTES: Final = 64 << 20
"""Largest stored chunk of a data set. HDF5 decompresses a chunk at once, so this limit bounds the memory."""

_MAGIC = b"\x89HDF\r\n\x1a\n"
_CACHE_BYTES = 16 << 20  # per data set; with the default of 1 MiB every block read decompresses a larger chunk again
FAULTS = (OSError, RuntimeError, KeyError, ValueError, TypeError, MemoryError, OverflowError)
"""What h5py raises for a damaged file; it has no error class of its own."""

Column = NDArray[Any]


@contextmanager
def opened(path: Path) -> Iterator[Any]:
    """Open the file for reading, as an h5py.File with the filters of hdf5plugin (Blosc, Zstd and others).

    Raises:
        MissingExtra: h5py or hdf5plugin is not installed.
        UnknownSource: it is not an HDF5 file.
        BrokenRecording: it is an HDF5 file, but truncated or corrupt.
    """
    h5py = library()
    with path.open("rb") as file:
        head = file.read(64)
    if fault := pointer_fault(head):
        raise UnknownSource(path, fault)
    head = head[: len(_MAGIC)]
    if not head or not _MAGIC.startswith(head):
        raise UnknownSource(path, "the file does not start with the HDF5 signature")
    heap = heap_fault(path)
    if heap is not None:
        raise BrokenRecording(path, f"byte {heap[0]}", f"its texts cannot be read: {heap[1]}")
    try:
        opened_file = h5py.File(path, "r", rdcc_nbytes=_CACHE_BYTES, locking="best-effort")
    except FAULTS as error:
        ends = re.search(r"eof = (\d+),.*stored_eof = (\d+)", str(error))
        where, why = (ends[1], f"the file ends here, expected {ends[2]} bytes") if ends else ("0", str(error))
        raise BrokenRecording(path, f"byte {where}", why) from None
    with opened_file as file:
        yield file


def library() -> Any:
    """Import the h5py module.

    Raises:
        MissingExtra: h5py or hdf5plugin is not installed.
    """
    for name in ("hdf5plugin", "h5py"):
        try:
            module = import_module(name)
        except ImportError:
            raise MissingExtra(name, "recordings") from None
    return module


def has(file: Any, *names: str) -> bool:
    """Whether all of these names are in the file; False where the file is too damaged to answer."""
    try:
        return all(name in file for name in names)
    except FAULTS:
        return False


def dataset(path: Path, file: Any, name: str, *tail: int) -> Any:
    """The h5py.Dataset of numbers of shape (N, *tail). Its rows are not read yet.

    Raises:
        BrokenRecording: it does not exist, has another shape or type, or is stored in chunks above MAX_CHUNK_BYTES.
        MissingFilter: HDF5 lacks a filter that its rows need.
    """
    found, shape = _stored(path, file, name)
    if len(shape) != 1 + len(tail) or shape[1:] != tail or not _is_number(found.dtype):
        want = ", ".join(["N", *map(str, tail)])
        raise BrokenRecording(path, name, f"expected numbers of shape ({want}), not {found.dtype} of {shape}")
    return found


def records(path: Path, file: Any, name: str, fields: tuple[str, ...]) -> Any:
    """The h5py.Dataset of records (N,) that have these fields of numbers. Its rows are not read yet.

    Raises:
        BrokenRecording, MissingFilter: as for `dataset`.
    """
    found, shape = _stored(path, file, name)
    known = found.dtype.fields or {}
    if len(shape) != 1 or not all(one in known and _is_number(known[one][0]) for one in fields):
        want = ", ".join(fields)
        raise BrokenRecording(path, name, f"expected records of {want} and shape (N), not {found.dtype} of {shape}")
    return found


def _is_number(dtype: Any) -> bool:
    """Whether these are numbers that numpy's linear algebra supports."""
    return dtype.kind in "biu" or (dtype.kind == "f" and dtype.itemsize in (4, 8))


def _stored(path: Path, file: Any, name: str) -> tuple[Any, tuple[int, ...]]:
    """The h5py.Dataset and its shape, if its rows can be read within the bounds."""
    try:
        found = file[name]
        shape = tuple(found.shape)
        missing = found.size and not found.is_virtual and not found.id.get_storage_size()
        chunk_bytes = int(np.prod(found.chunks or (0,), dtype=np.float64)) * found.dtype.itemsize
    except (*FAULTS, AttributeError) as error:
        raise BrokenRecording(path, name, f"it cannot be read: {error}") from None
    if chunk_bytes > MAX_CHUNK_BYTES:
        why = f"it is stored in chunks of {chunk_bytes} bytes; at most {MAX_CHUNK_BYTES} are allowed"
        raise BrokenRecording(path, name, why)
    if missing:  # HDF5 would return zeros for all rows that the header claims
        raise BrokenRecording(path, name, f"its {shape[0] if shape else 1} rows were never written")
    _check_filters(path, name, found)
    return found, shape


def _check_filters(path: Path, name: str, found: Any) -> None:
    """Raise MissingFilter if the first row needs a filter that HDF5 does not have."""
    from h5py import h5z

    try:
        pipeline = found.id.get_create_plist()
        numbers = [pipeline.get_filter(i)[0] for i in range(pipeline.get_nfilters())]
        lacking = [number for number in numbers if not h5z.filter_avail(number)]
    except FAULTS as error:
        raise BrokenRecording(path, name, f"its filters cannot be read: {error}") from None
    if lacking and found.size:
        try:
            found[:1]  # a chunk may be stored without an optional filter
        except FAULTS:
            raise MissingFilter(path, name, lacking[0]) from None


def check_ratio(path: Path, columns: Sequence[Any]) -> None:
    """Refuse data sets whose rows are implausibly larger than what the file stores of them; see `unpack`.

    Raises:
        BrokenRecording: a data set is larger.
    """
    for column in columns:
        size, stored = column.size * column.dtype.itemsize, column.id.get_storage_size()
        if size > FREE_BYTES + MAX_RATIO * stored and not column.is_virtual:
            why = f"its {stored} stored bytes become {size}, more than {MAX_RATIO} times as many"
            raise BrokenRecording(path, column.name.strip("/"), why)


def value(path: Path, file: Any, name: str) -> Any:
    """The full value of a small data set: a number, an array, or a text as str.

    Raises:
        BrokenRecording: it does not exist, cannot be read, or has more than 1000 entries.
    """
    try:
        found = file[name]
        if found.size > 1000:
            raise ValueError(f"it has {found.size} entries")
        got = found[()]
    except (*FAULTS, AttributeError) as error:
        raise BrokenRecording(path, name, f"it cannot be read: {error}") from None
    return got.decode("utf-8", "backslashreplace") if isinstance(got, bytes) else got


def read_rows(columns: Sequence[Any], first: int, stop: int) -> tuple[list[Column], str]:
    """Rows [first, stop) of all columns, or the rows before the first unreadable one and its error text.

    Finds that row by bisection: h5py reports neither which row failed nor what it read before.
    """
    try:
        return [column[first:stop] for column in columns], ""
    except FAULTS as error:
        if stop - first <= 1:
            return [np.empty((0, *column.shape[1:]), column.dtype) for column in columns], str(error)
    middle = (first + stop) // 2
    head, why = read_rows(columns, first, middle)
    if why:
        return head, why
    tail, why = read_rows(columns, middle, stop)
    return [np.concatenate(parts) for parts in zip(head, tail, strict=True)], why


def all_rows(path: Path, name: str, columns: Sequence[Any]) -> list[Column]:
    """All rows of the columns of one table of known small size.

    Raises:
        BrokenRecording: a row cannot be read, or the columns differ in length.
    """
    check_ratio(path, columns)
    lengths = [int(column.shape[0]) for column in columns]
    rows, why = read_rows(columns, 0, min(lengths))
    if why:
        raise BrokenRecording(path, f"row {len(rows[0])} of {name}", why)
    if max(lengths) > min(lengths):
        raise BrokenRecording(path, f"row {min(lengths)} of {name}", f"its columns have unequal lengths: {lengths}")
    return rows
