"""The files of a recording that consists of several files, in a folder or in a .zip file, and its images."""

import io
import zipfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO, NamedTuple

import numpy as np
from numpy.typing import NDArray

from neurove_core.extras import MissingExtra
from neurove_core.files import pointer_fault
from neurove_core.io.errors import BrokenRecording, UnknownSource
from neurove_core.io.unpack import ERRORS, bounded

BROKEN_ZIP = (zipfile.BadZipFile, *ERRORS)
"""Errors of the standard library for an archive that is incomplete or has an unknown compression."""

MAX_IMAGE_BYTES = 64 << 20  # of one image file


class Place(NamedTuple):
    """Location of the files of a recording: a folder, or a folder in a .zip file."""

    path: Path  # the folder or the .zip file
    inside: str | None = None  # for a .zip file: prefix of the names of the files

    def has(self, name: str) -> bool:
        """Whether there is a file with this name."""
        if self.inside is None:
            return (self.path / name).is_file()
        with zipfile.ZipFile(self.path) as archive:
            return self.inside + name in archive.namelist()

    @contextmanager
    def open(self, name: str) -> Iterator[IO[bytes]]:
        """Open the file with this name for reading. A file in a .zip file is decompressed while it is read.

        Raises:
            BrokenRecording: the file in the .zip file cannot be decompressed. It can be raised while the file is read.
            UnknownSource: the file is a Git LFS pointer.
        """
        try:
            if self.inside is None:
                with (self.path / name).open("rb") as file:
                    fault = pointer_fault(file.read(64))
                    if fault:
                        raise UnknownSource(self.path / name, fault)
                    file.seek(0)
                    yield file
                return
            with member(self.path, self.inside + name) as packed:
                yield packed
        except (*BROKEN_ZIP, KeyError) as error:
            raise BrokenRecording(self.path, name, f"it cannot be read: {error}") from None


@contextmanager
def member(path: Path, name: str) -> Iterator[IO[bytes]]:
    """Open a file in a .zip file. Its decompressed size is bounded; see `unpack`.

    Raises:
        KeyError: there is no such file. BROKEN_ZIP: it cannot be unpacked. They can be raised while it is read.
    """
    with zipfile.ZipFile(path) as archive, archive.open(name) as packed:
        yield bounded(packed, archive.getinfo(name).compress_size)


def folder_in_zip(path: Path, wanted: str) -> str:
    """Prefix of the file names in the folder of a .zip file that has the file `wanted`.

    Raises:
        UnknownSource: it is not a .zip file, or it has no such file.
    """
    try:
        with zipfile.ZipFile(path) as archive:
            names = [name for name in archive.namelist() if name.rpartition("/")[2] == wanted]
    except BROKEN_ZIP as error:
        raise UnknownSource(path, f"it is not a zip file: {error}") from None
    if not names:
        raise UnknownSource(path, f"it has no {wanted}")
    return min(names, key=len).removesuffix(wanted)


def read_image(path: Path, where: str, file: IO[bytes]) -> NDArray[np.uint8]:
    """Read an image of any format that Pillow supports: grey (H, W) or RGB (H, W, 3).

    Raises:
        MissingExtra: Pillow is not installed. BrokenRecording: it is not a complete image; the error names `where` in
            `path`.
    """
    try:
        from PIL import Image
    except ImportError:
        raise MissingExtra("pillow", "recordings") from None
    data = file.read(MAX_IMAGE_BYTES)
    try:
        with Image.open(io.BytesIO(data)) as image:
            return np.array(image.convert("L" if image.mode in ("L", "1", "I", "I;16") else "RGB"))
    except (OSError, ValueError, SyntaxError, Image.DecompressionBombError) as error:
        raise BrokenRecording(path, where, f"its image cannot be read: {error}") from None
