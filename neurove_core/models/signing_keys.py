"""Ed25519 keys that sign models: generate, write and read them in the formats of OpenSSL."""

import hashlib

from cryptography.exceptions import UnsupportedAlgorithm
from cryptography.hazmat.primitives import serialization
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey, Ed25519PublicKey

from neurove_protocol.errors import InvalidField

MAX_KEY_BYTES = 16 << 10

_RAW = (serialization.Encoding.Raw, serialization.PublicFormat.Raw)
_WHAT = "signing key"


def new() -> Ed25519PrivateKey:
    """Generate a key."""
    return Ed25519PrivateKey.generate()


def key_id(key: Ed25519PublicKey) -> str:
    """Short name of a key: the first 16 hexadecimal digits of the sha256 of its 32 bytes."""
    return hashlib.sha256(key.public_bytes(*_RAW)).hexdigest()[:16]


def private_pem(key: Ed25519PrivateKey) -> bytes:
    """The key as PKCS #8 in PEM without a pass phrase: the mode of its file must protect it."""
    return key.private_bytes(
        serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption()
    )


def public_pem(key: Ed25519PublicKey) -> bytes:
    """The key as SubjectPublicKeyInfo in PEM."""
    return key.public_bytes(serialization.Encoding.PEM, serialization.PublicFormat.SubjectPublicKeyInfo)


def read_private(data: bytes, name: str) -> Ed25519PrivateKey:
    """Read the private key of a PEM file.

    Args:
        data: the bytes of the file.
        name: of the file, for errors.

    Raises:
        InvalidField: it is not a private key, has a pass phrase, or is of another algorithm.
    """
    _check_size(data, name)
    if b"PUBLIC KEY" in data:
        raise InvalidField(_WHAT, "file", name, "it is a public key; signing needs the private key")
    try:
        key = serialization.load_pem_private_key(data, password=None)
    except TypeError:
        why = "it has a pass phrase; make a copy without it: `openssl pkey -in FILE -out COPY`"
        raise InvalidField(_WHAT, "file", name, why) from None
    except (ValueError, UnsupportedAlgorithm):
        raise InvalidField(_WHAT, "file", name, "not a private key in PEM; `neurove bundle keygen` makes one") from None
    if not isinstance(key, Ed25519PrivateKey):
        raise InvalidField(_WHAT, "file", name, "a private key, but not an Ed25519 key")
    return key


def read_public(data: bytes, name: str) -> Ed25519PublicKey:
    """Read the public key of a PEM file.

    Args:
        data: the bytes of the file.
        name: of the file, for errors.

    Raises:
        InvalidField: it is not a public key, or is of another algorithm.
    """
    _check_size(data, name)
    if b"PRIVATE KEY" in data:
        why = "it is a private key: keep it on the signing machine, and trust the matching .pub file"
        raise InvalidField(_WHAT, "file", name, why)
    try:
        key = serialization.load_pem_public_key(data)
    except (ValueError, UnsupportedAlgorithm):
        raise InvalidField(_WHAT, "file", name, "not a public key in PEM; `neurove bundle keygen` makes one") from None
    if not isinstance(key, Ed25519PublicKey):
        raise InvalidField(_WHAT, "file", name, "a public key, but not an Ed25519 key")
    return key


def _check_size(data: bytes, name: str) -> None:
    if len(data) > MAX_KEY_BYTES:
        raise InvalidField(_WHAT, "file", name, f"{len(data)} bytes: a key has at most {MAX_KEY_BYTES}")
