import hashlib

import pytest

from neurove_protocol.control import MAX_SIGNATURE_BYTES, ChunkRequest
from neurove_protocol.errors import BadModel, InvalidField, Malformed
from neurove_service.clients.push_source import PushSource


@pytest.fixture
def file(tmp_path):
    path = tmp_path / "model.safetensors"
    path.write_bytes(bytes(range(100)))
    return path


def test_the_chunks_of_a_file_are_its_bytes(file):
    with PushSource(file) as source:
        assert source.request.digest == hashlib.sha256(file.read_bytes()).hexdigest()
        assert (source.request.size, source.request.name, source.request.signature) == (100, file.name, None)
        pieces = [source.chunk(ChunkRequest(offset=at, length=25).encode()) for at in range(0, 100, 25)]
        assert b"".join(pieces) == file.read_bytes()


def test_a_chunk_outside_the_file_is_refused(file):
    with PushSource(file) as source:
        with pytest.raises(InvalidField, match="offset=90: with length it ends at 101, the bundle at 100"):
            source.chunk(ChunkRequest(offset=90, length=11).encode())
        with pytest.raises(Malformed):
            source.chunk(b"")


def test_the_signature_file_is_part_of_the_request(file):
    signature = file.with_name("model.safetensors.sig")
    signature.write_bytes(b"{}")
    with PushSource(file) as source:
        assert source.request.signature == b"{}"
    signature.write_bytes(b"x" * (MAX_SIGNATURE_BYTES + 1))
    with pytest.raises(BadModel, match="a signature has at most 65536 bytes"):
        PushSource(file)


def test_a_file_that_is_missing_or_empty_is_named(tmp_path):
    with pytest.raises(BadModel, match="No such file"):
        PushSource(tmp_path / "nowhere.safetensors")
    (tmp_path / "empty.safetensors").touch()
    with pytest.raises(BadModel, match=r"model empty\.safetensors: "):
        PushSource(tmp_path / "empty.safetensors")
