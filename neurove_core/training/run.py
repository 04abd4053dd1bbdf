"""The state of a training run: network, optimiser, random generator; its checkpoints, and its bundle at the end.

A checkpoint is a safetensors file, so nothing is unpickled. It is written between segments, when no stream carries
state, and it is complete: on the same machine and torch version, a resumed run continues bit for bit. All processes of
a distributed run resume from the same file.
"""

import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Self

import numpy as np
import safetensors
import safetensors.torch
import torch
from pydantic import ValidationError
from torch import Tensor, nn

from neurove_core.config import ModelConfig
from neurove_core.files import write_atomically
from neurove_core.models.bundle import PER_HEIGHT, Bundle
from neurove_core.models.metadata import Metadata
from neurove_core.networks import kinds
from neurove_core.networks.kinds import Network
from neurove_core.networks.neurove import NeuroVE
from neurove_core.training.config import RecipeConfig, TrainingConfig
from neurove_core.training.data import Sequences
from neurove_core.training.growing import grown, narrowed
from neurove_core.training.loss import Balance
from neurove_core.training.ranks import ALONE, Ranks, share_norms
from neurove_protocol.errors import BadModel, InvalidField
from neurove_protocol.fields import WrongField

_KEY = "neurove_run"
_SYMMETRIC = [0, 4, 5]  # vx wy wz: their mean is 0, because half of the segments are mirrored


@dataclass
class TrainingRun:
    """Everything that a run carries from one segment to the next."""

    config: TrainingConfig
    network: Network
    optimiser: torch.optim.Adam
    offset: Tensor  # (6): twist = network output * scale + offset
    scale: Tensor  # (6)
    rng: np.random.Generator
    balance: Balance = field(default_factory=Balance.initial)
    ranks: Ranks = ALONE
    step: int = 0
    cpu_s: float = 0.0
    curve: list[dict[str, float]] = field(default_factory=list)
    validation: list[dict[str, float]] = field(default_factory=list)  # see `validation.Point`
    best: dict[str, Tensor] = field(default_factory=dict)  # weights of the best validation; empty without one
    start: str = ""  # digest of the bundle that it began from, hex; empty if the seed initialised the weights

    @classmethod
    def begin(
        cls, config: TrainingConfig, sequences: Sequences, ranks: Ranks = ALONE, start: Bundle | None = None
    ) -> Self:
        """Create a run at its first update; the seed gives the weights and, for each rank, its own order of segments.

        Args:
            config: of the run.
            sequences: training sequences.
            ranks: this process and its group.
            start: model whose weights, norms and output scaling the run begins from, instead of the seed's weights.

        Raises:
            InvalidField: the batch does not split evenly, or no sequence has a truth of one of the two velocities.
            BadModel: the network of `start` differs from that of the configuration; see `check_start`.
        """
        if start is not None:
            check_start(start, config)
        scaling = output_scaling(sequences) if start is None else (start.offset, start.scale)
        scaling = ranks.gather(scaling)[0]  # the sequences of another machine may differ in their last bits
        offset, scale = (one.to(ranks.device, copy=True) for one in scaling)
        network, optimiser = _network(config, ranks)
        if start is not None:
            _copy_weights(network, start)
        run = cls(config, network, optimiser, offset, scale, _order(config, ranks), _balance(ranks), ranks)
        run.start = "" if start is None else start.digest
        return run

    @property
    def rank_recipe(self) -> RecipeConfig:
        """The recipe with the part of the batch of this rank."""
        batch = self.config.recipe.batch // self.ranks.count
        return self.config.recipe.model_copy(update={"batch": batch})

    def bundle(self, provenance: str, metadata: Metadata | None = None, *, best: bool = False) -> Bundle:
        """Return the current model as a bundle, or that of the best validation."""
        network = kinds.make(self.config.model)
        network.load_state_dict(self.best if best else self.network.state_dict())
        return Bundle(
            name=self.config.name,
            trained=True,
            provenance=provenance,
            config=self.config.model,
            network=network.eval(),
            offset=self.offset.cpu(),
            scale=self.scale.cpu(),
            linear_unit=PER_HEIGHT,
            metadata=metadata or Metadata(),
        ).with_digest()

    def save(self, path: Path, orders: list[Any]) -> None:
        """Write a checkpoint atomically; the previous one stays until then.

        Args:
            path: of the file.
            orders: `rng_state` of each rank.
        """
        tensors = {f"network.{name}": tensor.contiguous() for name, tensor in self.network.state_dict().items()}
        for index, parameter in enumerate(self.network.parameters()):
            for name, value in self.optimiser.state.get(parameter, {}).items():
                tensors[f"adam.{index}.{name}"] = value
        tensors |= {"offset": self.offset, "scale": self.scale, "balance": torch.stack(list(self.balance))}
        metadata = {"config": self.config.model_dump(mode="json"), "step": self.step, "cpu_s": self.cpu_s}
        tensors |= {f"best.{name}": tensor.contiguous() for name, tensor in self.best.items()}
        metadata |= {"orders": orders, "curve": self.curve, "validation": self.validation, "start": self.start}
        stored = {name: tensor.cpu() for name, tensor in tensors.items()}
        write_atomically(path, safetensors.torch.save(stored, {_KEY: json.dumps(metadata)}))

    @property
    def rng_state(self) -> Any:
        """State of the generator that draws the segments of this rank."""
        return self.rng.bit_generator.state

    @classmethod
    def restore(cls, path: Path, config: TrainingConfig, ranks: Ranks = ALONE) -> Self:
        """Restore the run of a rank from a checkpoint.

        Raises:
            BadModel: the checkpoint is missing or broken, or it has another configuration or number of devices.
        """
        try:
            with safetensors.safe_open(path, "pt") as file:
                metadata = json.loads(file.metadata()[_KEY])
                tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 (no mapping)
        except (OSError, KeyError, TypeError, ValueError, safetensors.SafetensorError) as error:
            raise BadModel(path.name, f"not a usable checkpoint: {error}") from None
        _same_config(path, metadata["config"], config)
        orders = (
            metadata["orders"] if "orders" in metadata else [metadata.get("rng")]
        )  # checkpoints from before `--devices` have one
        if len(orders) != ranks.count:
            raise BadModel(
                path.name,
                f"it began with devices={len(orders)} and needs the same number to continue, not {ranks.count}",
            )
        network, optimiser = _network(config, ranks)
        try:
            network.load_state_dict({n[8:]: tensor for n, tensor in tensors.items() if n.startswith("network.")})
            _restore_optimiser(optimiser, list(network.parameters()), tensors)
            offset, scale, balance = (tensors[name].to(ranks.device) for name in ("offset", "scale", "balance"))
            run = cls(config, network, optimiser, offset, scale, np.random.default_rng())
            run.balance, run.ranks = Balance(*balance.unbind()), ranks
            run.step, run.cpu_s, run.curve = int(metadata["step"]), float(metadata["cpu_s"]), list(metadata["curve"])
            run.validation = list(metadata.get("validation", []))
            run.best = {n[5:]: tensor.to(ranks.device) for n, tensor in tensors.items() if n.startswith("best.")}
            run.start = str(metadata.get("start", ""))  # older checkpoints began from weights of the seed
            run.rng.bit_generator.state = orders[ranks.rank]
        except (KeyError, TypeError, ValueError, RuntimeError) as error:
            raise BadModel(path.name, f"the checkpoint does not contain this run: {error}") from None
        return run


def checkpoint_step(path: Path) -> int:
    """The update of a checkpoint; -1 without one.

    Raises:
        BadModel: the file is broken.
    """
    if not path.exists():
        return -1
    try:
        with safetensors.safe_open(path, "pt") as file:
            return int(json.loads(file.metadata()[_KEY])["step"])
    except (OSError, KeyError, TypeError, ValueError, safetensors.SafetensorError) as error:
        raise BadModel(path.name, f"not a usable checkpoint: {error}") from None


def output_scaling(sequences: Sequences) -> tuple[Tensor, Tensor]:
    """Compute offset and scale (6) of a network's outputs: the mean of the truth, and one spread per group of three.

    Raises:
        InvalidField: no sequence has a truth of the linear velocity, or none has one of the angular velocity.
    """
    twists = np.concatenate([twist.reshape(-1, 6) for twist in sequences.twists]).astype(np.float64)
    known = np.isfinite(twists)
    for group, start in (("linear", 0), ("angular", 3)):
        if not known[:, start : start + 3].any():
            why = (
                f"none of them has a truth of the {group} velocity; add recordings or simulated sequences that have it"
            )
            raise InvalidField("training", "data.recordings", len(sequences), why)
    offset = np.where(known, twists, 0).sum(0) / np.maximum(known.sum(0), 1)
    offset[_SYMMETRIC] = 0
    squares = np.where(known, (twists - offset) ** 2, 0).reshape(-1, 2, 3).sum((0, 2))
    groups = np.sqrt(squares / known.reshape(-1, 2, 3).sum((0, 2)))
    return torch.tensor(offset, dtype=torch.float32), torch.tensor(np.repeat(groups, 3), dtype=torch.float32)


def _order(config: TrainingConfig, ranks: Ranks) -> np.random.Generator:
    """The generator of the segments of a rank; each rank has its own, so that their segments differ."""
    return np.random.default_rng((config.recipe.seed, 202, ranks.rank) if ranks.rank else (config.recipe.seed, 202))


def _balance(ranks: Ranks) -> Balance:
    return Balance(*(mean.to(ranks.device) for mean in Balance.initial()))


def check_split(config: TrainingConfig, devices: int) -> None:
    """Check that the batch splits over a number of devices.

    Raises:
        InvalidField: it does not.
    """
    if devices < 1 or config.recipe.batch % devices:
        bound = f"recipe.batch={config.recipe.batch} does not split into this many equal parts"
        raise InvalidField("training", "devices", devices, bound)


def _network(config: TrainingConfig, ranks: Ranks) -> tuple[Network, torch.optim.Adam]:
    check_split(config, ranks.count)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(config.recipe.seed)
        network = kinds.make(config.model)
    for norm in network.modules():
        if isinstance(norm, nn.BatchNorm1d | nn.BatchNorm2d):
            norm.momentum = config.recipe.norm_momentum
    if ranks.count > 1:
        share_norms(network, ranks)
    network = network.to(ranks.device).train()
    # on the CPU the fused form takes a quarter of the time, because it passes over the weights once
    fused = torch.device(ranks.device).type == "cpu"
    return network, torch.optim.Adam(network.parameters(), lr=config.recipe.learning_rate, fused=fused)


def check_start(start: Bundle, config: TrainingConfig) -> None:
    """Refuse a start model whose weights do not fit the network of the configuration.

    The surrogate gradient and the precision of the weights may differ, because they do not change the weights' meaning.
    A NeuroVE may begin from a smaller one; see `growing.narrowed`.

    Raises:
        BadModel: a field differs; the error has both values.
    """
    if start.linear_unit != PER_HEIGHT:
        raise BadModel(start.name, f"linear_unit={start.linear_unit!r}: training can start only from {PER_HEIGHT!r}")
    check_same_network(start, narrowed(config.model, start.config))


def check_same_network(model: Bundle, config: ModelConfig) -> None:
    """Refuse a model whose weights do not fit a network of this configuration.

    Raises:
        BadModel: a field differs; the error has both values.
    """
    had, wanted = _shape(model.config), _shape(config)
    for name, value in wanted.items():
        if had[name] != value:
            raise BadModel(model.name, f"it has {name}={had[name]}, the configuration has {value}")


def _copy_weights(network: Network, start: Bundle) -> None:
    """Copy the weights and norms of a model into a network, without its uncertainty, which is fitted again later."""
    weights = {name: one for name, one in start.network.state_dict().items() if not name.startswith("spread.")}
    if isinstance(network, NeuroVE):
        weights = grown(weights, start.config, network)
    network.load_state_dict(weights)


def _shape(config: ModelConfig) -> dict[str, Any]:
    """Fields of a configuration that must be equal for the weights of two models to be comparable."""
    free = {"surrogate", "surrogate_width", "precision"}
    parts = {"window": config.window, "canonical": config.canonical, "network": config.network}
    found = {f"{part}.{name}": value for part, model in parts.items() for name, value in model if name not in free}
    return {"kind": config.kind} | found


def _restore_optimiser(optimiser: torch.optim.Adam, parameters: list[Any], tensors: dict[str, Tensor]) -> None:
    for index, parameter in enumerate(parameters):
        prefix = f"adam.{index}."
        state = {name[len(prefix) :]: tensor for name, tensor in tensors.items() if name.startswith(prefix)}
        if state:  # Adam keeps its step count on the CPU
            optimiser.state[parameter] = {n: one if n == "step" else one.to(parameter) for n, one in state.items()}


def _same_config(path: Path, began: dict[str, Any], config: TrainingConfig) -> None:
    """Refuse to continue a run with another configuration than it began with.

    A setting that did not exist when the run began counts as its default. More cycles are allowed: the run gets longer.
    """
    try:
        found = TrainingConfig.model_validate(began).model_dump(mode="json")
    except ValidationError as error:
        why = f"it began with an invalid configuration: {WrongField.of(error).sentence}"
        raise BadModel(path.name, why) from None
    for part, fields in config.model_dump(mode="json").items():
        for name, value in fields.items() if isinstance(fields, dict) else ((part, fields),):
            was = found[part][name] if isinstance(fields, dict) else found[part]
            longer = (part, name) == ("recipe", "cycles") and value > was
            if was != value and not longer:
                why = f"it began with {part}.{name}={was}, the configuration has {value}"
                raise BadModel(path.name, why)
