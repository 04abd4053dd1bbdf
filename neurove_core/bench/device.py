"""Benchmarks of a GPU against one core of this machine: a training step, and windows of many streams in one batch."""

import time
from collections.abc import Callable

import numpy as np
import torch

from neurove_core.bench import Row, interleaved, rows
from neurove_core.bench.peers import Missing
from neurove_core.bench.window import REFERENCE, SHIPPED, TINY, TrainingStep, random_input, untrained
from neurove_core.config import ModelConfig
from neurove_core.engine.array_runner import ArrayRunner
from neurove_core.models import bundle
from neurove_core.networks.arrays import Runner
from neurove_core.networks.device import TOLERANCE, DeviceRunner, difference, full_precision

STREAMS = 64
_WINDOWS = 4  # whose answers are compared


def gpu(rounds: int, missing: Missing, *, quick: bool) -> list[Row]:
    """The rows of the first GPU; none where torch sees no GPU."""
    if not torch.cuda.is_available():
        missing.append(f"gpu ({'torch sees no GPU' if torch.version.cuda else 'this build of torch has no CUDA'})")
        return []
    return on_device(torch.device("cuda:0"), rounds, quick=quick)


def on_device(device: torch.device, rounds: int, *, quick: bool) -> list[Row]:
    """The rows of any device: wall-clock times until its answers are here, in full float32.

    Answers are equal if twists, or the loss before the step, differ by less than TOLERANCE of the largest.
    """
    return [*_streams(device, rounds, quick=quick), *_training(device, rounds, quick=quick)]


def _streams(device: torch.device, rounds: int, *, quick: bool) -> list[Row]:
    made = bundle.untrained(0, TINY if quick else SHIPPED)
    count = 4 if quick else STREAMS
    ours, engine = DeviceRunner(made.network, device), ArrayRunner(made.current_weights)
    rng = np.random.default_rng(20_030)
    counts = rng.poisson(0.3, (_WINDOWS, count, *made.config.input_shape)).astype(np.uint8)
    equal = difference(_twists(ours, counts), _twists(engine, counts)) < TOLERANCE

    def once(runner: Runner) -> Callable[[], object]:
        states = [runner.initial_state() for _ in range(count)]
        return lambda: runner.run(list(counts[0]), states)

    times = interleaved({"ours": once(ours), "engine, one core": once(engine)}, rounds, clock=time.perf_counter)
    return rows(f"{count} streams in one batch on {device}", times, {"engine, one core": equal})


def _twists(runner: Runner, counts: np.ndarray[tuple[int, ...], np.dtype[np.uint8]]) -> np.ndarray:
    states, found = [runner.initial_state() for _ in counts[0]], []
    for window in counts:
        steps = runner.run(list(window), states)
        states = [state for _, state in steps]
        found.append([twists for twists, _ in steps])
    return np.array(found)


def _training(device: torch.device, rounds: int, *, quick: bool) -> list[Row]:
    shapes: dict[str, tuple[ModelConfig, int]] = {"tiny, T=3": (TINY, 3)}
    if not quick:
        shapes = {"reference, T=8": (REFERENCE, 8), "shipped, T=16": (SHIPPED, 16)}
    found: list[Row] = []
    for name, (config, steps) in shapes.items():
        network, spikes = untrained(config).requires_grad_().train(), random_input(config, steps, batch=4)
        ours, theirs = TrainingStep(network, spikes, device), TrainingStep(network, spikes)
        with full_precision():
            equal = difference(ours.loss(), theirs.loss()) < TOLERANCE
            runs: dict[str, Callable[[], object]] = {"ours": _finished(ours, device), "one core": theirs}
            times = interleaved(runs, rounds, warm_up=1, clock=time.perf_counter)
        found += rows(f"training step {name}, batch 4 on {device}", times, {"one core": equal})
    return found


def _finished(step: TrainingStep, device: torch.device) -> Callable[[], object]:
    def run() -> None:
        step()
        if device.type == "cuda":
            torch.cuda.synchronize(device)

    return run
