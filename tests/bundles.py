"""A small bundle, and helpers that split, edit and join its bytes."""

import copy
import json
import struct
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import safetensors.torch
import torch

from neurove_core import self_test
from neurove_core.config import CanonicalConfig, ModelConfig, NetworkConfig, WindowConfig
from neurove_core.estimator import Estimator
from neurove_core.models import bundle
from neurove_core.models.bundle import Bundle
from neurove_core.models.uncertainty import Uncertainty
from neurove_core.networks.neurove import NeuroVE
from neurove_protocol.errors import BadModel

CONFIG = ModelConfig(
    window=WindowConfig(duration_us=10_000, bins=2),
    canonical=CanonicalConfig(width=10, height=8),
    network=NetworkConfig(channels=(3,), features=4, hidden=4, cells=1),
)


def make_bundle(seed: int = 0, **config: Any) -> Bundle:
    return bundle.untrained(seed, CONFIG.model_copy(update=config))


def proven(model: Bundle) -> Bundle:
    """The model as a trained one with a golden test and a calibration, so that others may be judged by it."""
    network, config = copy.deepcopy(model.network), model.config
    assert isinstance(network, NeuroVE)
    network.add_spread()
    calibrated = replace(
        model, network=network, trained=True, uncertainty=Uncertainty(torch.eye(6), uncertain_above=1e9, provenance="x")
    )
    shape = (2, 2 * config.window.bins, config.canonical.height, config.canonical.width)
    counts = np.random.default_rng(0).poisson(0.3, shape).astype(np.uint8)
    return replace(calibrated, golden=self_test.record(Estimator(calibrated), counts)).with_digest()


ORIGINAL = make_bundle()
DATA = ORIGINAL.to_bytes()


def join_header(header: bytes, data: bytes = b"") -> bytes:
    """The bytes of a safetensors file with this header and this tensor data."""
    return struct.pack("<Q", len(header)) + header + data


def split_header(data: bytes = DATA) -> tuple[dict[str, Any], bytes]:
    """The header and the tensor data of a safetensors file."""
    (length,) = struct.unpack("<Q", data[:8])
    return json.loads(data[8 : 8 + length]), data[8 + length :]


def with_entries(edit: Callable[[dict[str, Any]], object], data: bytes = DATA) -> bytes:
    """The bundle's bytes with its safetensors header edited."""
    entries, tensors = split_header(data)
    edit(entries)
    return join_header(json.dumps(entries).encode(), tensors)


def with_fields(edit: Callable[[dict[str, Any]], object], data: bytes = DATA) -> bytes:
    """The bundle's bytes with its own header, inside that of safetensors, edited."""
    entries, tensors = split_header(data)
    fields = json.loads(entries["__metadata__"]["neurove"])
    edit(fields)
    entries["__metadata__"]["neurove"] = json.dumps(fields)
    return join_header(json.dumps(entries).encode(), tensors)


def with_tensors(edit: Callable[[dict[str, torch.Tensor]], object], data: bytes = DATA) -> bytes:
    """The bundle's bytes with its tensors edited."""
    tensors = safetensors.torch.load(data)
    edit(tensors)
    return safetensors.torch.save(tensors, split_header(data)[0]["__metadata__"])


def refusal(data: bytes) -> str:
    """The message that refuses these bytes."""
    with pytest.raises(BadModel) as refused:
        bundle.from_bytes(data, "some.safetensors")
    assert refused.value.code == "bad_model"
    assert refused.value.message.startswith("model some.safetensors: ")
    return refused.value.message
