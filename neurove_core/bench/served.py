"""Benchmarks of a window as a node computes it, on arrays and without torch, and of the parts of its time."""

from collections.abc import Callable
from typing import Any, Final

import numpy as np
import torch
from numpy.typing import NDArray

from neurove_core.bench import Row, interleaved, machine, peers, rows
from neurove_core.bench.window import REFERENCE, SHIPPED, TINY, with_precision
from neurove_core.config import ModelConfig
from neurove_core.engine.array_runner import ArrayRunner
from neurove_core.models import bundle
from neurove_core.networks.encoding import to_spikes_reference
from neurove_core.networks.neurove import NeuroVE
from neurove_core.spiking.plain import plain

_COPIED: Final = 1 << 26  # bytes, more than the caches hold
AT_PEAK: Final = "its sums at the matrix peak"
ONCE: Final = "its weights read once from memory"


def served(rounds: int, missing: peers.Missing, *, quick: bool, with_peers: bool) -> list[Row]:
    """A window at T = 1 in float32 and in int8, and its parts next to the limits of this machine."""
    shapes = {"tiny": TINY} if quick else {"shipped": SHIPPED, "reference": REFERENCE}
    return [row for name, config in shapes.items() for row in _network(name, config, rounds, missing, with_peers)]


def _network(name: str, config: ModelConfig, rounds: int, missing: peers.Missing, with_peers: bool) -> list[Row]:
    counts = np.random.default_rng(1).poisson(0.3, config.input_shape).astype(np.uint8)
    model = bundle.untrained(0, config)
    network: Any = model.network.eval().requires_grad_(requires_grad=False)
    ours = ArrayRunner(model.current_weights)
    narrow = ArrayRunner(bundle.untrained(0, with_precision(config, "int8")).current_weights)
    others = peers.networks(network, missing) if with_peers else {}
    runs: dict[str, Callable[[], object]] = {"ours": _window(ours, counts), "ours, int8": _window(narrow, counts)}
    runs |= {peer: _in_torch(one, counts) for peer, one in {"PyTorch, plain": network, **others}.items()}
    expected = runs["ours"]()
    equal: dict[str, bool | None] = {
        peer: None if peer in peers.DIFFERENT_BY_DESIGN else bool(np.allclose(run(), expected, rtol=1e-3, atol=1e-4))  # type: ignore[arg-type]  # twists
        for peer, run in runs.items()
        if not peer.startswith("ours")
    }
    times, title = interleaved(runs, rounds), f"window {name}, as served"
    found = rows(title, times, equal)
    in_int8 = {"ours": times["ours, int8"], "ours, float32": times["ours"]}
    found += rows(f"{title}, int8", in_int8, {"ours, float32": None})
    for precision, runner in (("float32", ours), ("int8", narrow)):
        found += _parts(f"{name}, {precision}", runner, counts, rounds)
    return found


def _parts(name: str, runner: ArrayRunner, counts: NDArray[np.uint8], rounds: int) -> list[Row]:
    """Each part of a window against the higher one of two limits, and the whole window against the sum of its parts."""
    parts = runner.parts(counts)
    source = np.ones(_COPIED // 8)
    runs: dict[str, Callable[[], object]] = {part.name: part.run for part in parts}
    times = interleaved(
        {**runs, "whole": _window(runner, counts), "peak": machine.peak(), "memory": lambda: source.sum()}, rounds
    )
    found: list[Row] = []
    for part in parts:
        limits = {
            AT_PEAK: times["peak"] * 2 * part.sums / machine.PEAK_FLOPS,
            ONCE: times["memory"] * part.weights / _COPIED,
        }
        limit, mine = max(limits, key=lambda one: limits[one]), times[part.name]
        least = limits[limit]
        found.append(Row(f"{part.name}, {name}", mine, limit, least, least / mine, least / mine, None))
    total = sum(times[part.name] for part in parts)
    if parts:
        whole = times["whole"]
        found.append(Row(f"window, {name}", whole, "all its parts, each alone", total, total / whole, None, None))
    return found


def _window(runner: ArrayRunner, counts: NDArray[np.uint8]) -> Callable[[], object]:
    state = runner.initial_state()
    return lambda: runner.run([counts], [state])[0][0]


def _in_torch(network: NeuroVE, counts: NDArray[np.uint8]) -> Callable[[], object]:
    initial = network.initial_state(1)
    spikes = to_spikes_reference(torch.from_numpy(counts), network.config.network.encoding)[None, None]

    @torch.inference_mode()
    def run() -> object:
        with plain():
            return network(spikes, initial)[0][0, 0].numpy()

    return run
