"""Files of a recording that lie together, in a folder or in a .zip, and the images among them."""

import io
import lzma
import zipfile
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO, NamedTuple

import numpy as np
from numpy.typing import NDArray

from neurove_core.extras import MissingExtra
from neurove_core.io.errors import BrokenRecording, UnknownSource

BROKEN_ZIP = (zipfile.BadZipFile, zlib.error, lzma.LZMAError, EOFError, NotImplementedError, RuntimeError, ValueError)
"""What the standard library raises over an archive that is not whole, or packed in a way that it does not know."""

MAX_IMAGE_BYTES = 64 << 20  # of one image's file


class Place(NamedTuple):
    """Where the files of a recording lie: in a folder, or in a folder within a .zip."""

    path: Path  # the folder or the .zip
    inside: str | None = None  # of a .zip: what the names of its files begin with

    def has(self, name: str) -> bool:
        """Whether there is a file of this name."""
        if self.inside is None:
            return (self.path / name).is_file()
        with zipfile.ZipFile(self.path) as archive:
            return self.inside + name in archive.namelist()

    @contextmanager
    def open(self, name: str) -> Iterator[IO[bytes]]:
        """The file of this name, to be read; of a .zip it is unpacked while one reads.

        Raises:
            BrokenRecording: while one reads, where what is packed is not whole.
        """
        try:
            if self.inside is None:
                with (self.path / name).open("rb") as file:
                    yield file
                return
            with zipfile.ZipFile(self.path) as archive, archive.open(self.inside + name) as packed:
                yield packed
        except BROKEN_ZIP as error:
            raise BrokenRecording(self.path, name, f"it can not be unpacked: {error}") from None


def folder_in_zip(path: Path, wanted: str) -> str:
    """What the names of the files begin with that lie in a .zip beside one of this name.

    Raises:
        UnknownSource: it is no .zip, or has no such file.
    """
    try:
        with zipfile.ZipFile(path) as archive:
            names = [name for name in archive.namelist() if name.rpartition("/")[2] == wanted]
    except BROKEN_ZIP as error:
        raise UnknownSource(path, f"it is no zip file: {error}") from None
    if not names:
        raise UnknownSource(path, f"there is no {wanted} in it")
    return min(names, key=len).removesuffix(wanted)


def read_image(path: Path, where: str, file: IO[bytes]) -> NDArray[np.uint8]:
    """Grey (H, W) or RGB (H, W, 3), from a file of any format that Pillow knows.

    Raises:
        MissingExtra: Pillow is not installed. BrokenRecording: it is no whole image; names `where` in `path`.
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
        raise BrokenRecording(path, where, f"its image can not be read: {error}") from None
