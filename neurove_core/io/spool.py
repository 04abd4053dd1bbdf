"""Plain files for readers: a temporary copy of what a pipe or a compressed file gives, bounded in size.

Readers seek, and they read a recording more than once. Neither a pipe nor a compressed file allows that.
"""

import re
import tempfile
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import IO, Final, NamedTuple

from neurove_core.files import pointer_fault
from neurove_core.io.errors import UnknownSource
from neurove_core.io.recording import BLOCK_BYTES
from neurove_core.io.unpack import Unpackable, parts

HEAD_BYTES: Final = 4096
"""Number of first bytes that decide on the format of a file."""

MAX_BYTES: Final = 4 << 30
"""Largest temporary copy [bytes]."""

_COMPRESSIONS: Final = (
    ("gzip", rb"\x1f\x8b\x08"),
    ("zstd", rb"\x28\xb5\x2f\xfd"),
    ("bz2", rb"BZh[1-9](?:1AY&SY|\x17rE8P\x90)"),
    ("lz4", rb"\x04\x22\x4d\x18"),
)
"""Compressions of a whole file, with a regular expression of the first bytes.

Sources: RFC 1952, RFC 8878, sourceware.org/bzip2, github.com/lz4/lz4 (lz4_Frame_format.md).
"""

_SUFFIXES: Final = (".gz", ".zst", ".zstd", ".bz2", ".lz4")
_TEXT: Final = bytes(range(0x20, 0x7F)) + b"\t\r\n"
_BOM: Final = b"\xef\xbb\xbf"

_kept: dict[Path, tempfile.TemporaryDirectory[str]] = {}  # each removes its folder when the process ends


class Plain(NamedTuple):
    """A plain file, and why it ends before its content does; empty if it does not."""

    path: Path
    why: str = ""


def is_text(head: bytes) -> bool:
    """Whether these are the first bytes of a text in ASCII, which may begin with the mark of UTF-8."""
    return bool(head) and not head.removeprefix(_BOM).translate(None, _TEXT)


def compression_of(head: bytes) -> str | None:
    """The compression of a file that begins with these bytes: gzip, zstd, bz2 or lz4; None for any other content."""
    return next((name for name, signature in _COMPRESSIONS if re.match(signature, head, re.DOTALL)), None)


def plain_file(path: Path, max_bytes: int = MAX_BYTES) -> Plain:
    """The file itself, or for a compressed file a decompressed copy without the suffix of the compression.

    Raises:
        UnknownSource: the copy becomes larger than `max_bytes` or cannot be written, or the file is a Git LFS pointer.
        MissingExtra: the library for the compression is not installed.
        OSError: the file cannot be read, or there is no temporary folder.
    """
    with path.open("rb") as file:
        head = file.read(HEAD_BYTES)
        if fault := pointer_fault(head):
            raise UnknownSource(path, fault)
        compression = compression_of(head)
        if compression is None:
            return Plain(path)
        packed = file.seek(0, 2)
        file.seek(0)
        name = path.stem if path.suffix.lower() in _SUFFIXES else path.name
        return _copied(path, parts(compression, file, packed, max_bytes + 1), name, max_bytes)


def piped(source: Path, stream: IO[bytes], head: bytes, name: str, max_bytes: int = MAX_BYTES) -> Path:
    """A temporary copy of what a pipe gives. It exists until the process ends.

    Args:
        source: the pipe, named in errors.
        stream: what follows `head`.
        head: the first bytes.
        name: name of the copy.
        max_bytes: bound for its size.

    Raises:
        UnknownSource: the pipe gives more than `max_bytes`, or the copy cannot be written.
        OSError: there is no temporary folder.
    """
    return _copied(source, _blocks(stream, head), name, max_bytes).path


def _blocks(stream: IO[bytes], head: bytes) -> Iterator[bytes]:
    yield head
    while block := stream.read(BLOCK_BYTES):
        yield block


def _copied(source: Path, blocks: Iterable[bytes], name: str, max_bytes: int) -> Plain:
    folder = tempfile.TemporaryDirectory(prefix="neurove-", ignore_cleanup_errors=True)
    path, size, why = Path(folder.name) / name, 0, ""
    try:
        with path.open("wb") as file:
            try:
                for block in blocks:
                    size += len(block)
                    if size > max_bytes:
                        bound = f"{max_bytes:,} bytes, the bound for a temporary copy"
                        raise UnknownSource(source, f"its content is larger than {bound}; give it as a plain file")
                    file.write(block)
            except Unpackable as error:
                why = f"after {size:,} decompressed bytes: {error}"
    except OSError as error:
        folder.cleanup()
        raise UnknownSource(source, f"no temporary copy can be made in {folder.name}: {error.strerror}") from None
    except BaseException:
        folder.cleanup()
        raise
    _kept[path] = folder
    return Plain(path, why)


def discard(path: Path) -> None:
    """Remove a temporary copy before the process ends. Any other file stays."""
    if folder := _kept.pop(path, None):
        folder.cleanup()
