"""Files that are whole or what they were before, however a process ends."""

import os
from pathlib import Path


def write_whole(path: Path, data: bytes) -> None:
    """Write a file so that it is whole, or what was there before; several processes may write the same one.

    Raises:
        OSError: it can not be written; nothing is left beside it.
    """
    part = path.with_name(f"{path.name}.{os.getpid()}.part")
    try:
        with part.open("wb") as file:
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
        part.replace(path)
        sync(path.parent)
    finally:
        part.unlink(missing_ok=True)  # it is there only where writing failed


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
