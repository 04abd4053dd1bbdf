"""Signed manifest of a bundle: who vouches for exactly these bytes, and as which release.

The manifest is JSON: keys sorted, no spaces, UTF-8. The signature (Ed25519) is over the manifest's bytes, which are
kept as they are in the signature file, as a string: nobody has to write JSON as someone else did to check it. A
signature file lies beside its bundle, `NAME.safetensors.sig`. Everything here is bytes in and values out.
"""

import base64
import binascii
import hashlib
import json
from collections.abc import Iterable
from datetime import UTC, datetime
from typing import Annotated, Any, Final, Literal, TypeVar

from cryptography.exceptions import InvalidSignature
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey, Ed25519PublicKey
from pydantic import ConfigDict, Field, ValidationError

from neurove_core.config import Config
from neurove_core.models.bundle import MAX_BYTES, Header, object_without_duplicates, read_header
from neurove_core.models.metadata import MAX_RELEASE
from neurove_core.models.signing_keys import key_id
from neurove_protocol.errors import Downgrade, InvalidField, Untrusted, shown
from neurove_protocol.fields import WrongField

SUFFIX: Final = ".sig"
"""Added to the bundle's whole file name."""

MAX_SIGNATURE_BYTES: Final = 16 << 10

KeyId = Annotated[str, Field(pattern="^[0-9a-f]{16}$")]
_Sha256 = Annotated[str, Field(pattern="^[0-9a-f]{64}$")]


class _Strict(Config):
    model_config = ConfigDict(strict=True)


class Signed(_Strict):
    """What the holder of a key says about one bundle: the manifest."""

    kind: Literal["neurove model 1"] = "neurove model 1"  # a signature over anything else is none of ours
    name: str = Field(min_length=1, max_length=64)
    sha256: _Sha256  # of the bundle's bytes
    size: int = Field(ge=0, le=MAX_BYTES)  # [bytes]
    config_sha256: _Sha256  # of the model's configuration as canonical JSON
    release: int = Field(ge=0, le=MAX_RELEASE)
    allow_downgrade: bool  # it may take the place of a higher release
    key_id: KeyId
    created: str = Field(max_length=40)  # UTC, ISO 8601; for people


class _File(_Strict):
    manifest: str = Field(max_length=MAX_SIGNATURE_BYTES)  # the very text that is signed
    signature: str = Field(max_length=88)  # base64 of 64 bytes
    key_id: KeyId


def sign(
    data: bytes,
    key: Ed25519PrivateKey,
    *,
    release: int | None = None,
    allow_downgrade: bool = False,
    created: datetime | None = None,
    name: str = "bundle",
) -> bytes:
    """The signature file of a bundle.

    Args:
        data: the bundle's bytes.
        key: that signs.
        release: counter; where not given, the one in the bundle's header.
        allow_downgrade: let nodes take this model after a higher release, for an operator who must go back.
        created: for people; now, where not given.
        name: says in errors whose bytes these are.

    Raises:
        BadModel: the bytes are no bundle. InvalidField: the release is out of bounds.
    """
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


def verify(data: bytes, signature: bytes, trusted: Iterable[Ed25519PublicKey], name: str = "bundle") -> Signed:
    """What a trusted key says about a bundle; nothing of the bundle is read before that is known to hold.

    Args:
        data: the bundle's bytes.
        signature: the bytes of its signature file.
        trusted: keys of those who may make models.
        name: says in errors whose bytes these are.

    Raises:
        Untrusted: with the reason `too_large`, `malformed`, `unknown_key`, `bad_signature`, `size`, `digest` or
            `manifest`.
        BadModel: the signed bytes are no bundle.
    """
    file = _file(signature, name)
    text = file.manifest.encode()
    keys = list(trusted)
    candidates = [key for key in keys if key_id(key) == file.key_id]
    if not candidates:
        known = ", ".join(map(key_id, keys)) or "none"
        raise Untrusted(name, "unknown_key", f"signed by key {file.key_id}, which is not trusted; trusted: {known}")
    if not any(_signed_by(key, file, text, name) for key in candidates):
        raise Untrusted(name, "bad_signature", f"its signature is not one of key {file.key_id} over this manifest")
    signed = _manifest(file, name)
    if signed.size != len(data):
        raise Untrusted(name, "size", f"it has {len(data)} bytes, the signed file has {signed.size}")
    digest = hashlib.sha256(data).hexdigest()
    if signed.sha256 != digest:
        why = f"its sha256 is {digest[:16]}..., the signed file's {signed.sha256[:16]}...: another file, or changed"
        raise Untrusted(name, "digest", why)
    header = read_header(data, name)
    if (signed.name, signed.config_sha256) != (header.name, _config_sha256(header)):
        raise Untrusted(name, "manifest", "its manifest names another model or configuration than its header does")
    return signed


def read(signature: bytes, name: str = "bundle") -> Signed:
    """What a signature file claims, not verified: to be shown, never to be trusted.

    Raises:
        Untrusted: with the reason `too_large` or `malformed`.
    """
    return _manifest(_file(signature, name), name)


def allowed(release: int, highest_seen: int | None, allow_downgrade: bool) -> bool:
    """Whether a model of this release may be taken by who has had models up to `highest_seen` (None: not one yet).

    The same release may come again; a lower one only where its signature says so.

    >>> allowed(3, 4, allow_downgrade=False), allowed(3, 4, allow_downgrade=True), allowed(4, 4, allow_downgrade=False)
    (False, True, True)
    """
    return highest_seen is None or release >= highest_seen or allow_downgrade


def check_release(signed: Signed, highest_seen: int | None) -> None:
    """As `allowed`.

    Raises:
        Downgrade: it is not.
    """
    if highest_seen is not None and not allowed(signed.release, highest_seen, signed.allow_downgrade):
        raise Downgrade(signed.name, signed.release, highest_seen)


def canonical(value: Any) -> str:
    """JSON in one form: keys sorted, no spaces, nothing but finite numbers.

    >>> canonical({"b": [1, 2], "a": "x"})
    '{"a":"x","b":[1,2]}'
    """
    return json.dumps(value, sort_keys=True, separators=(",", ":"), ensure_ascii=False, allow_nan=False)


def _config_sha256(header: Header) -> str:
    return hashlib.sha256(canonical(header.config.model_dump(mode="json")).encode()).hexdigest()


def _file(signature: bytes, name: str) -> _File:
    if len(signature) > MAX_SIGNATURE_BYTES:
        why = f"a signature file of {len(signature)} bytes: at most {MAX_SIGNATURE_BYTES}"
        raise Untrusted(name, "too_large", why)
    return _parsed(_File, signature, "signature file", name)


def _manifest(file: _File, name: str) -> Signed:
    signed = _parsed(Signed, file.manifest, "manifest", name)
    if signed.key_id != file.key_id:
        raise Untrusted(name, "malformed", "its signature file and the manifest in it name different keys")
    return signed


def _signed_by(key: Ed25519PublicKey, file: _File, text: bytes, name: str) -> bool:
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
            raise Untrusted(name, "malformed", f"{what}: an object is expected, not {shown(fields)}")
        return kind.model_validate(fields)
    except ValidationError as error:
        raise Untrusted(name, "malformed", f"{what}: {WrongField.of(error).sentence}") from None
    except (ValueError, RecursionError) as error:
        raise Untrusted(name, "malformed", f"{what}: not JSON that can be read: {error}") from None
