"""Ed25519 keys that sign models: made, written and read in the formats of OpenSSL."""

import hashlib

from cryptography.exceptions import UnsupportedAlgorithm
from cryptography.hazmat.primitives import serialization
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey, Ed25519PublicKey

from neurove_protocol.errors import InvalidField

MAX_KEY_BYTES = 16 << 10

_RAW = (serialization.Encoding.Raw, serialization.PublicFormat.Raw)
_WHAT = "signing key"


def new() -> Ed25519PrivateKey:
    """A key that nobody had before."""
    return Ed25519PrivateKey.generate()


def key_id(key: Ed25519PublicKey) -> str:
    """What people and files call a key: the first 16 hexadecimal digits of the sha256 of its 32 bytes."""
    return hashlib.sha256(key.public_bytes(*_RAW)).hexdigest()[:16]


def private_pem(key: Ed25519PrivateKey) -> bytes:
    """The key as PKCS #8 in PEM, without a pass phrase: what guards it is the file's mode."""
    return key.private_bytes(
        serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption()
    )


def public_pem(key: Ed25519PublicKey) -> bytes:
    """The key as SubjectPublicKeyInfo in PEM."""
    return key.public_bytes(serialization.Encoding.PEM, serialization.PublicFormat.SubjectPublicKeyInfo)


def read_private(data: bytes, name: str) -> Ed25519PrivateKey:
    """The private key of a PEM file.

    Raises:
        InvalidField: it is none, is locked by a pass phrase, or is of another algorithm; `name` says whose bytes.
    """
    _check_size(data, name)
    if b"PUBLIC KEY" in data:
        raise InvalidField(_WHAT, "file", name, "it is a public key; to sign takes the private one")
    try:
        key = serialization.load_pem_private_key(data, password=None)
    except TypeError:
        why = "it is locked by a pass phrase; unlock a copy with `openssl pkey -in FILE -out COPY`"
        raise InvalidField(_WHAT, "file", name, why) from None
    except (ValueError, UnsupportedAlgorithm):
        raise InvalidField(_WHAT, "file", name, "not a private key in PEM, as `neurove bundle keygen` makes") from None
    if not isinstance(key, Ed25519PrivateKey):
        raise InvalidField(_WHAT, "file", name, "a private key, but not an Ed25519 one")
    return key


def read_public(data: bytes, name: str) -> Ed25519PublicKey:
    """The public key of a PEM file.

    Raises:
        InvalidField: it is none, or of another algorithm; `name` says whose bytes.
    """
    _check_size(data, name)
    if b"PRIVATE KEY" in data:
        why = "it is a private key: keep it where models are signed, and trust the .pub beside it"
        raise InvalidField(_WHAT, "file", name, why)
    try:
        key = serialization.load_pem_public_key(data)
    except (ValueError, UnsupportedAlgorithm):
        raise InvalidField(_WHAT, "file", name, "not a public key in PEM, as `neurove bundle keygen` makes") from None
    if not isinstance(key, Ed25519PublicKey):
        raise InvalidField(_WHAT, "file", name, "a public key, but not an Ed25519 one")
    return key


def _check_size(data: bytes, name: str) -> None:
    if len(data) > MAX_KEY_BYTES:
        raise InvalidField(_WHAT, "file", name, f"{len(data)} bytes: a key has at most {MAX_KEY_BYTES}")
