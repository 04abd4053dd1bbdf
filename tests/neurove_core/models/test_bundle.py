"""Bundles: loading gives what was saved, and every other file is refused with a reason."""

import errno
import hashlib
import json
import os
import struct
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import safetensors.torch
import torch
from hypothesis import given
from hypothesis import strategies as st

from neurove_core.config import NetworkConfig
from neurove_core.estimator import Estimator
from neurove_core.models import bundle, container
from neurove_core.models.bundle import Bundle
from neurove_protocol.errors import BadModel
from tests.builders import SENSOR, make_events
from tests.bundles import (
    CONFIG,
    DATA,
    ORIGINAL,
    join_header,
    make_bundle,
    refusal,
    split_header,
    with_entries,
    with_fields,
    with_tensors,
)


def answers_of(model: Bundle) -> list[list[list[float]]]:
    estimator = Estimator(model)
    answer = estimator.push(make_events(2_000, duration_us=50_000), estimator.initial_state(SENSOR), 0)
    return [estimate.twists.tolist() for estimate in answer.estimates]


def assert_refused_or_another_model(data: bytes) -> None:
    try:
        loaded = bundle.from_bytes(data, "x")
    except BadModel:
        return
    assert loaded.digest != ORIGINAL.digest


def test_a_saved_model_is_loaded_with_the_same_digest_config_and_answers(tmp_path):
    path = tmp_path / "model.safetensors"
    saved = replace(
        make_bundle(3), trained=True, name="night", scale=torch.arange(1.0, 7.0), offset=torch.full((6,), 0.5)
    ).with_digest()
    bundle.save(saved, path)
    loaded = bundle.load(path)
    for field in ("name", "trained", "provenance", "config", "digest", "info"):
        assert getattr(loaded, field) == getattr(saved, field)
    assert not loaded.network.training
    assert len(answers_of(saved)) == 4
    assert answers_of(loaded) == answers_of(saved)
    assert loaded.digest == hashlib.sha256(path.read_bytes()).hexdigest()


@pytest.mark.parametrize(
    "network",
    [
        NetworkConfig(channels=(2, 3), features=3, hidden=5, cells=3, diffusion=False, encoding="binary"),
        NetworkConfig(channels=(2,), features=2, hidden=2, surrogate="arctan", surrogate_width=0.1, v_th=0.3),
    ],
)
def test_saving_a_loaded_bundle_gives_the_same_bytes_for_every_architecture(network):
    data = make_bundle(network=network).to_bytes()
    assert bundle.from_bytes(data, "x").to_bytes() == data


def test_the_same_seed_gives_the_same_model_and_another_seed_name_or_config_another_one():
    again = make_bundle()
    assert again.digest == ORIGINAL.digest
    assert answers_of(again) == answers_of(ORIGINAL)
    others = [make_bundle(1), bundle.untrained(0, CONFIG, "other"), make_bundle(settle_windows=3)]
    assert len({ORIGINAL.digest, *(other.digest for other in others)}) == 4
    assert answers_of(others[0]) != answers_of(ORIGINAL)


def test_making_an_untrained_model_does_not_change_the_callers_random_numbers():
    torch.manual_seed(5)
    expected = torch.rand(3)
    torch.manual_seed(5)
    make_bundle(9)
    assert torch.equal(torch.rand(3), expected)


@pytest.mark.parametrize("seed", range(3))
def test_an_untrained_model_fires_and_reacts_to_its_input(seed):
    estimator = Estimator(bundle.untrained(seed))
    busy, quiet = make_events(30_000, duration_us=160_000), make_events(4, duration_us=160_000)
    twists = [
        estimator.push(events, estimator.initial_state(SENSOR), 160_000).estimates[-1].twists
        for events in (busy, quiet)
    ]
    assert abs(twists[0] - twists[1]).max() > 0.05


def test_info_gives_the_number_of_parameters_and_whether_the_model_was_trained():
    info = ORIGINAL.info
    assert (info.name, info.digest, info.trained) == ("untrained", ORIGINAL.digest, False)
    stored = safetensors.torch.load(DATA)
    buffers = sum(t.numel() for name, t in stored.items() if "running" in name or name.startswith("output."))
    assert info.parameters == sum(t.numel() for t in stored.values()) - buffers
    assert "seed=0" in info.provenance


@pytest.mark.parametrize("length", [*range(64), *range(64, len(DATA), 97), len(DATA) - 1])
def test_every_truncation_is_refused(length):
    refusal(DATA[:length])


@given(where=st.integers(0, len(DATA) - 1), bit=st.integers(0, 7))
def test_a_flipped_bit_is_refused_or_makes_another_model(where, bit):
    flipped = bytearray(DATA)
    flipped[where] ^= 1 << bit
    assert_refused_or_another_model(bytes(flipped))


@pytest.mark.parametrize("bit", range(8))
def test_a_flipped_bit_of_the_header_is_refused_or_makes_another_model(bit):
    for where in range(0, len(DATA) - len(split_header()[1]), 7):
        flipped = bytearray(DATA)
        flipped[where] ^= 1 << bit
        assert_refused_or_another_model(bytes(flipped))


@given(where=st.integers(0, len(DATA)), junk=st.binary(max_size=40), removed=st.integers(0, 40))
def test_inserted_or_overwritten_bytes_are_refused_or_make_another_model(where, junk, removed):
    data = DATA[:where] + junk + DATA[where + removed :]
    if data != DATA:
        assert_refused_or_another_model(data)


@given(st.binary(max_size=300))
def test_random_bytes_are_refused(data):
    refusal(data)
    refusal(join_header(data))


@pytest.mark.parametrize(
    ("data", "word"),
    [
        (b"", "size=0"),
        (b"\x00" * 7, "size=7"),
        (b"# a text file, not a model\n" * 40, "not a safetensors file"),
        (join_header(b"not json"), "cannot be read"),
        (join_header(b""), "cannot be read"),
        (join_header(b"\xff\xfe\xfd"), "cannot be read"),
        (join_header(b"[" * 100_000), "cannot be read"),
        (join_header(b"[]"), "no 'neurove' entry"),
        (join_header(b"{}"), "no 'neurove' entry"),
        (join_header(b'{"__metadata__": 3}'), "no 'neurove' entry"),
        (join_header(b'{"__metadata__": {"neurove": 3}}'), "no 'neurove' entry"),
        (join_header(b'{"__metadata__": {"neurove": "{"}}'), "cannot be read"),
        (join_header(b'{"__metadata__": {"neurove": "[1]"}}'), "bundle_version=None"),
        (safetensors.torch.save({"weight": torch.zeros(3)}), "no 'neurove' entry"),
        (safetensors.torch.save({"weight": torch.zeros(3)}, {"format": "pt"}), "no 'neurove' entry"),
    ],
    ids=range(15),
)
def test_a_file_of_another_format_is_refused_and_the_message_says_why(data, word):
    assert word in refusal(data)


@pytest.mark.parametrize(
    "length", [0, 1, 7, len(DATA) - 8, len(DATA) - 7, 1 << 20, (1 << 20) + 1, 1 << 40, (1 << 64) - 1]
)
def test_a_wrong_header_length_is_refused(length):
    assert "header" in refusal(struct.pack("<Q", length) + DATA[8:])


def test_a_header_above_its_limit_is_refused_even_if_it_is_complete():
    padding = " " * container.MAX_HEADER_BYTES
    entries, tensors = split_header()
    assert str(container.MAX_HEADER_BYTES) in refusal(join_header((json.dumps(entries) + padding).encode(), tensors))


@pytest.mark.parametrize("version", [0, 2, None, "1", [1], {"a": [[[[[[[1]]]]]]]}])
def test_another_bundle_version_is_refused_with_both_versions(version):
    message = refusal(with_fields(lambda fields: fields.update(bundle_version=version)))
    assert "bundle_version=" in message
    assert "reads version 1" in message


def test_a_header_without_a_version_is_refused():
    assert "bundle_version=None" in refusal(with_fields(lambda fields: fields.pop("bundle_version")))


@pytest.mark.parametrize(
    ("edit", "words"),
    [
        (lambda f: f.update(extra=1), ("extra=1", "not permitted")),
        (lambda f: f.update({"x" * 2_000: "y" * 2_000}), ("xxxx", "yyyy", "not permitted")),
        (lambda f: f["config"].update(speed=2), ("config.speed=2", "not permitted")),
        (lambda f: f["config"]["window"].update(bins=0), ("config.window.bins=0", "greater than or equal to 1")),
        (lambda f: f["config"]["window"].update(bins=3), ("duration_us=10000", "3 equal bins")),
        (lambda f: f["config"]["network"].update(v_th=float("nan")), ("config.network.v_th=nan", "finite")),
        (lambda f: f["config"]["network"].update(channels=[]), ("config.network.channels=", "at least 1")),
        (lambda f: f.pop("name"), ("name=missing", "required")),
        (lambda f: f.update(name="../up"), ("name='../up'", "pattern")),
        (lambda f: f.update(trained="perhaps"), ("trained='perhaps'", "boolean")),
        (lambda f: f.update(provenance="x" * 1001), ("provenance=", "at most 1000")),
        (lambda f: f.update(config=None), ("config=None", "ModelConfig")),
    ],
    ids=range(12),
)
def test_a_wrong_header_field_is_named_with_its_value_and_bound(edit, words):
    message = refusal(with_fields(edit))
    for word in words:
        assert word in message


@pytest.mark.parametrize("depth", [100, 900, 5_000])
@pytest.mark.parametrize("field", ["config", "name", "bundle_version"])
def test_a_deeply_nested_header_is_refused_with_a_short_message(field, depth):
    entries, tensors = split_header()
    fields = json.loads(entries["__metadata__"]["neurove"])
    text = json.dumps({**fields, field: "HERE"}).replace('"HERE"', "[" * depth + "]" * depth)
    entries["__metadata__"]["neurove"] = text
    assert len(refusal(join_header(json.dumps(entries).encode(), tensors))) < 500


@pytest.mark.parametrize("level", ["tensors", "metadata", "own"])
def test_a_duplicate_key_is_refused(level):
    header = DATA[8 : len(DATA) - len(split_header()[1])].decode()
    twice = {
        "tensors": header.replace(',"kappa_logit"', ',"kappa_logit":1,"kappa_logit"', 1),
        "metadata": header.replace('{"neurove":', '{"neurove":"{}","neurove":', 1),
        "own": header.replace('{\\"bundle_version\\":1', '{\\"trained\\":true,\\"bundle_version\\":1', 1),
    }[level]
    assert twice != header
    assert "twice" in refusal(join_header(twice.encode(), split_header()[1]))


@pytest.mark.parametrize("value", [float("nan"), float("inf"), -float("inf")])
@pytest.mark.parametrize("name", ["readout.bias", "output.scale", "blocks.0.norm.running_var", "kappa_logit"])
def test_a_tensor_with_a_value_that_is_not_finite_is_refused_and_named(name, value):
    message = refusal(with_tensors(lambda tensors: tensors[name].view(-1)[-1:].fill_(value)))
    assert name in message
    assert "not finite" in message


@pytest.mark.parametrize("name", sorted(safetensors.torch.load(DATA)))
def test_a_missing_tensor_is_refused_and_named(name):
    message = refusal(with_tensors(lambda tensors: tensors.pop(name)))
    assert f"{name!r} is missing" in message


def test_an_unknown_tensor_is_refused_and_named():
    message = refusal(with_tensors(lambda tensors: tensors.update({"cells.1.w_x": torch.zeros(2)})))
    assert "'cells.1.w_x' is not one of this architecture" in message


def test_more_tensors_than_the_limit_are_refused_before_they_are_read():
    def crowd(entries: dict[str, Any]) -> None:
        entries.update({f"t{i}": 0 for i in range(container.MAX_TENSORS)})

    assert f"at most {container.MAX_TENSORS}" in refusal(with_entries(crowd))


@pytest.mark.parametrize(
    ("tensor", "word"),
    [
        (torch.zeros(11), "(11,)"),
        (torch.zeros(13), "(13,)"),
        (torch.zeros(1, 12), "(1, 12)"),
        (torch.zeros(0), "(0,)"),
        (torch.zeros(12, dtype=torch.float64), "float64"),
        (torch.zeros(12, dtype=torch.float16), "float16"),
        (torch.zeros(12, dtype=torch.int32), "int32"),
        (torch.zeros(12, dtype=torch.bool), "bool"),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_a_tensor_of_another_shape_or_type_is_refused_with_both(tensor, word):
    message = refusal(with_tensors(lambda tensors: tensors.update({"readout.bias": tensor})))
    assert "'readout.bias'" in message
    assert word in message
    assert "needs float32 (12,)" in message


@pytest.mark.parametrize("shape", [[0, 1 << 40, 1 << 40], [0, 1 << 63], [(1 << 64) - 1, 0], [0] * 2_000])
@pytest.mark.parametrize("dtype", ["F32", "F4", "C64"])
def test_a_tensor_without_elements_and_with_huge_sizes_is_refused(shape, dtype):
    refusal(with_entries(lambda entries: entries.update(t={"dtype": dtype, "shape": shape, "data_offsets": [0, 0]})))


def test_an_architecture_that_needs_terabytes_is_refused_before_memory_is_allocated():
    def inflate(fields: dict[str, Any]) -> None:
        fields["config"]["canonical"].update(width=1024, height=1024)
        fields["config"]["network"].update(channels=[1024], features=4096)

    message = refusal(with_fields(inflate))
    assert "its header's architecture needs" in message


def test_a_missing_file_and_a_directory_are_refused_with_the_reason_of_the_system(tmp_path):
    with pytest.raises(BadModel, match=r"gone\.safetensors: No such file"):
        bundle.load(tmp_path / "gone.safetensors")
    (tmp_path / "folder.safetensors").mkdir()
    with pytest.raises(BadModel, match=r"folder\.safetensors: Is a directory"):
        bundle.load(tmp_path / "folder.safetensors")


def test_a_file_above_the_size_limit_is_refused_without_being_read(tmp_path):
    path = tmp_path / "huge.safetensors"
    with path.open("wb") as file:
        file.truncate(bundle.MAX_BYTES + 1)  # sparse: takes no disk space
    with pytest.raises(BadModel, match=rf"size={bundle.MAX_BYTES + 1}.*{bundle.MAX_BYTES} bytes"):
        bundle.load(path)


def test_errors_name_the_file_without_its_folder(tmp_path):
    path = tmp_path / "broken.safetensors"
    path.write_bytes(DATA[:100])
    with pytest.raises(BadModel) as refused:
        bundle.load(path)
    assert str(tmp_path) not in refused.value.message


def test_saving_replaces_the_file_atomically_and_leaves_nothing_else(tmp_path):
    path = tmp_path / "model.safetensors"
    bundle.save(make_bundle(1), path)
    bundle.save(ORIGINAL, path)
    assert path.read_bytes() == DATA
    assert list(tmp_path.iterdir()) == [path]


def test_when_the_disk_is_full_the_old_file_is_intact_and_nothing_else_is_left(tmp_path, monkeypatch):
    path = tmp_path / "model.safetensors"
    bundle.save(ORIGINAL, path)

    def full(_: int) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(OSError, match="No space left"):
        bundle.save(make_bundle(1), path)
    assert path.read_bytes() == DATA
    assert list(tmp_path.iterdir()) == [path]


def test_a_file_that_cannot_be_moved_to_its_place_leaves_nothing(tmp_path: Path):
    path = tmp_path / "model.safetensors"
    path.mkdir()
    with pytest.raises(IsADirectoryError):
        bundle.save(ORIGINAL, path)
    assert list(tmp_path.iterdir()) == [path]
