"""Who made a model: what a node makes of a bundle's signature."""

from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

from neurove_core.models import manifest, signing_keys
from neurove_protocol.control import ModelInfo, SignatureState
from neurove_protocol.errors import InvalidField, Untrusted


class Signed(NamedTuple):
    """What a signature says of a bundle."""

    state: SignatureState
    allow_downgrade: bool = False
    release: int | None = None  # none where nobody trusted says one

    def release_of(self, info: ModelInfo) -> int:
        """The release that counts: the signed one, where there is one."""
        return info.release if self.release is None else self.release


Verify = Callable[[bytes, bytes | None], Signed]
"""Bundle and signature to what it says; raises NeuroVEError where this node must not use the bundle."""


def verify_nothing(_: bytes, signature: bytes | None) -> Signed:
    """What a node that trusts no key makes of a bundle and its signature: nothing is refused, nothing is trusted."""
    return Signed("unsigned" if signature is None else "unchecked")


def verifier(keys: tuple[Path, ...]) -> Verify:
    """How a node judges signatures: one that trusts keys takes only what one of them has signed.

    Args:
        keys: files of public keys, PEM.

    Raises:
        InvalidField: one can not be read, or is no key.
    """
    if not keys:
        return verify_nothing
    trusted = [signing_keys.read_public(_read(path), str(path)) for path in keys]

    def verify(data: bytes, signature: bytes | None) -> Signed:
        if signature is None:
            raise Untrusted("bundle", "unsigned", "this node takes only models that are signed")
        signed = manifest.verify(data, signature, trusted)
        return Signed("trusted", signed.allow_downgrade, signed.release)

    return verify


def _read(path: Path) -> bytes:
    try:
        with path.open("rb") as file:
            return file.read(signing_keys.MAX_KEY_BYTES + 1)
    except OSError as error:
        raise InvalidField("config", "trusted_keys", str(path), error.strerror or str(error)) from None
