"""Container of a bundle: the safetensors format, read without a copy of the tensors.

A change of model reads a bundle in the process that serves the streams. `safetensors.torch.load` copies all tensors
twice and holds the interpreter's lock meanwhile: 0.1 s for 150 MiB, in which no stream goes on. Here the tensors are
views of the bytes, checked as strictly: known types, sizes that match, every byte of the file in exactly one tensor.
"""

import json
import math
import struct
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from neurove_core.files import pointer_fault
from neurove_protocol.errors import BadModel, shown

Data = bytes | memoryview
"""The bytes of a file."""

MAX_HEADER_BYTES: Final = 1 << 20
MAX_TENSORS: Final = 4096

_TYPES: Final[dict[str, Any]] = {
    "F64": np.float64,
    "F32": np.float32,
    "F16": np.float16,
    "I64": np.int64,
    "I32": np.int32,
    "I16": np.int16,
    "I8": np.int8,
    "U8": np.uint8,
    "BOOL": np.bool_,
}


class Container(NamedTuple):
    """The header of a safetensors file, and where its tensors begin."""

    entries: dict[str, Any]  # name of a tensor -> its entry; `__metadata__` -> strings
    begin: int


def read_container(data: Data, name: str) -> Container:
    """Read the header of a safetensors file; its entries are not checked yet.

    Args:
        data: the bytes of the file.
        name: of the file, for errors.

    Raises:
        BadModel: it is not such a file, or its header is too large.
    """
    if len(data) < 8:
        raise BadModel(name, f"size={len(data)}: not a safetensors file")
    if fault := pointer_fault(bytes(data[:64])):
        raise BadModel(name, fault)
    (length,) = struct.unpack("<Q", data[:8])
    if length > min(MAX_HEADER_BYTES, len(data) - 8):
        raise BadModel(
            name, f"header length {length}: not a safetensors file, or a header over {MAX_HEADER_BYTES} bytes"
        )
    try:
        entries = json.loads(bytes(data[8 : 8 + length]), object_pairs_hook=object_without_duplicates)
    except (ValueError, RecursionError) as error:
        raise BadModel(name, f"its header cannot be read: {error}") from None
    if not isinstance(entries, dict):
        entries = {}
    if len(entries) > MAX_TENSORS + 1:
        raise BadModel(name, f"{len(entries) - 1} tensors: at most {MAX_TENSORS}")
    return Container(entries, 8 + length)


def read_tensors(data: Data, name: str) -> dict[str, NDArray[Any]]:
    """All tensors of a safetensors file as arrays, views of its bytes; bytes that are read-only are copied once.

    Raises:
        BadModel: as `read_container`; a tensor has an unknown type, a size that does not match its bytes, or the
            tensors do not fill the file without a gap.
    """
    container = read_container(data, name)
    view = memoryview(data)
    if view.readonly:
        view = memoryview(bytearray(data))
    spans = {key: _span(key, one, name) for key, one in container.entries.items() if key != "__metadata__"}
    tensors, end = {}, container.begin
    for key, (begin, size) in sorted(spans.items(), key=lambda one: one[1]):
        if container.begin + begin != end:
            raise _incomplete(name, f"tensor {shown(key)} begins at byte {begin}, expected {end - container.begin}")
        end += size
        if end > len(view):
            raise _incomplete(name, f"incomplete: tensor {shown(key)} ends at byte {end}, the file has {len(view)}")
        kind, shape = container.entries[key]["dtype"], container.entries[key]["shape"]
        tensors[key] = np.frombuffer(view[end - size : end], _TYPES[kind]).reshape(shape)
    if end != len(view):
        raise _incomplete(name, f"its tensors end at byte {end}, the file has {len(view)}")
    return tensors


def _span(key: str, entry: Any, name: str) -> tuple[int, int]:
    """Begin and size of a tensor [bytes], from its entry."""
    if not isinstance(entry, dict) or entry.keys() != {"dtype", "shape", "data_offsets"}:
        raise _incomplete(name, f"tensor {shown(key)}: its entry must have dtype, shape and data_offsets")
    kind, shape, offsets = entry["dtype"], entry["shape"], entry["data_offsets"]
    if not isinstance(kind, str) or kind not in _TYPES:
        raise _incomplete(name, f"tensor {shown(key)}: dtype={shown(kind)}: known are {', '.join(_TYPES)}")
    if not _are_counts(shape) or len(shape) > _MAX_DIMENSIONS or math.prod(max(one, 1) for one in shape) >= _MAX_COUNT:
        raise _incomplete(name, f"tensor {shown(key)}: shape={shown(shape)}: not a list of sizes")
    if not _are_counts(offsets) or len(offsets) != 2:
        raise _incomplete(name, f"tensor {shown(key)}: data_offsets={shown(offsets)}: not two bytes of the file")
    size = np.dtype(_TYPES[kind]).itemsize * math.prod(shape)
    if offsets[1] - offsets[0] != size:
        raise _incomplete(name, f"tensor {shown(key)} has {offsets[1] - offsets[0]} bytes, its shape needs {size}")
    return offsets[0], size


_MAX_DIMENSIONS: Final = 8
_MAX_COUNT: Final = 1 << 48


def _are_counts(values: Any) -> bool:
    return isinstance(values, list) and all(type(one) is int and 0 <= one < _MAX_COUNT for one in values)


def _incomplete(name: str, why: str) -> BadModel:
    return BadModel(name, f"not a complete safetensors file: {why}")


def object_without_duplicates(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    """Hook of `json.loads` that refuses duplicate keys, because JSON readers differ on which one counts.

    Raises:
        ValueError: a key occurs twice in one object.
    """
    fields = dict(pairs)
    if len(fields) != len(pairs):
        raise ValueError("a key occurs twice in one object")
    return fields
