"""Files: atomic writes, which leave the new content or the old one; TOML; the temporary folder of libraries.

A writer of the command line inherits this from `atomic_path`, whatever library writes: one OSError that names the file
that was asked for, and nothing left.
"""

import errno
import os
import re
import tempfile
import tomllib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np

LFS_POINTER: Final = b"version https://git-lfs.github.com/spec/"
"""First bytes of a Git LFS pointer, which stands for a large file in a repository that was fetched without Git LFS."""


def pointer_fault(head: bytes) -> str:
    """Why a file that begins with these bytes cannot be read, if it is a Git LFS pointer; empty if it is none."""
    if not head.startswith(LFS_POINTER):
        return ""
    return "this is a Git LFS pointer, not the content; fetch it with `git lfs pull`"


@contextmanager
def atomic_path(path: Path) -> Iterator[Path]:
    """A temporary path in the same folder to write to; it replaces the file where the block ends without an error.

    Until then the file keeps its old content. Several processes may write the same file.

    Raises:
        OSError: the file cannot be written, as `write_errors`; no temporary file is left.
    """
    part = path.with_name(f"{path.name}.{os.getpid()}.part")
    try:
        with write_errors(path, part):
            yield part
            sync(part)
            part.replace(path)
            sync(path.parent)
    finally:
        part.unlink(missing_ok=True)  # it exists only where writing failed


@contextmanager
def write_errors(path: Path, part: Path) -> Iterator[None]:
    """Let an error of writing name the file that was asked for; the error of a library becomes an OSError.

    HDF5 reports the error of the system only in its text, as an OSError or, where it closes the file, a RuntimeError.

    Args:
        path: the file that was asked for.
        part: the file that is written.

    Raises:
        OSError: with the number of the system's error, its text and `path`.
    """
    try:
        yield
    except OSError as error:
        number = error.errno if error.errno is not None else _errno_in(str(error))
        of_this = number in _OF_WRITING if error.filename is None else str(error.filename) in (str(path), str(part))
        if number is None or not of_this:  # of something that is read meanwhile
            raise
        raise OSError(number, os.strerror(number), str(path)) from None
    except RuntimeError as error:
        number = _errno_in(str(error))
        if number is None:
            raise
        raise OSError(number, os.strerror(number), str(path)) from None


def _errno_in(text: str) -> int | None:
    found = _ERRNO.search(text)
    return int(found[1]) if found else None


_OF_WRITING: Final = {errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EIO, errno.EROFS}
_ERRNO: Final = re.compile(r"\berrno = (\d+)")


class Stamp(NamedTuple):
    """What changes when a file changes or another one replaces it.

    Size and time of content can stay equal. Nothing but the system sets the time of state.
    """

    device: int
    inode: int
    size: int  # [bytes]
    content_ns: int  # time of the last change
    state_ns: int


def stamp(path: Path) -> Stamp | None:
    """The stamp of a file; None if it cannot be found."""
    try:
        about = path.stat()
    except OSError:
        return None
    return Stamp(about.st_dev, about.st_ino, about.st_size, about.st_mtime_ns, about.st_ctime_ns)


def why_unreadable(folder: Path) -> str | None:
    """Why the entries of a folder cannot be listed, such as `No such file or directory`; None if they can."""
    try:
        with os.scandir(folder) as entries:
            next(entries, None)
    except OSError as error:
        return error.strerror or str(error)
    return None


def read_toml(path: Path) -> dict[str, Any]:
    """The content of a TOML file, which may begin with a byte order mark.

    Raises:
        OSError: the file cannot be read. ValueError: it is not UTF-8 or not TOML.
    """
    return tomllib.loads(path.read_bytes().decode("utf-8-sig"))


def allow_no_temporary_folder() -> None:
    """Let torch run where no temporary folder can be written, as in a read-only image.

    torch asks for a folder for compiled code when it is first used, although nothing is stored there. Without one it
    fails, so it gets one that exists.
    """
    try:
        tempfile.gettempdir()
    except OSError:
        os.environ.setdefault("TORCHINDUCTOR_CACHE_DIR", os.path.sep)


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


def make_writable(folder: Path) -> None:
    """Create a folder, unless it exists, and check that a file can be written into it.

    Raises:
        OSError: it cannot.
    """
    folder.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryFile(dir=folder) as file:
        file.write(b"\0")
