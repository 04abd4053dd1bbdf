"""Who made a model: what a node makes of a bundle's signature."""

from collections.abc import Callable
from typing import NamedTuple

from protocol.control import SignatureState


class Signed(NamedTuple):
    """What a signature says of a bundle."""

    state: SignatureState
    allow_downgrade: bool = False  # counts only where the state is trusted


Verify = Callable[[bytes, bytes | None], Signed]
"""Bundle and signature to what it says; raises NeuroVEError where this node must not use the bundle."""


def verify_signature(_: bytes, signature: bytes | None) -> Signed:
    """What a node that trusts no key makes of a bundle and its signature: nothing is refused, nothing is trusted."""
    return Signed("unsigned" if signature is None else "unchecked")
