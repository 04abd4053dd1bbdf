"""SignedFiles: the signature state of the model files on disk, computed once until a file changes."""

import hashlib
from collections.abc import Callable, Iterable
from pathlib import Path

from neurove_core.files import Stamp, read_whole, stamp
from neurove_core.models import bundle, manifest
from neurove_protocol.errors import NeuroVEError
from neurove_service.models.signatures import Signed, Verify


class SignedFiles:
    """Finds a model file by its digest and verifies the signature next to it.

    Args:
        paths: lists the model files, in the order of precedence.
        verify: see `signatures.verifier`.
    """

    def __init__(self, paths: Callable[[], Iterable[Path]], verify: Verify) -> None:
        self._paths, self._verify = paths, verify
        self._digests: dict[Path, tuple[Stamp | None, str]] = {}
        self._results: dict[Path, tuple[tuple[Stamp | None, Stamp | None], Signed | NeuroVEError]] = {}

    def signed(self, digest: str) -> Signed:
        """The signature state of a model; a model without a file, such as a built-in one, is unsigned.

        Raises:
            NeuroVEError: the configured keys do not allow this model.
        """
        for path in self._paths():
            if self._digest_of(path) == digest:
                return self._signed(path)
        return Signed("unsigned")

    def _signed(self, path: Path) -> Signed:
        signature = path.with_name(path.name + manifest.SUFFIX)
        key = (stamp(path), stamp(signature))
        known = self._results.get(path)
        if known is None or known[0] != key:
            result: Signed | NeuroVEError
            try:
                result = self._verify(read_whole(path), signature.read_bytes() if signature.exists() else None)
            except NeuroVEError as error:
                result = error.with_traceback(None)
            known = self._results[path] = key, result
        if isinstance(known[1], NeuroVEError):
            raise known[1]
        return known[1]

    def _digest_of(self, path: Path) -> str | None:
        stamped = stamp(path)
        if stamped is None or stamped.size > bundle.MAX_BYTES:
            return None
        known = self._digests.get(path)
        if known is None or known[0] != stamped:
            try:
                known = self._digests[path] = stamped, hashlib.sha256(read_whole(path)).hexdigest()
            except OSError:
                return None
        return known[1]
