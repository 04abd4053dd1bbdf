"""Signatures: exactly what a trusted key signed is accepted, and everything else is refused with a reason."""

import base64
import hashlib
import json
from dataclasses import replace
from datetime import UTC, datetime

import pytest
from cryptography.hazmat.primitives import serialization
from cryptography.hazmat.primitives.asymmetric import ec, ed448, ed25519
from hypothesis import given
from hypothesis import strategies as st

from neurove_core.models import bundle, manifest, signing_keys
from neurove_core.models.metadata import Metadata
from neurove_protocol.errors import BadModel, Downgrade, InvalidField, Untrusted
from tests.bundles import CONFIG, DATA, ORIGINAL, make_bundle

KEY = ed25519.Ed25519PrivateKey.from_private_bytes(bytes(range(32)))
OTHER = ed25519.Ed25519PrivateKey.from_private_bytes(bytes(range(1, 33)))
PUBLIC = KEY.public_key()
WHEN = datetime(2026, 3, 1, 12, 30, tzinfo=UTC)
SIGNATURE = manifest.sign(DATA, KEY, release=4, created=WHEN)


def refusal(reason, *, data=DATA, signature=SIGNATURE, trusted=(PUBLIC,)):
    """The message of the refusal, which must have this reason."""
    with pytest.raises(Untrusted) as refused:
        manifest.verify(data, signature, trusted, "some.safetensors")
    assert refused.value.code == "untrusted"
    assert refused.value.details["reason"] == reason
    assert refused.value.message.startswith("model some.safetensors: ")
    assert len(refused.value.message) < 500
    return refused.value.message


def file_with(**fields):
    """The signature file with some fields replaced."""
    return json.dumps({**json.loads(SIGNATURE), **fields}).encode()


def signed_by_hand(text, key=KEY):
    """A signature file for any manifest text, with a valid signature."""
    signature = base64.b64encode(key.sign(text.encode())).decode()
    return json.dumps(
        {"manifest": text, "signature": signature, "key_id": signing_keys.key_id(key.public_key())}
    ).encode()


def manifest_with(**fields):
    """The signature file of a manifest with some fields replaced, with a valid signature."""
    return signed_by_hand(manifest.canonical({**json.loads(json.loads(SIGNATURE)["manifest"]), **fields}))


def test_a_bundle_that_a_trusted_key_signed_is_verified_with_its_release():
    signed = manifest.verify(DATA, SIGNATURE, [OTHER.public_key(), PUBLIC])
    assert (signed.name, signed.release, signed.allow_downgrade) == ("untrained", 4, False)
    assert (signed.sha256, signed.size) == (ORIGINAL.digest, len(DATA))
    assert signed.key_id == signing_keys.key_id(PUBLIC)
    assert signed.created == "2026-03-01T12:30:00+00:00"
    assert manifest.read(SIGNATURE) == signed


def test_the_default_release_is_that_of_the_bundle():
    data = replace(ORIGINAL, metadata=Metadata(release=9)).to_bytes()
    for given_release, want in ((None, 9), (0, 0), (12, 12)):
        signature = manifest.sign(data, KEY, release=given_release, allow_downgrade=True)
        signed = manifest.verify(data, signature, [PUBLIC])
        assert (signed.release, signed.allow_downgrade) == (want, True)


def test_signing_is_deterministic_and_the_manifest_has_the_digest_of_the_configuration():
    assert manifest.sign(DATA, KEY, release=4, created=WHEN) == SIGNATURE
    other = make_bundle(settle_windows=3).to_bytes()
    one, two = (manifest.read(manifest.sign(data, KEY)).config_sha256 for data in (DATA, other))
    assert one != two
    assert one == hashlib.sha256(manifest.canonical(CONFIG.model_dump(mode="json")).encode()).hexdigest()


def test_the_signature_can_be_checked_without_this_program():
    fields = json.loads(SIGNATURE)
    PUBLIC.verify(base64.b64decode(fields["signature"]), fields["manifest"].encode())
    signed = json.loads(fields["manifest"])
    assert json.dumps(signed, sort_keys=True, separators=(",", ":")) == fields["manifest"]
    assert signed["sha256"] == hashlib.sha256(DATA).hexdigest()


def test_an_untrusted_key_is_refused_and_the_trusted_keys_are_named():
    message = refusal("unknown_key", trusted=[OTHER.public_key()])
    assert signing_keys.key_id(PUBLIC) in message
    assert signing_keys.key_id(OTHER.public_key()) in message
    assert "trusted: none" in refusal("unknown_key", trusted=[])


def test_a_key_that_claims_the_id_of_a_trusted_key_is_refused():
    forged = json.loads(manifest.sign(DATA, OTHER, release=4))
    forged["key_id"] = signing_keys.key_id(PUBLIC)
    refusal("bad_signature", signature=json.dumps(forged).encode())


def test_a_changed_manifest_is_refused():
    text = json.loads(SIGNATURE)["manifest"]
    for changed in (text.replace('"release":4', '"release":5'), text + " ", text.replace("false", "true"), ""):
        refusal("bad_signature", signature=file_with(manifest=changed))


def test_a_signature_is_valid_for_one_bundle_only():
    other = make_bundle(1).to_bytes()
    assert len(other) == len(DATA)
    assert "another or changed file" in refusal("digest", data=other)
    message = refusal("size", data=DATA + b"\x00")
    assert str(len(DATA) + 1) in message
    refusal("size", data=b"")


@given(where=st.integers(0, len(DATA) - 1), bit=st.integers(0, 7))
def test_every_flipped_bit_of_a_signed_bundle_is_refused(where, bit):
    flipped = bytearray(DATA)
    flipped[where] ^= 1 << bit
    refusal("digest", data=bytes(flipped))


@given(length=st.integers(0, len(DATA) - 1))
def test_every_truncation_of_a_signed_bundle_is_refused(length):
    refusal("size", data=DATA[:length])


@given(where=st.integers(0, len(SIGNATURE) - 1), bit=st.integers(0, 7))
def test_a_flipped_bit_of_a_signature_file_is_refused_or_changes_nothing(where, bit):
    flipped = bytearray(SIGNATURE)
    flipped[where] ^= 1 << bit
    assert_refused_or_the_same(bytes(flipped))


@given(where=st.integers(0, len(SIGNATURE)), junk=st.binary(max_size=20), removed=st.integers(0, 20))
def test_inserted_bytes_in_a_signature_file_are_refused_or_change_nothing(where, junk, removed):
    assert_refused_or_the_same(SIGNATURE[:where] + junk + SIGNATURE[where + removed :])


def assert_refused_or_the_same(signature):
    try:
        signed = manifest.verify(DATA, signature, [PUBLIC])
    except Untrusted:
        return
    assert signed == manifest.read(SIGNATURE)


@given(st.binary(max_size=300))
def test_random_bytes_are_not_a_signature_file(data):
    refusal("malformed", signature=data)


@pytest.mark.parametrize(
    ("signature", "words"),
    [
        (b"", "not readable as JSON"),
        (b"\xff\xfe", "not readable as JSON"),
        (SIGNATURE.decode().encode("utf-16"), "not readable as JSON"),
        (b"[" * 16_000, "not readable as JSON"),
        (b"[1]", "expected an object, not [1]"),
        (SIGNATURE[:-20], "not readable as JSON"),
        (SIGNATURE.replace(b'{"key_id"', b'{"key_id":"","key_id"', 1), "a key occurs twice"),
        (file_with(more=1), "more=1: Extra inputs are not permitted"),
        (file_with(manifest=None), "manifest=None"),
        (file_with(manifest={}), "manifest={}"),
        (file_with(key_id="KEY"), "key_id='KEY'"),
        (file_with(signature="*" * 88), "signature is not base64"),
        (file_with(signature="\u00e9" * 88), "signature is not base64"),
        (file_with(signature="A" * 89), "signature="),
        (file_with(signature=7), "signature=7"),
        (json.dumps({"manifest": "{}"}).encode(), "missing"),
    ],
    ids=range(16),
)
def test_a_malformed_signature_file_is_refused_and_the_message_says_why(signature, words):
    assert words in refusal("malformed", signature=signature)


def test_a_signature_that_is_too_short_is_refused():
    refusal("bad_signature", signature=file_with(signature=""))
    refusal("bad_signature", signature=file_with(signature="AAAA"))


def test_a_manifest_that_cannot_be_encoded_is_refused():
    refusal("malformed", signature=file_with(manifest="\ud800"))


def test_a_huge_signature_file_is_refused_before_it_is_parsed():
    message = refusal("too_large", signature=b"{" * (manifest.MAX_SIGNATURE_BYTES + 1))
    assert str(manifest.MAX_SIGNATURE_BYTES) in message


@pytest.mark.parametrize(
    ("signature", "words"),
    [
        (signed_by_hand("no JSON"), "manifest: not readable as JSON"),
        (signed_by_hand('{"release":1,"release":2}'), "manifest: not readable as JSON: a key occurs twice"),
        (signed_by_hand("[]"), "manifest: expected an object"),
        (manifest_with(kind="grocery list"), "kind='grocery list'"),
        (manifest_with(release=-1), "release=-1"),
        (manifest_with(release="4"), "release='4'"),
        (manifest_with(release=True), "release=True"),
        (manifest_with(release=1 << 63), "release="),
        (manifest_with(allow_downgrade=1), "allow_downgrade=1"),
        (manifest_with(sha256="A" * 64), "sha256="),
        (manifest_with(size=bundle.MAX_BYTES + 1), "size="),
        (manifest_with(expires="soon"), "expires='soon'"),
        (manifest_with(key_id="0" * 16), "name different keys"),
    ],
    ids=range(13),
)
def test_an_invalid_manifest_is_refused_even_with_a_valid_signature(signature, words):
    assert words in refusal("malformed", signature=signature)


@pytest.mark.parametrize("changes", [{"name": "other"}, {"config_sha256": "0" * 64}])
def test_a_manifest_that_names_another_model_than_the_bundle_is_refused(changes):
    refusal("manifest", signature=manifest_with(**changes))


def test_bytes_that_are_not_a_bundle_are_never_signed_and_never_accepted():
    with pytest.raises(BadModel):
        manifest.sign(b"hello", KEY)
    text = manifest_with(sha256=hashlib.sha256(b"hello").hexdigest(), size=5)
    with pytest.raises(BadModel, match="size=5"):
        manifest.verify(b"hello", text, [PUBLIC])


@pytest.mark.parametrize("release", [-1, 1 << 63])
def test_a_release_out_of_bounds_is_not_signed(release):
    with pytest.raises(InvalidField, match=f"release={release}"):
        manifest.sign(DATA, KEY, release=release)


@pytest.mark.parametrize(
    ("release", "highest", "flag", "want"),
    [
        (0, None, False, True),
        (0, 0, False, True),
        (5, 4, False, True),
        (4, 4, False, True),
        (3, 4, False, False),
        (3, 4, True, True),
        (0, 1 << 62, True, True),
    ],
)
def test_a_lower_release_is_refused_unless_its_signature_allows_it(release, highest, flag, want):
    assert manifest.allowed(release, highest, flag) is want
    signed = manifest.read(manifest.sign(DATA, KEY, release=release, allow_downgrade=flag))
    if want:
        manifest.check_release(signed, highest)
    else:
        with pytest.raises(Downgrade, match=f"release={release}: release {highest} was accepted before") as refused:
            manifest.check_release(signed, highest)
        assert refused.value.code == "downgrade"


def test_keys_are_read_from_their_files_with_the_same_id():
    private = signing_keys.read_private(signing_keys.private_pem(KEY), "k")
    public = signing_keys.read_public(signing_keys.public_pem(PUBLIC), "p")
    assert signing_keys.key_id(private.public_key()) == signing_keys.key_id(public) == signing_keys.key_id(PUBLIC)
    manifest.verify(DATA, manifest.sign(DATA, private), [public])
    assert signing_keys.key_id(signing_keys.new().public_key()) != signing_keys.key_id(PUBLIC)


def pem(key, encryption=None):
    encryption = encryption or serialization.NoEncryption()
    return key.private_bytes(serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, encryption)


@pytest.mark.parametrize(
    ("data", "why"),
    [
        (b"", "not a private key in PEM"),
        (signing_keys.private_pem(KEY)[:60], "not a private key in PEM"),
        (signing_keys.public_pem(PUBLIC), "it is a public key"),
        (pem(KEY, serialization.BestAvailableEncryption(b"secret")), "it has a pass phrase"),
        (pem(ed448.Ed448PrivateKey.generate()), "not an Ed25519 key"),
        (pem(ec.generate_private_key(ec.SECP256R1())), "not an Ed25519 key"),
        (b" " * 20_000, "at most 16384"),
    ],
    ids=range(7),
)
def test_a_file_that_is_not_a_private_key_is_refused_and_the_message_says_why(data, why):
    with pytest.raises(InvalidField, match=why) as refused:
        signing_keys.read_private(data, "some.key")
    assert "some.key" in refused.value.message


@pytest.mark.parametrize(
    ("data", "why"),
    [
        (b"", "not a public key in PEM"),
        (b"-----BEGIN PUBLIC KEY-----\nAAAA\n-----END PUBLIC KEY-----\n", "not a public key in PEM"),
        (signing_keys.private_pem(KEY), "it is a private key"),
        (b" " * 20_000, "at most 16384"),
    ],
    ids=range(4),
)
def test_a_file_that_is_not_a_public_key_is_refused_and_the_message_says_why(data, why):
    with pytest.raises(InvalidField, match=why):
        signing_keys.read_public(data, "some.pub")


def test_a_public_key_of_another_algorithm_is_refused():
    other = ec.generate_private_key(ec.SECP256R1()).public_key()
    data = other.public_bytes(serialization.Encoding.PEM, serialization.PublicFormat.SubjectPublicKeyInfo)
    with pytest.raises(InvalidField, match="not an Ed25519 key"):
        signing_keys.read_public(data, "some.pub")


def test_names_outside_ascii_are_not_escaped():
    assert manifest.canonical({"é": 1}) == '{"é":1}'
