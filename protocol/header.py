"""The size of a map apart from its blob, read before anything is decoded."""

from typing import Final

_FIXED: Final = {  # first byte -> bytes of the whole value
    **dict.fromkeys((0xC0, 0xC2, 0xC3), 1),
    0xCA: 5,
    0xCB: 9,
    0xCC: 2,
    0xCD: 3,
    0xCE: 5,
    0xCF: 9,
    0xD0: 2,
    0xD1: 3,
    0xD2: 5,
    0xD3: 9,
    0xD4: 3,
    0xD5: 4,
    0xD6: 6,
    0xD7: 10,
    0xD8: 18,
}
_SIZED: Final = {  # first byte -> bytes of the length, and of what else precedes the content
    0xC4: (1, 0),
    0xC5: (2, 0),
    0xC6: (4, 0),
    0xC7: (1, 1),
    0xC8: (2, 1),
    0xC9: (4, 1),
    0xD9: (1, 0),
    0xDA: (2, 0),
    0xDB: (4, 0),
}
_NESTED: Final = {0xDC: (2, 1), 0xDD: (4, 1), 0xDE: (2, 2), 0xDF: (4, 2)}  # bytes of the length, values per item
_BINARY: Final = tuple(bytes([first]) for first in (0xC4, 0xC5, 0xC6))


def header_bytes(data: bytes, blob: bytes, most: int) -> int:
    r"""Bytes of a msgpack map without its first binary value that has the key `blob`.

    The walk ends where more than `most` bytes are found, or where the data is no msgpack.

    Args:
        data: a message.
        blob: the key as it is in the data, with its msgpack header.
        most: bytes after which the walk ends.

    >>> header_bytes(b"\x81\xa4data\xc4\x03abc", b"\xa4data", 100)
    6
    """
    values, at, outside, end = 1, 0, 0, len(data)
    found = False
    while values and outside <= most:
        first = data[at] if at < end else 0xC1
        is_blob = not found and first == blob[0] and data.startswith(blob, at)
        if is_blob and data[at + len(blob) : at + len(blob) + 1] in _BINARY:
            found = True
            outside += len(blob)
            size, _ = _value(data, at + len(blob))
            at += len(blob) + size
            values -= 2
            continue
        # Short texts and small integers, which a header has most of, without a call: this runs for every packet.
        size, nested = (first - 0x9F, 0) if 0xA0 <= first < 0xC0 else (1, 0) if first < 0x80 else _value(data, at)
        if not size or at + size > end:  # the decoder refuses it
            break
        at += size
        outside += size
        values += nested - 1
    return outside


def _value(data: bytes, at: int) -> tuple[int, int]:
    """Bytes of the value at an offset, without the values in it, and their number; 0 bytes: there is no value."""
    first = data[at] if at < len(data) else 0xC1
    if first < 0x80 or first >= 0xE0:
        return 1, 0
    if first < 0x90:
        return 1, 2 * (first & 15)
    if first < 0xA0:
        return 1, first & 15
    if first < 0xC0:
        return 1 + (first & 31), 0
    if first in _FIXED:
        return _FIXED[first], 0
    if first in _SIZED:
        wide, more = _SIZED[first]
        return 1 + wide + more + int.from_bytes(data[at + 1 : at + 1 + wide]), 0
    if first in _NESTED:
        wide, each = _NESTED[first]
        return 1 + wide, each * int.from_bytes(data[at + 1 : at + 1 + wide])
    return 0, 0
