"""A node that trusts keys accepts only models that one of them signed, pushed or from its folder."""

import hashlib
import threading

import pytest

from neurove_core.models import manifest, signing_keys
from neurove_protocol.control import ActivateRequest, ModelsReply, ModelsRequest, PushRequest
from neurove_protocol.errors import Downgrade, InvalidField, Untrusted
from neurove_service.models.active_file import Active, ActiveFile
from neurove_service.models.change import Rules
from neurove_service.models.signatures import verifier
from neurove_service.models.slot import ModelSlot
from neurove_service.models.store import ModelStore
from neurove_service.node.condition import Condition
from neurove_service.node.handlers import Handlers

KEY, OTHER = signing_keys.new(), signing_keys.new()


@pytest.fixture
def key_file(tmp_path):
    path = tmp_path / "release.pub"
    path.write_bytes(signing_keys.public_pem(KEY.public_key()))
    return path


@pytest.fixture
def folder(models_dir, tmp_path):
    """`one` is signed by a trusted key, `two` is not signed."""
    data = (models_dir / "one.safetensors").read_bytes()
    (tmp_path / "one.safetensors").write_bytes(data)
    (tmp_path / "one.safetensors.sig").write_bytes(manifest.sign(data, KEY, release=3))
    (tmp_path / "two.safetensors").write_bytes((models_dir / "two.safetensors").read_bytes())
    return tmp_path


def handlers_of(folder, key_file, highest_release=0):
    store = ModelStore(folder / "state", folder, verify=verifier((key_file,)))
    active_file = ActiveFile(None)
    active_file.keep(Active(digest="0" * 64, previous=None, configured="x", highest_release=highest_release))
    slot = ModelSlot("untrained", folder, Rules(probation_s=0.1), pushed=store.files)
    return Handlers("edge", slot, list, Condition, store, active_file)


def test_a_signed_model_may_serve_and_an_unsigned_one_may_not(folder, key_file):
    handlers = handlers_of(folder, key_file)
    handlers.activate(ActivateRequest(model="one").encode())
    with pytest.raises(Untrusted, match="only signed models"):
        handlers.activate(ActivateRequest(model="two").encode())
    models = ModelsReply.decode(handlers.models(ModelsRequest().encode()))
    assert models.active.name == "one"
    states = {info.name: info.signature for info in models.available}
    assert (states["one"], states["two"]) == ("trusted", "untrusted")


def test_the_signed_release_is_compared_with_the_highest(folder, key_file):
    with pytest.raises(Downgrade, match="release=3: release 4 was accepted before"):
        handlers_of(folder, key_file, highest_release=4).activate(ActivateRequest(model="one").encode())
    handlers_of(folder, key_file, highest_release=3).activate(ActivateRequest(model="one").encode())


@pytest.mark.parametrize(
    ("signature", "reason"),
    [(None, "unsigned"), (OTHER, "unknown_key"), (b"{}", "malformed")],
)
def test_a_push_without_a_trusted_signature_leaves_nothing_on_the_node(folder, key_file, signature, reason):
    handlers, data = handlers_of(folder, key_file), (folder / "two.safetensors").read_bytes()
    signed = manifest.sign(data, signature, release=1) if signature is OTHER else signature
    digest = hashlib.sha256(data).hexdigest()
    request = PushRequest(digest=digest, size=len(data), name="two.safetensors", signature=signed)

    def chunk(_, wanted):
        return data[wanted.offset : wanted.offset + wanted.length]

    with pytest.raises(Untrusted) as refused:
        handlers.push(request.encode(), lambda _: None, chunk, threading.Event())
    assert refused.value.details["reason"] == reason
    assert not list((folder / "state").rglob("*.safetensors"))


def test_a_signature_is_verified_once_until_it_or_its_bundle_changes(folder, key_file):
    read = []
    check = verifier((key_file,))

    def counted(data, signature):
        read.append(len(data))
        return check(data, signature)

    store = ModelStore(folder / "state", folder, verify=counted)
    digests = {
        name: hashlib.sha256((folder / f"{name}.safetensors").read_bytes()).hexdigest() for name in ("one", "two")
    }
    for _ in range(3):
        assert store.signed(digests["one"]).release == 3
        with pytest.raises(Untrusted, match="only signed models"):
            store.signed(digests["two"])
    assert len(read) == 2
    data = (folder / "one.safetensors").read_bytes()
    (folder / "one.safetensors.sig").write_bytes(manifest.sign(data, OTHER, release=77))
    with pytest.raises(Untrusted):
        store.signed(digests["one"])
    (folder / "one.safetensors.sig").unlink()
    with pytest.raises(Untrusted, match="only signed models"):
        store.signed(digests["one"])
    assert len(read) == 4


def test_an_unreadable_key_stops_the_start(tmp_path):
    with pytest.raises(InvalidField, match=r"trusted_keys=.*none\.pub.*No such file"):
        verifier((tmp_path / "none.pub",))
    (tmp_path / "text.pub").write_text("hello")
    with pytest.raises(InvalidField):
        verifier((tmp_path / "text.pub",))
