"""Benchmarks of one window through the network, one training step, and many streams on one core."""

import copy
from collections.abc import Callable
from typing import Final, cast

import torch
from torch import Tensor

from neurove_core.bench import Row, interleaved, machine, peers, rows
from neurove_core.config import CanonicalConfig, ModelConfig, NetworkConfig, WindowConfig
from neurove_core.engine.engine import Engine
from neurove_core.models import bundle
from neurove_core.networks import quantisation
from neurove_core.networks.neurove import NetworkState, NeuroVE
from neurove_core.spiking.plain import plain

REFERENCE = ModelConfig(
    window=WindowConfig(bins=10),
    canonical=CanonicalConfig(width=173, height=130),
    network=NetworkConfig(channels=(32, 64, 128, 256), features=256, hidden=256),
)
"""The network on which the peers were measured: 1.9 GFLOP per window at T = 8, a DAVIS346 at half its size."""

SHIPPED = ModelConfig()

_CPU: Final = torch.device("cpu")

AT_PEAK: Final = "all its products at the matrix peak"
"""Label of the limit: the time of all products of a window at the float32 peak of this machine, and nothing else."""

TINY = ModelConfig(canonical=CanonicalConfig(width=24, height=16), network=NetworkConfig(channels=(4, 8), features=16))
"""For --quick, which tests that everything runs and that the results are equal."""


def window(rounds: int, missing: peers.Missing, *, quick: bool, with_peers: bool) -> list[Row]:
    """Latency of a window: the reference network at T = 8, and the shipped network at T = 1, as the service runs it."""
    shapes = {"tiny, T=3": (TINY, 3)} if quick else {"reference, T=8": (REFERENCE, 8), "shipped, T=1": (SHIPPED, 1)}
    found: list[Row] = []
    for name, (config, steps) in shapes.items():
        found += _windows(name, config, steps, rounds, missing, with_peers=with_peers)
        found += _windows(
            f"{name}, int8", with_precision(config, "int8"), steps, rounds, missing, with_peers=with_peers
        )
    return found


def with_precision(config: ModelConfig, precision: str) -> ModelConfig:
    """The same network with its extractor and projection in float32 or int8."""
    return config.model_copy(update={"network": config.network.model_copy(update={"precision": precision})})


def _windows(
    name: str, config: ModelConfig, steps: int, rounds: int, missing: peers.Missing, *, with_peers: bool
) -> list[Row]:
    """Rows of one network. If ours runs in int8, the peers run in float32, and only our own results are compared."""
    network = untrained(config)
    quantised = config.network.precision == "int8"
    in_float32 = untrained(with_precision(config, "float32")) if quantised else network
    spikes, initial = random_input(config, steps), network.initial_state(1)
    given = quantisation.codes(spikes).contiguous() if quantised else spikes  # in the memory layout of the encoding
    engine = Engine(network)
    others = peers.networks(in_float32, missing) if with_peers else {}
    runs: dict[str, Callable[[], object]] = {"ours": lambda: engine(given, initial)}
    for peer, theirs in {"PyTorch, plain": network, **others}.items():
        runs[peer] = _plainly(theirs, spikes, initial)
    with torch.inference_mode():
        fired = engine.features(spikes, initial)[0]
        equal: dict[str, bool | None] = {"PyTorch, plain": _agree(engine, network, spikes, initial)}
        with plain():
            for peer, theirs in others.items():
                fires_alike = bool(torch.equal(peers.features(theirs, spikes), fired))
                equal[peer] = None if quantised or peer in peers.DIFFERENT_BY_DESIGN else fires_alike
        if quantised:
            wide = Engine(in_float32)
            runs["ours, float32"], equal["ours, float32"] = lambda: wide(spikes, initial), None
        times = interleaved({**runs, "peak": machine.peak()}, rounds)
    if not quantised:  # int8 has no such limit: it skips most products when few neurons fire
        times[AT_PEAK] = times["peak"] * steps * machine.flops(config) / machine.PEAK_FLOPS
        equal[AT_PEAK] = None
    return rows(f"window {name}", times, equal)


def train(rounds: int, missing: peers.Missing, *, quick: bool, with_peers: bool) -> list[Row]:
    """A training step at batch 4, forward, backward and Adam: the reference network at T = 8, the shipped at T = 16."""
    shapes = {"tiny, T=3": (TINY, 3)} if quick else {"reference, T=8": (REFERENCE, 8), "shipped, T=16": (SHIPPED, 16)}
    found: list[Row] = []
    for name, (config, steps) in shapes.items():
        network = untrained(config).requires_grad_().train()
        spikes = random_input(config, steps, batch=4)
        others = peers.networks(network, missing) if with_peers else {}
        ours = TrainingStep(network, spikes)
        runs: dict[str, Callable[[], object]] = {"ours": ours}
        steps_of = {
            peer: TrainingStep(theirs, spikes) for peer, theirs in {"PyTorch, plain": network, **others}.items()
        }
        losses = {}
        for peer, step in steps_of.items():
            with plain():
                losses[peer] = step.loss()
            runs[peer] = _inside_plain(step)
        loss = ours.loss()
        equal: dict[str, bool | None] = {
            peer: None if peer in peers.DIFFERENT_BY_DESIGN else _same_loss(peer, value / loss - 1)
            for peer, value in losses.items()
        }
        for row in rows(f"training step {name}, batch 4", interleaved(runs, rounds, warm_up=1), equal):
            rounded = row.equal is None and row.peer in peers.ROUNDED_OTHERWISE
            found.append(row._replace(deviation=losses[row.peer] / loss - 1) if rounded else row)
    return found


def _same_loss(peer: str, deviation: float) -> bool | None:
    """Whether a peer has our loss; None where it only rounds otherwise, see peers.ROUNDED_OTHERWISE."""
    if abs(deviation) < 1e-4:
        return True
    return None if abs(deviation) < peers.ROUNDED_OTHERWISE.get(peer, 0) else False


def streams(rounds: int, *, quick: bool) -> list[Row]:
    """Time per window of streams on one core [ms]: eight in turn against one alone, and batches against in turn."""
    config = TINY if quick else SHIPPED
    network = untrained(config)
    engine = Engine(network)
    inputs = [random_input(config, 1, seed=seed) for seed in range(8)]
    states = [network.initial_state(1) for _ in inputs]

    def in_turn() -> None:
        for index, spikes in enumerate(inputs):
            states[index] = engine(spikes, states[index])[1]

    def alone() -> None:
        for _ in inputs:
            states[0] = engine(inputs[0], states[0])[1]

    def at_once(count: int) -> Callable[[], object]:
        joint, initial = torch.cat(inputs[:count], dim=1), [network.initial_state(1)] * count
        return lambda: engine.together(joint, initial)

    batches = {count: at_once(count) for count in (2, 4, 8)}
    runs = {f"{count} at once": run for count, run in batches.items()}
    times = interleaved({"in turn": in_turn, "one stream": alone, **runs}, rounds)
    per_window = {name: value / int(name[0]) for name, value in times.items() if "at once" in name}
    turn, one = (times[name] / len(inputs) for name in ("in turn", "one stream"))
    each = [engine(spikes, network.initial_state(1))[0] for spikes in inputs]
    joined = [twists for twists, _ in engine.together(torch.cat(inputs, dim=1), [network.initial_state(1)] * 8)]
    equal = all(torch.allclose(a, b, rtol=1e-3, atol=1e-4) for a, b in zip(joined, each, strict=True))
    return [
        Row("8 streams in turn, shipped, per window", turn, "one stream", one, one / turn, None, True),
        *(
            Row(f"{name}, shipped, per window", ours, "streams in turn", turn, turn / ours, None, equal)
            for name, ours in per_window.items()
        ),
    ]


def random_input(config: ModelConfig, steps: int, batch: int = 1, seed: int = 1) -> Tensor:
    """Random network input (T, B, 2n, H, W), encoded from counts, in the channels-last layout of the encoding."""
    shape = (steps, batch, *config.input_shape)
    counts = torch.poisson(torch.full(shape, 0.3), generator=torch.Generator().manual_seed(seed))
    return counts.log1p().movedim(2, -1).contiguous().movedim(-1, 2)


def untrained(config: ModelConfig) -> NeuroVE:
    """The network of a configuration with random weights, in evaluation mode."""
    return cast("NeuroVE", bundle.untrained(0, config).network.eval().requires_grad_(requires_grad=False))


def _plainly(network: NeuroVE, spikes: Tensor, state: NetworkState) -> Callable[[], object]:
    def run() -> object:
        with plain():
            return network(spikes, state)

    return run


def _inside_plain(run: Callable[[], object]) -> Callable[[], object]:
    def plainly() -> object:
        with plain():
            return run()

    return plainly


def _agree(engine: Engine, network: NeuroVE, spikes: Tensor, initial: NetworkState) -> bool:
    """Whether the spikes equal the reference implementation bit for bit, and the twists of the first window agree."""
    fired = engine.features(spikes, initial)[0]
    with plain():
        same = torch.equal(engine.features(spikes, initial)[0], fired)
        expected = network(spikes[:1], initial)[0]
    return bool(same and torch.allclose(engine(spikes[:1], initial)[0], expected, rtol=1e-3, atol=1e-4))


class TrainingStep:
    """One step of training a copy of a network towards zero velocity.

    Args:
        network: it is not changed.
        spikes: (T, B, C, H, W) input.
        device: computes the step.
    """

    def __init__(self, network: NeuroVE, spikes: Tensor, device: torch.device = _CPU) -> None:
        self._network, self._spikes = copy.deepcopy(network).to(device), spikes.to(device)
        self._initial = self._network.initial_state(spikes.shape[1])
        self._optimizer = torch.optim.Adam(self._network.parameters(), lr=1e-4, fused=True)  # for peers too

    def loss(self) -> float:
        """The loss before the step."""
        with torch.no_grad():
            return float(self._error())

    def __call__(self) -> None:
        """Take the step."""
        self._optimizer.zero_grad()
        self._error().backward()  # type: ignore[no-untyped-call]  # torch's own
        self._optimizer.step()

    def _error(self) -> Tensor:
        return torch.mean((self._network(self._spikes, self._initial)[0] - 0.5).square())
