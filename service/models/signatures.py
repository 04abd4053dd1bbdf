"""Signatures of bundles: which models a node accepts."""

from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

from neurove_core.models import manifest
from neurove_core.models.container import Data
from neurove_protocol.control import ModelInfo, SignatureState
from neurove_protocol.errors import InvalidField, Untrusted


class Signed(NamedTuple):
    """The signature state of a bundle."""

    state: SignatureState
    allow_downgrade: bool = False
    release: int | None = None  # the signed one; None without a trusted signature

    def release_of(self, info: ModelInfo) -> int:
        """The signed release; without one, the release in the bundle."""
        return info.release if self.release is None else self.release


Verify = Callable[[Data, bytes | None], Signed]
"""Bundle and signature to the signature state; raises NeuroVEError if this node must not use the bundle."""


def verify_nothing(_: Data, signature: bytes | None) -> Signed:
    """The rule of a node that trusts no key: it refuses nothing and trusts nothing."""
    return Signed("unsigned" if signature is None else "unchecked")


def verifier(keys: tuple[Path, ...]) -> Verify:
    """The rule of a node that trusts these keys: it accepts only bundles that one of them signed.

    Args:
        keys: files of public keys, PEM; none: nothing is verified.

    Raises:
        InvalidField: a file is not readable, or is not a key.
    """
    if not keys:
        return verify_nothing
    from neurove_core.models import signing_keys

    trusted = [signing_keys.read_public(_read(path, signing_keys.MAX_KEY_BYTES + 1), str(path)) for path in keys]

    def verify(data: Data, signature: bytes | None) -> Signed:
        if signature is None:
            raise Untrusted("bundle", "unsigned", "this node accepts only signed models")
        signed = manifest.verify(data, signature, trusted)
        return Signed("trusted", signed.allow_downgrade, signed.release)

    return verify


def _read(path: Path, most: int) -> bytes:
    try:
        with path.open("rb") as file:
            return file.read(most)
    except OSError as error:
        raise InvalidField("config", "trusted_keys", str(path), error.strerror or str(error)) from None
