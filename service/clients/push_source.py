"""A bundle that a client pushes: its file, and the chunks that nodes request."""

import hashlib
import mmap
from pathlib import Path
from types import TracebackType
from typing import Self

from neurove_protocol.control import MAX_SIGNATURE_BYTES, ChunkRequest, PushRequest
from neurove_protocol.errors import BadModel, InvalidField

SIGNATURE = ".sig"


class PushSource:
    """Maps a bundle's file into memory; use it in a `with` block. Its signature file is part of the request.

    Args:
        path: file of the bundle; its signature is `<path>.sig`, if that exists.

    Raises:
        BadModel: the file is missing, empty or unreadable. The node checks its contents.
    """

    def __init__(self, path: Path) -> None:
        try:
            with path.open("rb") as file:
                self._bytes = mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)
            signature = path.with_name(path.name + SIGNATURE)
            self._signature = signature.read_bytes() if signature.exists() else None
        except (OSError, ValueError) as error:  # ValueError: an empty file
            raise BadModel(path.name, getattr(error, "strerror", None) or str(error)) from None
        if self._signature is not None and len(self._signature) > MAX_SIGNATURE_BYTES:
            size = len(self._signature)
            raise BadModel(signature.name, f"size={size}: a signature has at most {MAX_SIGNATURE_BYTES} bytes")
        self._name = path.name
        self.digest = hashlib.sha256(self._bytes).hexdigest()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._bytes.close()

    @property
    def request(self) -> PushRequest:
        """The request that offers the bundle to a node."""
        name = self._name[-128:]
        return PushRequest(digest=self.digest, size=len(self._bytes), name=name, signature=self._signature)

    def chunk(self, request: bytes) -> bytes:
        """The bytes that a ChunkRequest asks for.

        Args:
            request: an encoded ChunkRequest.

        Raises:
            InvalidField: the chunk ends after the file. Malformed: the bytes are no ChunkRequest.
        """
        wanted = ChunkRequest.decode(request)
        end, size = wanted.offset + wanted.length, len(self._bytes)
        if end > size:
            raise InvalidField(
                wanted.what, "offset", wanted.offset, f"with length it ends at {end}, the bundle at {size}"
            )
        return self._bytes[wanted.offset : end]
