"""The container of a bundle is read like safetensors reads it, or refused."""

import json
import subprocess
import sys

import pytest
import safetensors.torch
import torch
from hypothesis import given
from hypothesis import strategies as st

from neurove_core.files import read_whole
from neurove_core.models.container import read_tensors
from neurove_protocol.errors import BadModel
from tests.bundles import DATA, join_header, split_header

ENTRY = {"dtype": "F32", "shape": [2], "data_offsets": [0, 8]}


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64, torch.float16, torch.int64, torch.uint8, torch.bool])
def test_tensors_are_those_that_safetensors_reads(dtype: torch.dtype) -> None:
    given = {"b": torch.arange(6).reshape(2, 3).to(dtype), "a": torch.ones(()).to(dtype), "none": torch.zeros(0, 4)}
    data = safetensors.torch.save(given)
    found, expected = read_tensors(data, "x"), safetensors.torch.load(data)
    assert found.keys() == expected.keys()
    for name, tensor in expected.items():
        array = torch.from_numpy(found[name])
        assert (array.dtype, array.shape) == (tensor.dtype, tensor.shape)
        assert torch.equal(array, tensor)


@pytest.mark.parametrize(
    ("entries", "words"),
    [
        ({"t": ENTRY | {"dtype": "F8_E4M3"}}, "dtype='F8_E4M3': known are F64"),
        ({"t": ENTRY | {"dtype": 3}}, "dtype=3"),
        ({"t": ENTRY | {"shape": [3]}}, "has 8 bytes, its shape needs 12"),
        ({"t": ENTRY | {"shape": [2.0]}}, "shape=[2.0]: not a list of sizes"),
        ({"t": ENTRY | {"shape": [True, 2]}}, "not a list of sizes"),
        ({"t": ENTRY | {"shape": [1 << 60, 0]}}, "not a list of sizes"),
        ({"t": ENTRY | {"shape": [1] * 9 + [2]}}, "not a list of sizes"),
        ({"t": ENTRY | {"shape": [1 << 30, 1 << 30, 0]}}, "not a list of sizes"),
        ({"t": ENTRY | {"data_offsets": [0, 8, 9]}}, "not two bytes of the file"),
        ({"t": ENTRY | {"data_offsets": [8, 0]}}, "has -8 bytes"),
        ({"t": ENTRY | {"data_offsets": [4, 12]}}, "begins at byte 4, expected 0"),
        ({"t": ENTRY | {"extra": 1}}, "must have dtype, shape and data_offsets"),
        ({"t": 3}, "must have dtype, shape and data_offsets"),
        ({"t": ENTRY, "u": ENTRY}, "begins at byte 0, expected 8"),
        ({"t": ENTRY, "u": ENTRY | {"data_offsets": [8, 16]}}, "incomplete: tensor 'u' ends at byte"),
        ({}, "its tensors end at byte"),
    ],
)
def test_a_header_that_does_not_match_the_bytes_is_refused_with_the_reason(entries: object, words: str) -> None:
    data = join_header(json.dumps(entries).encode(), bytes(8))
    with pytest.raises(BadModel) as refused:
        read_tensors(data, "x")
    assert words in refused.value.message


@given(where=st.integers(0, len(DATA) - 1), bit=st.integers(0, 7))
def test_whatever_is_accepted_safetensors_accepts_too(where: int, bit: int) -> None:
    flipped = bytearray(DATA)
    flipped[where] ^= 1 << bit
    try:
        found = read_tensors(bytes(flipped), "x")
    except BadModel:
        return
    expected = safetensors.torch.load(bytes(flipped))
    assert {name: array.tobytes() for name, array in found.items()} == {
        name: tensor.numpy().tobytes() for name, tensor in expected.items()
    }


def test_tensors_of_writable_bytes_are_views(tmp_path) -> None:
    (tmp_path / "x").write_bytes(DATA)
    data = read_whole(tmp_path / "x")
    entries, _ = split_header()
    name = next(one for one in entries if one != "__metadata__" and entries[one]["dtype"] == "F32")
    tensors = read_tensors(data, "x")
    data[:] = bytes(len(data))
    assert not tensors[name].any()


def test_a_bundle_is_loaded_without_the_modules_that_compile_torch_programs() -> None:
    program = "import sys; from neurove_core import models; models.find('default'); print('sympy' in sys.modules)"
    out = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True).stdout
    assert out.strip() == "False"
