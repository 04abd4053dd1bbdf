"""Files that are whole or what they were before, however a process ends."""

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path


@contextmanager
def atomic_path(path: Path) -> Iterator[Path]:
    """Another name beside a file, to write to; where the block ends without an error, what is there becomes the file.

    Until then the file is what it was before; several processes may write the same one.

    Raises:
        OSError: it can not be written; nothing is left beside it.
    """
    part = path.with_name(f"{path.name}.{os.getpid()}.part")
    try:
        yield part
        sync(part)
        part.replace(path)
        sync(path.parent)
    finally:
        part.unlink(missing_ok=True)  # it is there only where writing failed


def write_atomically(path: Path, data: bytes) -> None:
    """Write a file so that it is whole, or what was there before; several processes may write the same one.

    Raises:
        OSError: it can not be written; nothing is left beside it.
    """
    with atomic_path(path) as part:
        part.write_bytes(data)


def sync(path: Path) -> None:
    """Wait until a file's bytes, or a folder's names, are on the disk."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def move_folder(source: Path, target: Path) -> None:
    """Give a folder another place on the same disk, at once and with everything in it on the disk.

    Raises:
        OSError: the target is there and not empty, or is no place for it.
    """
    for file in source.iterdir():
        sync(file)
    sync(source)
    source.rename(target)
    sync(target.parent)
    sync(source.parent)
