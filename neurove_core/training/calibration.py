"""Fit the uncertainty of a trained model on sequences that it was not trained on; its weights stay the same.

Six output neurons are added, with the same inputs as the velocity outputs. Their rows are fitted so that exp of their
potential is the size of the error. The fit maximises the likelihood of a Laplace distribution, which is a convex
problem; a penalty on the weights leaves a few directions of the last layer. Then one factor per axis makes the
intervals of LEVEL contain that share of the errors. Each sequence is evaluated by a fit that did not use it
(cross-conformal prediction, Vovk 2015).

There are three sets of sequences: sequences like those of training, drives at full speed, and hard sequences without
ground texture, dark or noisy. The model sees each sequence five times: unchanged, mirrored with gaps in the events,
with few events, with many random events, and with the noise of a stationary camera instead of its events. It always
starts from the zero state.
"""

import copy
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final, NamedTuple, cast

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from neurove_core import self_test
from neurove_core.engine.engine import Engine
from neurove_core.estimator import Estimator
from neurove_core.ingest.channels import network_input
from neurove_core.models.bounds import UNSET, Bounds
from neurove_core.models.bundle import PER_HEIGHT, Bundle
from neurove_core.models.uncertainty import LEVEL, LEVELS, Uncertainty, half_width
from neurove_core.networks.device import full_precision, on_device
from neurove_core.networks.encoding import to_spikes
from neurove_core.networks.neurove import NetworkState, NeuroVE
from neurove_core.tasks import HERE, Pool
from neurove_core.timescales import Answer, Longer, chosen, followed, jobs, slowed, watched
from neurove_core.training.batches import mirrored, stationary, with_gain, with_noise
from neurove_core.training.config import DataConfig, TrainingConfig
from neurove_core.training.data import Cache, Sequences
from neurove_core.training.loop import commit
from neurove_protocol.errors import BadModel, InvalidField
from neurove_protocol.velocity import AXES

SEQUENCES: Final = 96
UNCERTAIN_ABOVE: Final = 0.3
"""Relative bound of sigma for the flag `uncertain` (decision 48); the absolute bounds are optional (decision 91)."""

VARIANTS: Final = ("unchanged", "gaps", "few events", "noise", "stationary")
"""Variants of each sequence."""

_SECONDS: Final = 3.0  # many short sequences say more than a few long ones, because errors persist within a sequence
_SEED_SHIFT: Final = 450_000_000  # distance from the seeds of training
_SEEDS: Final = 900_000_000
_KIND_SEEDS: Final = 1_000_000  # distance between the sets of sequences
_FOLDS: Final = 4
_PROVENANCE_CHARS: Final = 1000
_PENALTY: Final = 0.003  # on the weights of the spread; its inputs have variance 1 on average
_NEWTON_STEPS: Final = 50
_CLIPPED: Final = 3.0  # limit of an error in the correlation, in sigma, so that one bad sequence does not dominate
_STILL_NOISE: Final = (1e-5, 0.3)  # mean events per cell and bin of a stationary camera
_SHRUNK: Final = 0.02  # shrinkage towards no correlation; it makes the matrix positive definite

Array = NDArray[np.float64]


class SequenceErrors(NamedTuple):
    """Inputs of the spread and errors of a model on one variant of a sequence, over T windows."""

    inputs: Array  # (T, N + 1): potential of a spread neuron for each weight alone, and for the bias alone
    error: Array  # (T, n, 6) estimate minus truth, in units of the bundle's scale
    sequence: int
    variant: str  # one of VARIANTS
    hard: bool


@dataclass(frozen=True)
class Calibration:
    """A bundle with its uncertainty, and the coverage on sequences that the fit did not use."""

    bundle: Bundle
    report: dict[str, Any]


def calibration_sets(config: TrainingConfig, sequences: int) -> list[tuple[TrainingConfig, bool]]:
    """Return the configurations of the three calibration sets, each with whether it is hard.

    Raises:
        InvalidField: there are too few sequences for the folds of each set.
    """
    if sequences < 4 * _FOLDS:
        raise InvalidField("calibration", "calibration_sequences", sequences, f"must be at least {4 * _FOLDS}")
    fast, hard = sequences // 4, sequences // 4
    seed = (config.data.seed + _SEED_SHIFT) % (_SEEDS - 3 * _KIND_SEEDS)
    drives = {"slowed_drive": (1.0, 1.0), "scenes": {"street": 1.0}}
    dark = {"eps": (0.001, 0.1), "cutoff_hz": (30.0, 1000.0), "shot_noise_hz": (0.001, 10.0), "threshold": (0.15, 0.6)}
    wanted: list[tuple[int, dict[str, Any], bool]] = [
        (sequences - fast - hard, {}, False),
        (fast, drives, False),
        (hard, {"scenes": {"bare-street": 0.7, "street": 0.3}, **dark}, True),
    ]
    seconds = min(config.data.seconds, _SECONDS)
    made = []
    for kind, (count, changes, is_hard) in enumerate(wanted):
        fields = config.data.model_dump() | changes
        fields |= {"sequences": count, "seconds": seconds, "seed": seed + kind * _KIND_SEEDS}
        made.append((config.model_copy(update={"data": DataConfig.model_validate(fields)}), is_hard))
    return made


def fill(config: TrainingConfig, folder: Path, sequences: int, pool: Pool = HERE) -> Iterator[str]:
    """Simulate the missing calibration sequences, and yield the name of each one when it is done."""
    for one, _ in calibration_sets(config, sequences):
        yield from Cache(folder, one).fill(pool)


def calibrate(
    bundle: Bundle,
    config: TrainingConfig,
    folder: Path,
    sequences: int = SEQUENCES,
    bounds: Bounds = UNSET,
    device: torch.device | None = None,
) -> Calibration:
    """Fit the uncertainty of a model; an existing one is replaced.

    Args:
        bundle: trained, with its linear part per metre of height.
        config: configuration that trained the model; its windows and canonical camera must be those of the bundle.
        folder: of the sequences, filled by `fill`.
        sequences: number of sequences.
        bounds: absolute bounds for the flag `uncertain`; by default those that the bundle has.
        device: where the network runs in torch; by default the engine runs it.

    Raises:
        BadModel: the kind of the network is not `neurove`, the model does not fit the configuration, or its linear part
            is not per metre of height.
        BrokenRecording: a sequence is missing or broken.
    """
    check(bundle, config, sequences)
    parts = [(Cache(folder, one).open(), hard) for one, hard in calibration_sets(config, sequences)]
    first = calibration_sets(config, sequences)[0][0].data
    provenance = (
        f"neurove calibrate: {sequences} simulated sequences of {first.seconds:g} s from seed {first.seed}, each seen "
        f"{len(VARIANTS)} times, {_FOLDS} folds, commit {commit() or 'unknown'}"
    )
    return with_uncertainty(bundle, list(collect_errors(bundle, parts, device)), provenance, bounds)


def check(bundle: Bundle, config: TrainingConfig, sequences: int) -> None:
    """Check that a model can be calibrated, before anything is simulated; see `calibrate`.

    Raises:
        BadModel: the model does not fit. InvalidField: there are too few sequences.
    """
    _neurove(bundle)
    calibration_sets(config, sequences)
    if (bundle.config.window, bundle.config.canonical) != (config.model.window, config.model.canonical):
        raise BadModel(bundle.name, "its windows or its canonical camera differ from those of the configuration")
    if bundle.linear_unit != PER_HEIGHT:
        raise BadModel(
            bundle.name, f"linear_unit={bundle.linear_unit!r}: the truth of the sequences is in {PER_HEIGHT!r}"
        )


def with_uncertainty(
    bundle: Bundle, errors: list[SequenceErrors], provenance: str, bounds: Bounds = UNSET
) -> Calibration:
    """Fit the spread of a bundle on its errors, and return the bundle with its uncertainty.

    The golden test, if there is one, is recorded again, because the last layer has changed.

    Args:
        bundle: of kind `neurove`.
        errors: on all variants of the calibration sequences.
        provenance: one line that says what the sequences were; the uncertainty stores it.
        bounds: absolute bounds for the flag `uncertain`; by default those that the bundle has.

    Raises:
        BadModel: the kind of the network is not `neurove`.
    """
    held = [one for fold in range(_FOLDS) for one in _held_out(errors, fold)]
    usual = [(one, sigma) for one, sigma in held if one.variant == VARIANTS[0] and not one.hard]
    ratio = np.concatenate([np.abs(one.error) / sigma[:, None] for one, sigma in usual]).reshape(-1, 6)
    factor = np.quantile(ratio, LEVEL, axis=0) / half_width(LEVEL)
    weights = _fit(errors)
    network = _copy(bundle)
    spread = network.add_spread()
    leak = 1 - float(torch.sigmoid(network.kappa_logit.detach()))
    with torch.no_grad():
        spread.weight.copy_(torch.from_numpy(weights[:-1].T))
        # the leaky neuron integrates log(factor) * leak to log(factor)
        spread.bias.copy_(torch.from_numpy(weights[-1] + np.log(factor) * leak))
    bounds = bounds.or_else(bundle.uncertainty.bounds if bundle.uncertainty else UNSET)
    uncertainty = Uncertainty(_correlation(usual, factor), UNCERTAIN_ABOVE, provenance, bounds)
    made = replace(bundle, network=network.eval(), uncertainty=uncertainty)
    if made.golden:  # a wider last layer may round differently
        made = replace(made, golden=self_test.record(Estimator(made), made.golden.counts, made.golden.tolerance))
    return Calibration(made.with_digest(), _report(held, factor, provenance))


def with_wider_sigma(bundle: Bundle, factor: Array, provenance: str) -> Bundle:
    """Multiply the sigma of each axis of a calibrated bundle; its twists stay the same.

    Args:
        bundle: with an uncertainty.
        factor: (6), above 0.
        provenance: one line on where the factors come from; it is added to that of the uncertainty.

    Raises:
        BadModel: the bundle has no uncertainty.
    """
    network = _copy(bundle)
    if bundle.uncertainty is None or network.spread is None:
        raise BadModel(bundle.name, "it has no uncertainty: neurove calibrate adds it")
    leak = 1 - float(torch.sigmoid(network.kappa_logit.detach()))
    with torch.no_grad():  # the leaky neuron integrates log(factor) * leak to log(factor)
        network.spread.bias.add_(torch.from_numpy(np.log(factor) * leak).float())
    about = f"{bundle.uncertainty.provenance}; {provenance}"[:_PROVENANCE_CHARS]
    changed = replace(bundle.uncertainty, provenance=about)
    return replace(bundle, network=network.eval(), uncertainty=changed).with_digest()


def collect_errors(
    bundle: Bundle, parts: list[tuple[Sequences, bool]], device: torch.device | None = None
) -> Iterator[SequenceErrors]:
    """Run a model on every variant of all sequences, and yield its errors; the bool marks the hard sets.

    Args:
        bundle: the model.
        parts: sets of sequences.
        device: see `calibrate`.
    """
    probe = _copy(bundle)
    width = probe.readout.in_features
    layer: nn.Linear = probe.add_spread(width + 1)
    with torch.no_grad():
        layer.weight[:width] = torch.eye(width)
        layer.bias[width] = 1
    step = _Step(probe.eval(), device)
    number = 0
    for found, hard in parts:
        for index in range(len(found)):
            rng = np.random.default_rng((203, number))
            counts, twists = found.counts(index, 0, len(found.twists[index])), found.twists[index]
            variants = variants_of(rng, counts, twists)
            counted = np.stack([network_input(seen, bundle.config) for seen, _ in variants], 1)
            spikes = to_spikes(torch.from_numpy(counted), bundle.config.network.encoding)
            state, inputs, outputs = step.network.initial_state(len(variants)), [], []
            for window in torch.split(spikes, 1):
                output, potential, state = step(window, state)
                inputs.append(potential)
                outputs.append(output)
            truth = np.stack([true for _, true in variants], 1)
            error = np.stack(outputs) - (truth - bundle.offset.double().numpy()) / bundle.scale.double().numpy()
            for stream, (variant, (windows, true)) in enumerate(zip(VARIANTS, variants, strict=True)):
                seen, off = np.stack(inputs)[:, stream], error[:, stream]
                if bundle.config.scales:
                    seen, off = _served(bundle, step, windows, true)
                yield SequenceErrors(seen, off, number, variant, hard)
            number += 1


class _Step:
    """One window of all streams: (1, B, 2n, H, W) spikes -> answers (B, n, 6), potentials of the spread, and the state.

    Args:
        probe: with a spread.
        device: see `calibrate`.
    """

    def __init__(self, probe: NeuroVE, device: torch.device | None) -> None:
        self._device = device or torch.device("cpu")
        self.network = probe if device is None else on_device(probe, device)
        self._run: Callable[..., tuple[Tensor, NetworkState]] = Engine(probe) if device is None else self.network

    def __call__(self, spikes: Tensor, state: NetworkState) -> tuple[Array, Array, NetworkState]:
        with full_precision():
            output, after = self._run(spikes.to(self._device), state)
        potential = self.network.log_sigma(after)
        assert potential is not None  # the probe has a spread
        return output[0].double().cpu().numpy(), potential.double().cpu().numpy(), after


def _served(bundle: Bundle, step: _Step, stored: NDArray[np.uint8], truth: NDArray[np.float32]) -> tuple[Array, Array]:
    """Inputs of the spread and errors of a model with longer windows, of the answers that it would serve.

    The error of an answer counts times its scale, because its sigma is divided by the scale.
    """
    config, offset, scale = bundle.config, bundle.offset.double().numpy(), bundle.scale.double().numpy()

    def run(counts: NDArray[np.uint8], state: NetworkState) -> tuple[Array, NetworkState]:
        spikes = to_spikes(torch.from_numpy(counts)[None, None], config.network.encoding)
        output, _, after = step(spikes, state)
        return output[0] * scale + offset, after

    state = step.network.initial_state()
    longer, inputs, errors = Longer(), [], []
    for window, true in zip(network_input(stored, config), truth, strict=True):
        twists, state = run(window, state)
        wanted, longer = jobs(window, longer, step.network, config)
        done = [(job, *run(job.counts, cast("NetworkState", job.state))) for job in wanted]
        longer = watched(followed(longer, [(job, after) for job, _, after in done], config), twists, config)
        answers = [Answer(twists, state), *(Answer(slowed(t, job.scale), s, job.scale) for job, t, s in done)]
        best = chosen(answers, longer, config.scale_bounds)
        potential = step.network.log_sigma(cast("NetworkState", best.network))
        assert potential is not None  # the probe has a spread
        inputs.append(potential[0].double().cpu().numpy())
        errors.append((best.twists - true) * best.scale / scale)
    return np.stack(inputs), np.stack(errors)


def variants_of(
    rng: np.random.Generator, counts: NDArray[np.uint8], twists: NDArray[np.float32]
) -> list[tuple[NDArray[np.uint8], NDArray[np.float32]]]:
    """Make the variants of a sequence (T, 2n, H, W) with its twists (T, n, 6), in the order of VARIANTS."""
    from_here, windows = int(rng.integers(2, max(3, len(counts) // 2))), len(counts)
    other, turned = mirrored(counts, twists)
    gaps, at = other.copy(order="C"), 0
    while at < windows:
        at += int(rng.integers(4, 16))
        length = int(np.exp(rng.uniform(0, np.log(20))))
        gaps[at : at + length] = 0
        at += length
    few, many = counts.copy(order="C"), counts.copy(order="C")
    few[from_here:] = with_gain(rng, few[from_here:], float(np.exp(rng.uniform(np.log(0.01), np.log(0.5)))))
    many[from_here:] = with_noise(rng, many[from_here:], float(np.exp(rng.uniform(np.log(0.01), np.log(0.4)))))
    noise = stationary(rng, counts.shape, float(np.exp(rng.uniform(*np.log(_STILL_NOISE)))))
    return [(counts, twists), (gaps, turned), (few, twists), (many, twists), (noise, np.zeros_like(twists))]


def laplace_scale(inputs: Array, size: Array, penalty: float) -> Array:
    """Fit weights w (K) so that exp(inputs w) is the scale of errors of this mean size.

    Newton's method minimises mean(size exp(-x w) + x w) + penalty / 2 * |w|^2. This is the negative log likelihood of a
    Laplace distribution, and convex. The penalty leaves out the last weight, which is that of the bias.

    Args:
        inputs: (M, K); the last column is that of the bias.
        size: (M); some are above 0.
        penalty: for inputs with variance 1 on average.
    """
    unit = float(np.sqrt(inputs[:, :-1].var(0).mean())) or 1.0
    x = inputs / np.append(np.full(inputs.shape[1] - 1, unit), 1.0)
    ridge = np.append(np.full(x.shape[1] - 1, penalty), 1e-9)
    least = 1e-6 * size.mean() + 1e-12  # an error of 0 would give a scale of 0
    size = np.maximum(size, least)
    w = np.zeros(x.shape[1])
    w[-1] = np.log(size.mean()) / x[:, -1].mean()

    def loss(w: Array) -> float:
        u = x @ w
        return float((size * np.exp(-u) + u).mean() + 0.5 * (ridge * w * w).sum())

    for _ in range(_NEWTON_STEPS):
        ratio = size * np.exp(-(x @ w))
        gradient = x.T @ (1 - ratio) / len(x) + ridge * w
        step = np.linalg.solve((x * ratio[:, None]).T @ x / len(x) + np.diag(ridge), gradient)
        share, now = 1.0, loss(w)
        while not loss(w - share * step) <= now and share > 1e-6:
            share /= 2
        w = w - share * step
        if gradient @ step < 1e-8:
            break
    weights: Array = w / np.append(np.full(x.shape[1] - 1, unit), 1.0)
    return weights


def _copy(bundle: Bundle) -> NeuroVE:
    return copy.deepcopy(_neurove(bundle))


def _neurove(bundle: Bundle) -> NeuroVE:
    if not isinstance(bundle.network, NeuroVE):
        raise BadModel(
            bundle.name, f"kind={bundle.config.kind!r}: only a network of kind 'neurove' can have an uncertainty"
        )
    return bundle.network


def _fit(errors: list[SequenceErrors]) -> Array:
    """Fit the weights (N + 1, 6) of the spread."""
    inputs = np.concatenate([one.inputs for one in errors])
    size = np.concatenate([np.abs(one.error).mean(1) for one in errors])
    return np.stack([laplace_scale(inputs, size[:, axis], _PENALTY) for axis in range(6)], 1)


def _held_out(errors: list[SequenceErrors], fold: int) -> list[tuple[SequenceErrors, Array]]:
    """The sequences of a fold, with sigma (T, 6) from a fit on all other sequences."""
    weights = _fit([one for one in errors if one.sequence % _FOLDS != fold])
    return [(one, np.exp(one.inputs @ weights)) for one in errors if one.sequence % _FOLDS == fold]


def _correlation(usual: list[tuple[SequenceErrors, Array]], factor: Array) -> torch.Tensor:
    ratio = np.concatenate([one.error / (sigma * factor)[:, None] for one, sigma in usual]).reshape(-1, 6)
    clipped = np.clip(ratio, -_CLIPPED, _CLIPPED)
    spread = np.sqrt((clipped**2).mean(0)) + 1e-12
    found = (1 - _SHRUNK) * (clipped.T @ clipped / len(clipped)) / np.outer(spread, spread)
    np.fill_diagonal(found, 1.0)
    return torch.tensor((found + found.T) / 2, dtype=torch.float32)


def _report(held: list[tuple[SequenceErrors, Array]], factor: Array, provenance: str) -> dict[str, Any]:
    """Coverage by axis for each variant, and for the hard sets; each sequence by a fit that did not use it."""
    groups: dict[str, list[tuple[SequenceErrors, Array]]] = {}
    for one, sigma in held:
        groups.setdefault(f"hard scenes, {one.variant}" if one.hard else one.variant, []).append((one, sigma * factor))
    report: dict[str, Any] = {
        "provenance": provenance,
        "level": LEVEL,
        "factor": dict(zip(AXES, factor.tolist(), strict=True)),
    }
    report["groups"] = {}
    for name, group in groups.items():
        ratio = np.concatenate([np.abs(one.error) / sigma[:, None] for one, sigma in group]).reshape(-1, 6)
        middle = np.median(np.concatenate([sigma for _, sigma in group]), axis=0)
        report["groups"][name] = {
            axis: {"median_sigma_in_scale": float(middle[i])}
            | {str(level): float((ratio[:, i] <= half_width(level)).mean()) for level in LEVELS}
            for i, axis in enumerate(AXES)
        }
    return report
