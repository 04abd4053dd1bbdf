"""Bundles for the long runs: good signed ones, and each kind of bad one with the reason of its refusal."""

import json
import struct
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import safetensors.torch
import torch

from neurove_core.config import CanonicalConfig, ModelConfig, NetworkConfig, WindowConfig
from neurove_core.models import bundle, manifest, signing_keys
from neurove_core.models.bundle import Bundle
from neurove_core.models.metadata import Metadata
from neurove_core.networks.neurove import NeuroVE

WINDOW_US = 20_000
CONFIG = ModelConfig(
    window=WindowConfig(duration_us=WINDOW_US, bins=5),
    canonical=CanonicalConfig(width=44, height=33),
    network=NetworkConfig(channels=(8, 16), features=512, hidden=32),
)
"""Fast to run, because four streams share two cores with their driver; 4 MiB, so that a leaked copy is visible."""

GOOD = ("one", "two")
_RELEASE = 2


class Made:
    """A folder of models and the key that a node trusts.

    Args:
        folder: for the bundles and the public key.
    """

    def __init__(self, folder: Path) -> None:
        self.folder, self.trusted = folder, folder / "release.pub"
        self._key, self._stranger = signing_keys.new(), signing_keys.new()
        self.trusted.write_bytes(signing_keys.public_pem(self._key.public_key()))
        for seed, name in enumerate(GOOD, 1):
            self._write(name, _released(bundle.untrained(seed, CONFIG, name), _RELEASE).to_bytes())
        good = (folder / f"{GOOD[0]}.safetensors").read_bytes()
        self.model_bytes = len(good)
        for name, spoil in _SPOILT.items():
            self._write(name, spoil(good), signed=False)
        with (folder / "too-large.safetensors").open("wb") as file:
            file.truncate(bundle.MAX_BYTES + 1)
        self._write("too-slow", _slow().to_bytes())
        self._write("old-counter", _released(bundle.untrained(3, CONFIG, "old-counter"), _RELEASE - 1).to_bytes())
        other = _released(bundle.untrained(4, CONFIG, "bad-signature"), _RELEASE).to_bytes()
        self._write("bad-signature", other, key=self._stranger)
        self.bad = (*_SPOILT, "bad-signature", "old-counter", "too-slow", "too-large")

    def _write(self, name: str, data: bytes, *, signed: bool = True, key: object = None) -> None:
        path = self.folder / f"{name}.safetensors"
        path.write_bytes(data)
        if signed:
            path.with_name(path.name + manifest.SUFFIX).write_bytes(manifest.sign(data, key or self._key))  # type: ignore[arg-type]


def _released(model: Bundle, release: int) -> Bundle:
    """As a trained model: a node that trusts keys takes no other."""
    return replace(model, trained=True, metadata=Metadata(release=release))


def _tensors(change: Callable[[dict[str, torch.Tensor], str], None]) -> Callable[[bytes], bytes]:
    def spoil(good: bytes) -> bytes:
        tensors = safetensors.torch.load(good)
        change(tensors, max(tensors, key=lambda name: tensors[name].numel()))
        (length,) = struct.unpack("<Q", good[:8])
        return safetensors.torch.save(tensors, json.loads(good[8 : 8 + length])["__metadata__"])

    return spoil


def _reshape(tensors: dict[str, torch.Tensor], name: str) -> None:
    tensors[name] = tensors[name].flatten().clone()


def _retype(tensors: dict[str, torch.Tensor], name: str) -> None:
    tensors[name] = tensors[name].double()


def _fill_nan(tensors: dict[str, torch.Tensor], name: str) -> None:
    tensors[name] = tensors[name].fill_(float("nan"))


def _flipped(good: bytes) -> bytes:
    (length,) = struct.unpack("<Q", good[:8])
    place = good.index(b'"F32"', 8, 8 + length) + 1
    return good[:place] + bytes([good[place] ^ 1]) + good[place + 1 :]


def _doubled(good: bytes) -> bytes:
    (length,) = struct.unpack("<Q", good[:8])
    header = good[8 : 8 + length].rstrip()
    header = b'{"__metadata__":{"neurove":"{}"},' + header[1:]
    header += b" " * (-len(header) % 8)
    return struct.pack("<Q", len(header)) + header + good[8 + length :]


def _slow() -> Bundle:
    config = CONFIG.model_copy(
        update={
            "canonical": CanonicalConfig(width=1024, height=512),
            "network": NetworkConfig(channels=(64, 64), features=4, hidden=8),
        }
    )
    zeros, ones = torch.zeros(6), torch.ones(6)
    about = Metadata(release=_RELEASE)
    return Bundle("too-slow", True, "a test", config, NeuroVE(config).eval(), zeros, ones, metadata=about)


_SPOILT: dict[str, Callable[[bytes], bytes]] = {
    "truncated": lambda good: good[: len(good) // 2],
    "flipped-bit": _flipped,
    "wrong-shape": _tensors(_reshape),
    "wrong-dtype": _tensors(_retype),
    "nan": _tensors(_fill_nan),
    "duplicate-keys": _doubled,
    "foreign": lambda _: b"PNG, or anything else that is not a model" * 100,
    "empty": lambda _: b"",
}

REASONS = {
    "truncated": ("bad_model", "incomplete"),
    "flipped-bit": ("bad_model", "dtype="),
    "wrong-shape": ("bad_model", "needs torch.float32 ("),
    "wrong-dtype": ("bad_model", "torch.float64"),
    "nan": ("bad_model", "not finite"),
    "duplicate-keys": ("bad_model", "occurs twice"),
    "foreign": ("bad_model", "not a safetensors file"),
    "empty": ("bad_model", "size=0"),
    "bad-signature": ("untrusted", "not trusted"),
    "old-counter": ("downgrade", "release=1"),
    "too-slow": ("too_slow", "may take at most"),
    "too-large": ("bad_model", "has at most"),
}
"""Code of the error that refuses each, and words of its message."""
