"""CDR, the encoding of ROS 2 messages: little-endian numbers, in and out, from a table of fields.

A message begins with the four bytes 00 01 00 00. Each number is aligned to its own size, counted from byte 4. A string
begins with its length, which includes the zero that ends it; a sequence begins with its length. Source: OMG DDS-XTypes,
plain CDR (XCDR version 1).

Padding has no meaning, and other writers leave any bytes in it: compare values, never bytes. This writer leaves zeros.
"""

import struct
from collections.abc import Mapping
from typing import Any, Final, NamedTuple

from neurove_protocol.errors import InvalidField

HEAD: Final = b"\0\1\0\0"
"""Encapsulation of plain little-endian CDR."""

_SLACK: Final = 7  # bytes after the last field that a writer may leave
_COUNT: Final = struct.Struct("<I")


class Field(NamedTuple):
    """One field of a message.

    `kind` is a struct letter (`d`), a struct letter with a fixed count (`d9`), `text`, `bytes`, or a type of the table.
    """

    name: str
    kind: str
    most: int | None = None  # of a sequence: its longest length; of text and bytes: the longest [bytes]

    @property
    def many(self) -> bool:
        """Whether it is a sequence."""
        return self.most is not None and self.kind not in ("text", "bytes")


Table = Mapping[str, tuple[type[Any], tuple[Field, ...]]]
"""Type -> its NamedTuple, whose fields have the order of the table, and its fields."""


def encode(table: Table, kind: str, value: Any) -> bytes:
    """The bytes of a message.

    Args:
        table: types that `kind` needs.
        kind: its type.
        value: its NamedTuple.

    Raises:
        InvalidField: a field is out of its bound.
    """
    out = bytearray(HEAD)
    _write(table, kind, kind, value, out)
    return bytes(out)


def decode(table: Table, kind: str, data: bytes) -> Any:
    """The NamedTuple of a message. Fields of the kind `bytes` are views of `data`.

    Raises:
        InvalidField: the bytes are no such message; names the field, its value and its bound. Never another error.
    """
    if data[:2] != HEAD[:2]:
        raise InvalidField(kind, "encapsulation", bytes(data[:4]).hex(" "), "00 01 and two further bytes: plain CDR")
    reader = _Reader(kind, memoryview(data)[len(HEAD) :])
    value = _read(table, kind, "", reader)
    if reader.left > _SLACK:
        raise InvalidField(kind, "bytes after the last field", reader.left, f"at most {_SLACK}")
    return value


class _Reader:
    def __init__(self, what: str, data: memoryview) -> None:
        self.what, self._data, self._at = what, data, 0

    @property
    def left(self) -> int:
        return len(self._data) - self._at

    def raw(self, field: str, size: int) -> memoryview:
        if size > self.left:
            raise InvalidField(self.what, field, f"{self.left} bytes left", f"it needs {size} bytes")
        self._at += size
        return self._data[self._at - size : self._at]

    def numbers(self, field: str, letter: str, count: int) -> tuple[Any, ...]:
        size = struct.calcsize("<" + letter)
        self._at += -self._at % size if count else 0
        return struct.unpack(f"<{count}{letter}", self.raw(field, size * count))

    def length(self, field: str, most: int) -> int:
        count = int(self.numbers(field, "I", 1)[0])
        if count > most:
            raise InvalidField(self.what, field, count, f"its length is at most {most}")
        return count

    def text(self, field: str, most: int) -> str:
        data = bytes(self.raw(field, self.length(field, most + 1)))
        try:
            return data.removesuffix(b"\0").decode()
        except UnicodeDecodeError:
            raise InvalidField(self.what, field, data, "must be UTF-8") from None


def _split(kind: str) -> tuple[str, int]:
    """Letter and count of numbers, such as d9."""
    return kind[0], int(kind[1:] or 1)


def _is_number(kind: str) -> bool:
    return len(kind) == 1 or kind[1:].isdecimal()


def _read(table: Table, kind: str, path: str, reader: _Reader) -> Any:
    made, fields = table[kind]
    return made(*(_read_field(table, field, f"{path}{field.name}", reader) for field in fields))


def _read_field(table: Table, field: Field, path: str, reader: _Reader) -> Any:
    kind, most = field.kind, field.most or 0
    if kind == "text":
        return reader.text(path, most)
    if kind == "bytes":
        return reader.raw(path, reader.length(path, most))
    if not _is_number(kind):
        if not field.many:
            return _read(table, kind, path + ".", reader)
        return tuple(_read(table, kind, f"{path}.{i}.", reader) for i in range(reader.length(path, most)))
    letter, count = _split(kind)
    if field.many:
        return reader.numbers(path, letter, reader.length(path, most))
    numbers = reader.numbers(path, letter, count)
    if field.name == "nanosec" and numbers[0] >= 10**9:
        raise InvalidField(reader.what, path, numbers[0], "must be below 1000000000 ns")
    return numbers[0] if len(kind) == 1 else numbers


def _write(table: Table, what: str, kind: str, value: Any, out: bytearray) -> None:
    for field, one in zip(table[kind][1], value, strict=True):
        _write_field(table, what, field, one, out)


def _write_field(table: Table, what: str, field: Field, value: Any, out: bytearray) -> None:
    if field.kind == "text":
        data = str(value).encode()
        _write_length(what, field, len(data), out, ending=1)
        out += data + b"\0"
    elif field.kind == "bytes":
        _write_length(what, field, len(value), out)
        out += value
    elif not _is_number(field.kind):
        if field.many:
            _write_length(what, field, len(value), out)
        for one in value if field.many else (value,):
            _write(table, what, field.kind, one, out)
    else:
        letter, count = _split(field.kind)
        numbers = tuple(value) if field.many or len(field.kind) > 1 else (value,)
        if field.many:
            _write_length(what, field, len(numbers), out)
        elif len(numbers) != count:
            raise InvalidField(what, field.name, len(numbers), f"{count} numbers are expected")
        if numbers:
            _align(out, struct.calcsize("<" + letter))
        try:
            out += struct.pack(f"<{len(numbers)}{letter}", *numbers)
        except struct.error as error:
            raise InvalidField(what, field.name, value, str(error)) from None


def _write_length(what: str, field: Field, length: int, out: bytearray, ending: int = 0) -> None:
    if length > (field.most or 0):
        raise InvalidField(what, field.name, length, f"its length is at most {field.most}")
    _align(out, 4)
    out += _COUNT.pack(length + ending)


def _align(out: bytearray, size: int) -> None:
    out += bytes(-(len(out) - len(HEAD)) % size)
