"""Atomic writes: a file has its new content or its old one, however the process ends."""

import errno
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np


@contextmanager
def atomic_path(path: Path) -> Iterator[Path]:
    """A temporary path in the same folder to write to; it replaces the file where the block ends without an error.

    Until then the file keeps its old content. Several processes may write the same file.

    Raises:
        OSError: the file cannot be written; no temporary file is left.
    """
    part = path.with_name(f"{path.name}.{os.getpid()}.part")
    try:
        yield part
        sync(part)
        part.replace(path)
        sync(path.parent)
    finally:
        part.unlink(missing_ok=True)  # it exists only where writing failed


def write_atomically(path: Path, data: bytes) -> None:
    """Write a file atomically. Several processes may write the same file.

    Raises:
        OSError: the file cannot be written; no temporary file is left.
    """
    with atomic_path(path) as part:
        part.write_bytes(data)


def read_whole(path: Path) -> memoryview:
    """The bytes of a file, in memory that may be written to; other threads go on while it is read.

    Raises:
        OSError: the file cannot be read, or it became shorter meanwhile.
    """
    with path.open("rb", buffering=0) as file:
        data = np.empty(os.fstat(file.fileno()).st_size, np.uint8).data
        done = 0
        while done < len(data):
            read = file.readinto(data[done:])
            if not read:
                raise OSError(errno.EIO, f"{done} of {len(data)} bytes could be read")
            done += read
    return data


def sync(path: Path) -> None:
    """Wait until a file's content, or a folder's entries, are on the disk."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def move_folder(source: Path, target: Path) -> None:
    """Move a folder atomically on the same disk, after its files are synced.

    Raises:
        OSError: the target exists and is not empty, or cannot be created.
    """
    for file in source.iterdir():
        sync(file)
    sync(source)
    source.rename(target)
    sync(target.parent)
    sync(source.parent)
