"""A training run: network, optimiser and all else that the next update depends on; checkpoints; the bundle at the end.

A checkpoint is a safetensors file, so nothing is unpickled. It is written between segments, when no stream carries
state, and holds everything: a run that goes on from one continues bit for bit, on one machine and torch version.
"""

import json
import os
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Self

import numpy as np
import safetensors
import safetensors.torch
import torch
from torch import Tensor, nn

from neurove_core import networks
from neurove_core.bundle import PER_HEIGHT, Bundle
from neurove_core.loss import Balance
from neurove_core.networks import Network
from neurove_core.training.config import TrainingConfig
from neurove_core.training.data import Sequences
from protocol.errors import BadModel

_KEY = "neurove_run"
_SYMMETRIC = [0, 4, 5]  # vx wy wz: as often to one side as to the other, for half of what is seen is mirrored


@dataclass
class Run:
    """All that a run carries from one segment to the next."""

    config: TrainingConfig
    network: Network
    optimiser: torch.optim.Adam
    offset: Tensor  # (6): twist = network output * scale + offset
    scale: Tensor  # (6)
    rng: np.random.Generator
    balance: Balance = field(default_factory=Balance.initial)
    step: int = 0
    cpu_s: float = 0.0
    curve: list[dict[str, float]] = field(default_factory=list)

    @classmethod
    def begin(cls, config: TrainingConfig, sequences: Sequences) -> Self:
        """A run at its first step; weights and order are drawn from the recipe's seed."""
        offset, scale = output_scaling(sequences)
        return cls(config, *_network(config), offset, scale, np.random.default_rng((config.recipe.seed, 202)))

    def bundle(self, provenance: str) -> Bundle:
        """The model as it is now."""
        network = networks.make(self.config.model)
        network.load_state_dict(self.network.state_dict())
        return Bundle(
            name=self.config.name,
            trained=True,
            provenance=provenance,
            config=self.config.model,
            network=network.eval(),
            offset=self.offset,
            scale=self.scale,
            linear_unit=PER_HEIGHT,
        ).with_digest()

    def save(self, path: Path) -> None:
        """Write a checkpoint; it is whole or it is not there, and the one before stays until it is."""
        tensors = {f"network.{name}": tensor.contiguous() for name, tensor in self.network.state_dict().items()}
        for index, parameter in enumerate(self.network.parameters()):
            for name, value in self.optimiser.state.get(parameter, {}).items():
                tensors[f"adam.{index}.{name}"] = value
        tensors |= {"offset": self.offset, "scale": self.scale, "balance": torch.stack(list(self.balance))}
        about = {"config": self.config.model_dump(mode="json"), "step": self.step, "cpu_s": self.cpu_s}
        about |= {"rng": self.rng.bit_generator.state, "curve": self.curve}
        write_whole(path, safetensors.torch.save(tensors, {_KEY: json.dumps(about)}))

    @classmethod
    def restore(cls, path: Path, config: TrainingConfig) -> Self:
        """The run that a checkpoint holds.

        Raises:
            BadModel: it is missing, broken, or of another configuration.
        """
        try:
            with safetensors.safe_open(path, "pt") as file:
                about = json.loads(file.metadata()[_KEY])
                tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 (no mapping)
        except (OSError, KeyError, TypeError, ValueError, safetensors.SafetensorError) as error:
            raise BadModel(path.name, f"no checkpoint to go on from: {error}") from None
        _same_config(path, about["config"], config.model_dump(mode="json"))
        network, optimiser = _network(config)
        try:
            network.load_state_dict({n[8:]: tensor for n, tensor in tensors.items() if n.startswith("network.")})
            _restore_optimiser(optimiser, list(network.parameters()), tensors)
            balance = Balance(*tensors["balance"].unbind())
            run = cls(config, network, optimiser, tensors["offset"], tensors["scale"], np.random.default_rng(), balance)
            run.step, run.cpu_s, run.curve = int(about["step"]), float(about["cpu_s"]), list(about["curve"])
            run.rng.bit_generator.state = about["rng"]
        except (KeyError, TypeError, ValueError, RuntimeError) as error:
            raise BadModel(path.name, f"a checkpoint that does not hold this run: {error}") from None
        return run


def output_scaling(sequences: Sequences) -> tuple[Tensor, Tensor]:
    """Offset and scale (6) of a network's outputs: mean of the truth, one spread for each group of three."""
    twists = np.concatenate([twist.reshape(-1, 6) for twist in sequences.twists]).astype(np.float64)
    offset = twists.mean(0)
    offset[_SYMMETRIC] = 0
    groups = np.sqrt(((twists - offset) ** 2).reshape(-1, 2, 3).mean((0, 2)))
    return torch.tensor(offset, dtype=torch.float32), torch.tensor(np.repeat(groups, 3), dtype=torch.float32)


def write_whole(path: Path, data: bytes) -> None:
    """Write a file so that it is whole or what it was before."""
    part = path.with_name(path.name + ".part")
    try:
        with part.open("wb") as file:
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
        part.replace(path)
    finally:
        part.unlink(missing_ok=True)


def _network(config: TrainingConfig) -> tuple[Network, torch.optim.Adam]:
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(config.recipe.seed)
        network = networks.make(config.model)
    for norm in network.modules():
        if isinstance(norm, nn.BatchNorm1d | nn.BatchNorm2d):
            norm.momentum = config.recipe.norm_momentum
    return network.train(), torch.optim.Adam(network.parameters(), lr=config.recipe.learning_rate)


def _restore_optimiser(optimiser: torch.optim.Adam, parameters: list[Any], tensors: dict[str, Tensor]) -> None:
    for index, parameter in enumerate(parameters):
        prefix = f"adam.{index}."
        state = {name[len(prefix) :]: tensor for name, tensor in tensors.items() if name.startswith(prefix)}
        if state:
            optimiser.state[parameter] = state


def _same_config(path: Path, found: dict[str, Any], wanted: dict[str, Any]) -> None:
    """Refuse to go on with another recipe than the run began with: its curve would belong to neither."""
    for part, fields in wanted.items():
        for name, value in fields.items() if isinstance(fields, dict) else ((part, fields),):
            was = found.get(part, {}).get(name) if isinstance(fields, dict) else found.get(part)
            if was != value:
                why = f"it began with {part}.{name}={was}, the configuration says {value}"
                raise BadModel(path.name, why)
