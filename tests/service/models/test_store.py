import dataclasses
import hashlib
import shutil
import threading
from pathlib import Path

import numpy as np
import pytest

from neurove_core.config import NetworkConfig
from neurove_core.models import bundle
from neurove_protocol.control import PushRequest
from neurove_protocol.errors import (
    BadModel,
    Downgrade,
    NeuroVEError,
    NoQuota,
    NoSpace,
    NoStore,
    TooLarge,
    TransferInterrupted,
)
from neurove_service.models import store as model_store
from neurove_service.models.library import Library
from neurove_service.models.pull import MIN_CHUNK_BYTES, ChunkLength
from neurove_service.models.signatures import Signed
from neurove_service.models.slot import ModelSlot
from neurove_service.models.store import ModelStore
from tests.service.conftest import SMALL

RUNS = threading.Event()


BIGGER = SMALL.model_copy(update={"network": NetworkConfig(channels=(4, 4), features=96, hidden=96)})


def bytes_of(seed, name):
    """A bundle that takes several chunks."""
    return bundle.untrained(seed, BIGGER, name).to_bytes()


@pytest.fixture(scope="module")
def data():
    return bytes_of(3, "three")


@pytest.fixture
def store(tmp_path):
    return ModelStore(tmp_path, patience_s=0.6)


def wanted(data, **other):
    digest = hashlib.sha256(data).hexdigest()
    return PushRequest(**{"digest": digest, "size": len(data), "name": "three.safetensors"} | other)


def source(data, *, until=None, asked=None):
    """Answers requests for chunks of these bytes; after `until` it no longer answers."""

    def pull(_, request):
        if asked is not None:
            asked.append(request)
        end = request.offset + request.length
        return None if until is not None and end > until else data[request.offset : end]

    return pull


def fetch(store, request, pull, steps=None, stop=RUNS, **other):
    return store.fetch(request, pull, stop, (steps if steps is not None else []).append, **other)


def files(folder):
    return sorted(str(path.relative_to(folder)) for path in folder.rglob("*") if path.is_file())


def pushed(store):
    """Names of the valid pushed models, and the errors of the others."""
    available = Library(pushed=store.files).available()
    return {one.name for one in available.models} - {"default", "untrained"}, available.unreadable


def test_a_pushed_bundle_is_complete_on_the_disk_and_can_be_activated(store, tmp_path, data):
    steps = []
    model, signed, moved = fetch(store, wanted(data), source(data), steps)
    assert (model.name, signed.state, moved) == ("three", "unsigned", len(data))
    assert [step.step for step in steps] == ["fetching", "staged", "verified"]
    assert files(tmp_path) == [f"pushed/{model.digest}/bundle.safetensors"]
    slot = ModelSlot("untrained", pushed=store.files)
    assert slot.activate("three")[1].estimator.bundle.digest == model.digest
    assert fetch(store, wanted(data), source(b""))[2] == 0  # already stored: no chunk is requested


def test_an_interrupted_push_resumes_also_in_another_process(store, tmp_path, data):
    with pytest.raises(
        TransferInterrupted, match=r"interrupted at \d+ of \d+ bytes: the client that pushed it does not answer"
    ):
        fetch(store, wanted(data), source(data, until=len(data) - 1))
    have = store.partial()[wanted(data).digest]
    assert 0 < have < len(data)
    asked = []
    assert fetch(ModelStore(tmp_path), wanted(data), source(data, asked=asked))[2] == len(data) - have
    assert asked[0].offset == have
    assert ModelStore(tmp_path).partial() == {}


def test_staged_bytes_that_do_not_match_are_fetched_again(store, tmp_path, data):
    staging = tmp_path / "staging" / wanted(data).digest
    for staged in (b"\0" * 1000, b"\0" * len(data), b"\0" * (len(data) + 1)):
        staging.mkdir(parents=True)
        (staging / "bundle.safetensors").write_bytes(staged)
        assert fetch(store, wanted(data), source(data))[0].name == "three"
        shutil.rmtree(tmp_path / "pushed")


def flipped(data):
    return data[:-1] + bytes([data[-1] ^ 1])


def with_nan():
    model = bundle.untrained(3, SMALL, "three")
    return dataclasses.replace(model, offset=model.offset * float("nan")).to_bytes()


@pytest.mark.parametrize(
    ("bad", "claimed", "words"),
    [
        (flipped, None, "the sha256 of the received bytes is"),
        (lambda data: data[: len(data) // 2], "itself", "not a complete safetensors file"),
        (lambda _: b"hello, I am no model at all", "itself", "not a safetensors file"),
        (lambda _: with_nan(), "itself", "not finite"),
    ],
)
def test_a_bad_bundle_is_refused_with_its_reason_and_leaves_nothing(store, tmp_path, data, bad, claimed, words):
    sent = bad(data)
    request = wanted(sent if claimed else data, size=len(sent))
    with pytest.raises(BadModel, match=words):
        fetch(store, request, source(sent))
    assert files(tmp_path) == []
    assert store.files() == {}


def test_a_bundle_that_cannot_be_stored_is_refused_before_the_first_byte(tmp_path, data, monkeypatch):
    never = source(data, until=0)
    with pytest.raises(NoStore, match="neither models_dir nor state_dir"):
        fetch(ModelStore(None), wanted(data), never)
    with pytest.raises(TooLarge, match=f"at most {bundle.MAX_BYTES} bytes"):
        fetch(ModelStore(tmp_path), wanted(data, size=bundle.MAX_BYTES + 1), never)
    with pytest.raises(NoQuota, match=f"0 of {len(data) - 1} bytes for pushed models are in use"):
        fetch(ModelStore(tmp_path, quota_bytes=len(data) - 1), wanted(data), never)
    monkeypatch.setattr(model_store, "SPARE_BYTES", 1 << 62)  # the disk of a test is never full
    with pytest.raises(NoSpace, match=f"needs {len(data)} bytes"):
        fetch(ModelStore(tmp_path), wanted(data), never)
    assert files(tmp_path) == []


def test_a_push_to_a_folder_that_is_not_writable_is_refused(tmp_path, data):
    (tmp_path / "staging").write_text("a file instead of a folder")
    with pytest.raises(NoStore, match="its folder is not writable"):
        fetch(ModelStore(tmp_path), wanted(data), source(data))


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="this system has no full device")
def test_a_push_that_fills_the_disk_is_refused_and_leaves_nothing(store, tmp_path, data):
    staging = tmp_path / "staging" / wanted(data).digest
    staging.mkdir(parents=True)
    (staging / "bundle.safetensors").symlink_to("/dev/full")
    with pytest.raises(NoSpace):
        fetch(store, wanted(data), source(data))
    assert files(tmp_path) == []
    assert fetch(store, wanted(data), source(data))[0].name == "three"


def test_a_new_push_discards_interrupted_pushes_but_no_complete_models(tmp_path, data):
    store = ModelStore(tmp_path, quota_bytes=2 * len(data), patience_s=0.1)
    other = bytes_of(4, "four")
    third = bytes_of(5, "five")
    with pytest.raises(TransferInterrupted):
        fetch(store, wanted(other), source(other, until=len(other) - 1))
    fetch(store, wanted(data), source(data))
    assert store.partial()
    fetch(store, wanted(third), source(third))
    assert store.partial() == {}
    with pytest.raises(NoQuota):
        fetch(store, wanted(other), source(other))
    assert pushed(store) == ({"three", "five"}, {})


def test_two_pushes_of_one_bundle_at_once_transfer_it_once(tmp_path, data):
    store, results, gate = ModelStore(tmp_path), [], threading.Event()
    steps = [[], []]

    def slow(digest, request):
        assert gate.wait(60)
        return source(data)(digest, request)

    def push(number):
        results.append(fetch(store, wanted(data), slow, steps[number])[2])

    first = threading.Thread(target=push, args=(0,))
    first.start()
    while not steps[0]:
        threading.Event().wait(0.01)
    second = threading.Thread(target=push, args=(1,))
    second.start()
    while not steps[1]:
        threading.Event().wait(0.01)
    gate.set()
    first.join()
    second.join()
    assert results == [len(data), 0]
    assert steps[1][0].text == "another push of the same model is in progress"


def test_a_source_with_wrong_answers_is_asked_again_until_the_push_is_interrupted(store, data):
    def pull(digest, request):
        return source(data)(digest, request) + b"\0"

    with pytest.raises(TransferInterrupted, match="instead of"):
        fetch(store, wanted(data), pull)

    def refuses(_, __):
        raise NeuroVEError("the file has gone")

    with pytest.raises(TransferInterrupted, match="the file has gone"):
        fetch(store, wanted(data), refuses)


def test_a_node_that_is_stopping_does_not_wait_for_chunks(tmp_path, data):
    stopping = threading.Event()
    stopping.set()
    with pytest.raises(TransferInterrupted, match="this node is stopping"):
        fetch(ModelStore(tmp_path, patience_s=600), wanted(data), source(data, until=0), stop=stopping)


def lengths_over(chunks, *, seconds_per_byte, seconds=0.0):
    """Lengths of consecutive chunks over a link."""
    length, found = ChunkLength(), []
    for _ in range(chunks):
        found.append(length.bytes)
        length.took(seconds + seconds_per_byte * length.bytes)
    return found


def test_chunks_grow_until_they_occupy_the_link_for_a_millisecond_or_two():
    slow = lengths_over(500, seconds_per_byte=8 / 20e6)  # 20 Mbit/s
    assert (slow[0], max(slow)) == (MIN_CHUNK_BYTES, 2 * MIN_CHUNK_BYTES)
    assert np.mean(slow) < 1.2 * MIN_CHUNK_BYTES
    assert max(lengths_over(500, seconds_per_byte=8 / 1e9)) == 1 << 17
    assert max(lengths_over(500, seconds_per_byte=0)) == 1 << 20


def test_a_link_with_a_long_delay_gets_larger_chunks():
    assert max(lengths_over(500, seconds_per_byte=8 / 20e6, seconds=0.1)) == 1 << 17


def test_a_model_that_changed_on_the_disk_is_listed_with_its_reason_and_can_be_pushed_again(store, tmp_path, data):
    digest = fetch(store, wanted(data), source(data))[0].digest
    file = tmp_path / "pushed" / digest / "bundle.safetensors"
    for changed in (flipped(data), data[:-1]):
        file.write_bytes(changed)
        assert pushed(store)[1].keys() == {digest}
        with pytest.raises(BadModel):
            ModelSlot("untrained", pushed=store.files).activate(digest)
        assert fetch(store, wanted(data), source(data))[2] == len(data)
        assert pushed(store)[1] == {}


def test_only_folders_named_by_a_digest_are_read(store, tmp_path, data):
    fetch(store, wanted(data), source(data))
    for foreign in ("pushed/readme", "pushed/" + "x" * 64, "staging/.." + "5e" * 31):
        (tmp_path / foreign).mkdir(parents=True)
    (tmp_path / "pushed" / ("5e" * 32)).write_text("a file")
    assert pushed(store) == ({"three"}, {})
    assert store.partial() == {}


def trusts(data, signature):
    """The rule of a node that accepts the signature `good` and its flag."""
    if signature is None or not signature.startswith(b"good"):
        raise Downgrade("x", 0, 1) if signature == b"old" else NeuroVEError("untrusted")
    return Signed("trusted", allow_downgrade=signature.endswith(b"flag"))


def test_a_signature_is_verified_before_a_model_is_stored_and_stored_next_to_it(tmp_path, data):
    store = ModelStore(tmp_path / "state", tmp_path, verify=trusts)
    for signature in (None, b"bad"):
        with pytest.raises(NeuroVEError, match="untrusted"):
            fetch(store, wanted(data, signature=signature), source(data))
    assert files(tmp_path) == []
    model, signed, _ = fetch(store, wanted(data, signature=b"good"), source(data))
    assert signed == store.signed(model.digest) == Signed("trusted")
    with pytest.raises(NeuroVEError):
        fetch(store, wanted(data, signature=b"bad"), source(data))
    assert fetch(store, wanted(data, signature=b"good, flag"), source(data))[2] == 0
    assert store.signed(model.digest).allow_downgrade
    assert ModelStore(tmp_path / "state", None, verify=trusts).signed(model.digest).allow_downgrade


def test_signatures_next_to_the_operators_own_files_are_verified_too(tmp_path, data):
    (tmp_path / "mine.safetensors").write_bytes(data)
    store = ModelStore(None, tmp_path, verify=trusts)
    digest = hashlib.sha256(data).hexdigest()
    with pytest.raises(NeuroVEError):
        store.signed(digest)
    (tmp_path / "mine.safetensors.sig").write_bytes(b"good")
    assert store.signed(digest).state == "trusted"
    assert store.signed("0" * 64).state == "unsigned"  # a built-in one


def test_a_node_without_trusted_keys_reports_whether_a_signature_exists(store, data):
    assert fetch(store, wanted(data), source(data))[1].state == "unsigned"
    assert fetch(store, wanted(data, signature=b"{}"), source(data))[1].state == "unchecked"
