"""Signed manifest of a bundle: the holder of a key vouches for exactly these bytes as one release.

The manifest is JSON with sorted keys, without spaces, in UTF-8. The Ed25519 signature covers the bytes of the manifest.
The signature file stores the manifest as a string, so a verifier does not have to produce the same JSON. The signature
file of a bundle is `NAME.safetensors.sig` in the same folder. This module turns bytes into values and does no I/O.
"""

import base64
import binascii
import hashlib
import json
from collections.abc import Iterable
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Annotated, Any, Final, Literal, TypeVar

from pydantic import ConfigDict, Field, ValidationError

from neurove_core.config import Config
from neurove_core.models.bundle import MAX_BYTES, Header, read_header
from neurove_core.models.container import Data, object_without_duplicates
from neurove_core.models.metadata import MAX_RELEASE
from neurove_protocol.errors import Downgrade, InvalidField, Untrusted, shown
from neurove_protocol.fields import WrongField

if TYPE_CHECKING:  # imported where a signature is made or checked: a node without trusted keys saves 6 MB
    from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey, Ed25519PublicKey

SUFFIX: Final = ".sig"
"""Appended to the full file name of the bundle."""

MAX_SIGNATURE_BYTES: Final = 16 << 10

KeyId = Annotated[str, Field(pattern="^[0-9a-f]{16}$")]
_Sha256 = Annotated[str, Field(pattern="^[0-9a-f]{64}$")]


class _Strict(Config):
    model_config = ConfigDict(strict=True)


class Signed(_Strict):
    """The manifest: what the holder of a key states about one bundle."""

    kind: Literal["neurove model 1"] = "neurove model 1"  # a signature of anything else has another kind
    name: str = Field(min_length=1, max_length=64)
    sha256: _Sha256  # of the bundle's bytes
    size: int = Field(ge=0, le=MAX_BYTES)  # [bytes]
    config_sha256: _Sha256  # of the model's configuration as canonical JSON
    release: int = Field(ge=0, le=MAX_RELEASE)
    allow_downgrade: bool  # nodes may accept it after a higher release
    key_id: KeyId
    created: str = Field(max_length=40)  # UTC, ISO 8601; for people


class _File(_Strict):
    manifest: str = Field(max_length=MAX_SIGNATURE_BYTES)  # the signed text
    signature: str = Field(max_length=88)  # base64 of 64 bytes
    key_id: KeyId


def sign(
    data: Data,
    key: "Ed25519PrivateKey",
    *,
    release: int | None = None,
    allow_downgrade: bool = False,
    created: datetime | None = None,
    name: str = "bundle",
) -> bytes:
    """Sign a bundle: the bytes of its signature file.

    Args:
        data: the bundle's bytes.
        key: signs the manifest.
        release: release counter; the default is the one in the bundle's header.
        allow_downgrade: nodes may accept this model after a higher release, so that an operator can go back.
        created: time of signing, for information; the default is now.
        name: of the bundle, for errors.

    Raises:
        BadModel: the bytes are not a bundle. InvalidField: the release is out of bounds.
    """
    from neurove_core.models.signing_keys import key_id

    header = read_header(data, name)
    release = header.release if release is None else release
    if not 0 <= release <= MAX_RELEASE:
        raise InvalidField("manifest", "release", release, f"must be 0 to {MAX_RELEASE}")
    made = Signed(
        name=header.name,
        sha256=hashlib.sha256(data).hexdigest(),
        size=len(data),
        config_sha256=_config_sha256(header),
        release=release,
        allow_downgrade=allow_downgrade,
        key_id=key_id(key.public_key()),
        created=(created or datetime.now(UTC)).astimezone(UTC).isoformat(timespec="seconds"),
    )
    text = canonical(made.model_dump())
    signature = base64.b64encode(key.sign(text.encode())).decode()
    return canonical(_File(manifest=text, signature=signature, key_id=made.key_id).model_dump()).encode() + b"\n"


def verify(data: Data, signature: bytes, trusted: Iterable["Ed25519PublicKey"], name: str = "bundle") -> Signed:
    """Verify a bundle's signature: the manifest that a trusted key signed.

    The bundle's content is parsed only after the signature, size and digest have been verified.

    Args:
        data: the bundle's bytes.
        signature: the bytes of its signature file.
        trusted: public keys of the accepted signers.
        name: of the bundle, for errors.

    Raises:
        Untrusted: with the reason `too_large`, `malformed`, `unknown_key`, `bad_signature`, `size`, `digest` or
            `manifest`.
        BadModel: the signed bytes are not a bundle.
    """
    from neurove_core.models.signing_keys import key_id

    file = _file(signature, name)
    text = file.manifest.encode()
    keys = list(trusted)
    candidates = [key for key in keys if key_id(key) == file.key_id]
    if not candidates:
        known = ", ".join(map(key_id, keys)) or "none"
        raise Untrusted(name, "unknown_key", f"signed by key {file.key_id}, which is not trusted; trusted: {known}")
    if not any(_signed_by(key, file, text, name) for key in candidates):
        raise Untrusted(name, "bad_signature", f"key {file.key_id} did not sign this manifest")
    signed = _manifest(file, name)
    if signed.size != len(data):
        raise Untrusted(name, "size", f"it has {len(data)} bytes, the signed file has {signed.size}")
    digest = hashlib.sha256(data).hexdigest()
    if signed.sha256 != digest:
        why = f"its sha256 is {digest[:16]}..., the signed file has {signed.sha256[:16]}...: another or changed file"
        raise Untrusted(name, "digest", why)
    header = read_header(data, name)
    if (signed.name, signed.config_sha256) != (header.name, _config_sha256(header)):
        raise Untrusted(name, "manifest", "its manifest names another model or configuration than its header")
    return signed


def read(signature: bytes, name: str = "bundle") -> Signed:
    """Read the manifest in a signature file without verifying it: for display only, never to trust.

    Raises:
        Untrusted: with the reason `too_large` or `malformed`.
    """
    return _manifest(_file(signature, name), name)


def allowed(release: int, highest_seen: int | None, allow_downgrade: bool) -> bool:
    """Whether a node may accept a model of this release after releases up to `highest_seen` (None: no release yet).

    An equal release is allowed; a lower one only if its signature allows the downgrade.

    >>> allowed(3, 4, allow_downgrade=False), allowed(3, 4, allow_downgrade=True), allowed(4, 4, allow_downgrade=False)
    (False, True, True)
    """
    return highest_seen is None or release >= highest_seen or allow_downgrade


def check_release(signed: Signed, highest_seen: int | None) -> None:
    """Check that the downgrade rule of `allowed` holds.

    Raises:
        Downgrade: the release is lower than `highest_seen` and its signature does not allow that.
    """
    if highest_seen is not None and not allowed(signed.release, highest_seen, signed.allow_downgrade):
        raise Downgrade(signed.name, signed.release, highest_seen)


def canonical(value: Any) -> str:
    """Canonical JSON: sorted keys, no spaces, finite numbers only.

    >>> canonical({"b": [1, 2], "a": "x"})
    '{"a":"x","b":[1,2]}'
    """
    return json.dumps(value, sort_keys=True, separators=(",", ":"), ensure_ascii=False, allow_nan=False)


def _config_sha256(header: Header) -> str:
    return hashlib.sha256(canonical(header.config.model_dump(mode="json")).encode()).hexdigest()


def _file(signature: bytes, name: str) -> _File:
    if len(signature) > MAX_SIGNATURE_BYTES:
        why = f"a signature file of {len(signature)} bytes: at most {MAX_SIGNATURE_BYTES} are allowed"
        raise Untrusted(name, "too_large", why)
    return _parsed(_File, signature, "signature file", name)


def _manifest(file: _File, name: str) -> Signed:
    signed = _parsed(Signed, file.manifest, "manifest", name)
    if signed.key_id != file.key_id:
        raise Untrusted(name, "malformed", "the signature file and its manifest name different keys")
    return signed


def _signed_by(key: "Ed25519PublicKey", file: _File, text: bytes, name: str) -> bool:
    from cryptography.exceptions import InvalidSignature

    try:
        key.verify(base64.b64decode(file.signature, validate=True), text)
    except InvalidSignature:
        return False
    except (binascii.Error, ValueError):
        raise Untrusted(name, "malformed", "signature file: signature is not base64") from None
    return True


_T = TypeVar("_T", _File, Signed)


def _parsed(kind: type[_T], text: str | bytes, what: str, name: str) -> _T:
    try:
        fields = json.loads(
            text if isinstance(text, str) else text.decode(), object_pairs_hook=object_without_duplicates
        )
        if not isinstance(fields, dict):
            raise Untrusted(name, "malformed", f"{what}: expected an object, not {shown(fields)}")
        return kind.model_validate(fields)
    except ValidationError as error:
        raise Untrusted(name, "malformed", f"{what}: {WrongField.of(error).sentence}") from None
    except (ValueError, RecursionError) as error:
        raise Untrusted(name, "malformed", f"{what}: not readable as JSON: {error}") from None
