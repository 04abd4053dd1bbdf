"""Files that are whole or not there, whenever the power goes."""

import os
from pathlib import Path


def sync(path: Path) -> None:
    """Wait until a file's bytes, or a folder's names, are on the disk."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def write(path: Path, data: bytes) -> None:
    """Write a file; until all of it is on the disk, what was there before stays.

    Raises:
        OSError: it could not be written; what was there before is there still.
    """
    part = path.with_name(path.name + ".part")
    try:
        part.write_bytes(data)
        sync(part)
        part.replace(path)
        sync(path.parent)
    finally:
        part.unlink(missing_ok=True)  # it is there only where writing failed


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
