"""Plain files for readers: a temporary copy of what a pipe gives, bounded in size.

Readers seek, and they read a recording more than once. A pipe allows neither.
"""

import tempfile
from pathlib import Path
from typing import IO, Final

from neurove_core.io.errors import UnknownSource
from neurove_core.io.recording import BLOCK_BYTES

HEAD_BYTES: Final = 4096
"""Number of first bytes that decide on the format of a file."""

MAX_BYTES: Final = 4 << 30
"""Largest temporary copy [bytes]."""

_TEXT: Final = bytes(range(0x20, 0x7F)) + b"\t\r\n"
_BOM: Final = b"\xef\xbb\xbf"

_kept: list[tempfile.TemporaryDirectory[str]] = []  # each removes its folder when the process ends


def is_text(head: bytes) -> bool:
    """Whether these are the first bytes of a text in ASCII, which may begin with the mark of UTF-8."""
    return bool(head) and not head.removeprefix(_BOM).translate(None, _TEXT)


def copied(source: Path, stream: IO[bytes], head: bytes, name: str, max_bytes: int = MAX_BYTES) -> Path:
    """Copy a stream into a temporary file, which exists until the process ends.

    Args:
        source: what gives the stream, named in errors.
        stream: what follows `head`.
        head: the first bytes.
        name: name of the file.
        max_bytes: bound for the size of the file.

    Raises:
        UnknownSource: there is more than `max_bytes`. OSError: no temporary file can be written.
    """
    folder = tempfile.TemporaryDirectory(prefix="neurove-", ignore_cleanup_errors=True)
    try:
        path, size, block = Path(folder.name) / name, 0, head
        with path.open("wb") as file:
            while block:
                size += len(block)
                if size > max_bytes:
                    why = f"it gives more than {max_bytes:,} bytes, the bound for a temporary copy; write it to a file"
                    raise UnknownSource(source, why)
                file.write(block)
                block = stream.read(BLOCK_BYTES)
    except BaseException:
        folder.cleanup()
        raise
    _kept.append(folder)
    return path
