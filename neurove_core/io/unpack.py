"""Bounded decompression: the one place that limits what a compressed part of a file can become.

A reader passes every compressed part through `bounded` or `unpacked`. A small file can therefore neither take all
memory nor run for minutes.
"""

import io
import lzma
import zlib
from collections.abc import Iterator
from typing import IO, Any, Final

from neurove_core.extras import MissingExtra

MAX_RATIO: Final = 250
"""Largest ratio of decompressed to compressed bytes. Events compress by 2 to 20."""

FREE_BYTES: Final = 4 << 20
"""Decompressed bytes that any part may have, whatever its ratio."""

MAX_WINDOW_BYTES: Final = 64 << 20
"""Memory that the header of compressed data may ask for."""

ERRORS: Final = (
    OSError,
    RuntimeError,
    EOFError,
    ValueError,
    zlib.error,
    lzma.LZMAError,
    NotImplementedError,
    MemoryError,
)
"""What the decompressors raise for damaged data. A ZstdError is none of them: see `unpacked`."""


class Unpackable(ValueError):
    """Data cannot be decompressed, or it would become larger than its bound."""


class Bounded(io.RawIOBase):
    """The decompressed bytes of a stream, up to MAX_RATIO times the compressed ones.

    Args:
        stream: gives decompressed bytes; it has `read(size)`.
        packed: number of compressed bytes behind it.

    Raises:
        Unpackable: from `read`, beyond the bound.
    """

    def __init__(self, stream: Any, packed: int) -> None:
        super().__init__()
        self._stream, self._packed = stream, packed
        self._left = FREE_BYTES + MAX_RATIO * packed

    def readable(self) -> bool:
        """True."""
        return True

    def readinto(self, buffer: Any) -> int:
        """Read into a buffer, as `io.RawIOBase`."""
        data = self._stream.read(len(buffer))
        self._left -= len(data)
        if self._left < 0:
            raise Unpackable(f"{self._packed} compressed bytes become more than {MAX_RATIO} times as many")
        buffer[: len(data)] = data
        return len(data)


def bounded(stream: Any, packed: int) -> IO[bytes]:
    """A buffered stream of decompressed bytes with a bound; see `Bounded`."""
    return io.BufferedReader(Bounded(stream, packed), 1 << 16)


def unpacked(compression: str, data: bytes, size: int) -> tuple[bytes, str]:
    """Decompress data up to the first fault.

    Args:
        compression: `zstd` or `lz4` (the frame formats), or `bz2`.
        data: compressed bytes.
        size: largest number of bytes to return.

    Returns:
        The bytes, and the fault. The fault is empty if there is none.

    Raises:
        MissingExtra: the library for this compression is not installed.
    """
    found: list[bytes] = []
    try:
        found.extend(parts(compression, io.BytesIO(data), len(data), size))
    except Unpackable as error:
        return b"".join(found), str(error)
    return b"".join(found), ""


def parts(compression: str, stream: IO[bytes], packed: int, size: int) -> Iterator[bytes]:
    """The decompressed data of a stream in parts of up to 64 KiB.

    Args:
        compression: as for `unpacked`, or `gzip`.
        stream: gives the compressed bytes; it can seek.
        packed: number of compressed bytes.
        size: largest number of bytes to give.

    Raises:
        Unpackable: the data after these parts cannot be decompressed, or becomes larger than its bound.
        MissingExtra: the library for this compression is not installed.
    """
    left = size
    try:
        declared = _declared_size(stream) if compression == "zstd" else 0
        plain = bounded(_decompressor(compression, stream), packed)
        while left and (part := plain.read(min(left, 1 << 16))):
            yield part
            left -= len(part)
        if left and size - left < declared:  # the library does not report a truncated frame
            raise Unpackable(f"the data end after {size - left} of {declared} bytes")
    except ModuleNotFoundError as error:
        raise MissingExtra(str(error.name).partition(".")[0], "recordings") from None
    except ERRORS as error:
        raise Unpackable(str(error) or type(error).__name__) from None
    except Exception as error:  # ZstdError has no other base class
        if type(error).__name__ != "ZstdError":
            raise
        raise Unpackable(str(error)) from None


def _declared_size(stream: IO[bytes]) -> int:
    """The size of the content that the header of the first zstd frame declares [bytes]; 0 if it declares none."""
    import zstandard

    at = stream.tell()
    try:
        size = zstandard.get_frame_parameters(stream.read(32)).content_size
    except zstandard.ZstdError:
        return 0  # the decompressor reports it
    finally:
        stream.seek(at)
    return 0 if size == zstandard.CONTENTSIZE_UNKNOWN else int(size)


def _decompressor(compression: str, stream: IO[bytes]) -> Any:
    """A stream with `read` over a compressed stream."""
    match compression:
        case "zstd":
            import zstandard

            decompressor = zstandard.ZstdDecompressor(max_window_size=MAX_WINDOW_BYTES)
            return decompressor.stream_reader(stream, read_across_frames=True)
        case "lz4":
            import lz4.frame

            return lz4.frame.LZ4FrameFile(stream)
        case "bz2":
            import bz2

            return bz2.BZ2File(stream)
        case "gzip":
            import gzip

            return gzip.GzipFile(fileobj=stream)
        case _:
            raise Unpackable(f"unknown compression {compression!r}; supported: zstd, lz4, bz2, gzip")
