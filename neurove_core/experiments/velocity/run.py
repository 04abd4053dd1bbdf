"""The paper's velocity experiment (sections IV-C and IV-D): train all methods with one recipe, evaluate all alike.

Each trained method is a folder that holds its bundle. An interrupted experiment continues with the first method that
is not finished.
"""

import json
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np
import torch

from neurove_core import models
from neurove_core.experiments.velocity.held_out import (
    CONTRAST_GROUPS,
    HeldOutCache,
    Scenario,
    held_out_scenarios,
    training_drives,
)
from neurove_core.experiments.velocity.tracks import Track, blind_predictors, follow, summaries, summary
from neurove_core.models import bundle
from neurove_core.models.bundle import Bundle
from neurove_core.networks.snn_ang import CHANNELS
from neurove_core.tasks import HERE, Pool
from neurove_core.training import config as configs
from neurove_core.training import data
from neurove_core.training.config import TrainingConfig
from neurove_core.training.loop import RUN_JSON, train
from neurove_core.training.ranks import alone
from neurove_protocol.errors import InvalidField

METHODS: Final[dict[str, dict[str, Any]]] = {
    "nve": {},
    "nve-wo": {"network": {"diffusion": False}},
    "ann": {"kind": "ann", "network": {"precision": "float32"}},
    "snn-ang": {"kind": "snn-ang", "network": {"channels": CHANNELS, "precision": "float32"}},
}
"""The fields of the model configuration that each method changes. Nothing else differs between the methods."""

Show = Callable[[str, int, int, str], None]
"""Reports progress: the task, the steps done, the steps in total, and a detail."""


class Experiment(NamedTuple):
    """What to train and evaluate."""

    config: TrainingConfig
    methods: tuple[str, ...]
    seeds: range
    recordings: Path | None  # folder of the recordings, with MVSEC's poses
    quick: bool = False  # few short scenarios through a tiny camera
    device: torch.device | None = None  # that trains; None: the CPU

    def drives(self) -> list[Scenario]:
        """The drives along MVSEC's poses to train on, besides the sequences of the configuration."""
        data = self.config.data
        return training_drives(self.recordings, data.seconds, data.motion_px, quick=self.quick)

    def scenarios(self) -> list[Scenario]:
        """The held-out scenarios to evaluate on."""
        return held_out_scenarios(self.recordings, quick=self.quick)


class VelocityRun(NamedTuple):
    """One method, trained from one seed and evaluated."""

    row: dict[str, Any]  # its entry in the results
    tracks: list[Track]
    cpu_s_per_update: float  # depends on this machine, so the results give ratios only


def method_config(base: TrainingConfig, method: str, seed: int) -> TrainingConfig:
    """The configuration of a method: the base with the changes of METHODS and another seed.

    Args:
        base: the recipe of all methods.
        method: a key of METHODS.
        seed: is added to the seed of the base.

    Raises:
        InvalidField: the method is unknown.
    """
    if method not in METHODS:
        raise InvalidField("reproduce velocity", "methods", method, f"known are {', '.join(METHODS)}")
    fields = base.model_dump()
    changes = METHODS[method]
    fields["model"] |= {name: value for name, value in changes.items() if name != "network"}
    fields["model"]["network"] |= changes.get("network", {})
    fields["recipe"]["seed"] = base.recipe.seed + seed
    return TrainingConfig.model_validate(fields | {"name": f"{method}-{seed}"})


def base_config(source: str | None = None, steps: int | None = None, *, quick: bool = False) -> TrainingConfig:
    """The recipe of all methods.

    Args:
        source: file or name of a configuration; the default is `driving`, or `velocity-quick` for a quick run.
        steps: number of updates, in place of the configuration's own.
        quick: see Experiment.

    Raises:
        InvalidField: the configuration does not exist, or it or `steps` is wrong.
    """
    found = configs.load(source or ("velocity-quick" if quick else "driving"))
    if steps is None:
        return found
    if steps < 1:
        raise InvalidField("reproduce velocity", "steps", steps, "must be at least 1")
    return found.model_copy(update={"recipe": found.recipe.model_copy(update={"steps": steps, "cycles": 1})})


def reproduce(experiment: Experiment, folder: Path, out: Path, show: Show, pool: Pool = HERE) -> Iterator[VelocityRun]:
    """Simulate the sequences, then train and evaluate each method from each seed; reuse finished sequences and methods.

    Args:
        experiment: what to train and evaluate.
        folder: holds the simulated sequences.
        out: holds one folder per trained method.
        show: receives the progress.
        pool: where the simulations run.

    Yields:
        the runs, all methods of the first seed first.

    Raises:
        InvalidField: a method is unknown, or a folder holds another run. BrokenRecording: a sequence is damaged.
    """
    if not experiment.methods or not len(experiment.seeds):
        raise InvalidField("reproduce velocity", "seeds", len(experiment.seeds), "must be at least 1")
    wanted = [
        (method, method_config(experiment.config, method, seed))
        for seed in experiment.seeds
        for method in experiment.methods
    ]
    sequences = data.Cache(folder, experiment.config)
    total = experiment.config.data.sequences
    for done, name in enumerate(sequences.fill(pool), total - len(sequences.missing()) + 1):
        show("simulated", done, total, name)
    drives, scenarios = experiment.drives(), experiment.scenarios()
    cache = HeldOutCache(folder, experiment.config.model)
    for done, scenario in enumerate(cache.fill([*drives, *scenarios], pool), 1):
        show("held out", done, len(drives) + len(scenarios), f"{scenario.group} {scenario.name}")
    more = [cache.path(drive) for drive in drives]
    for method, config in wanted:
        run = ensure_trained(config, out, folder, more, show, experiment.device)
        yield _evaluate(method, config, run, scenarios, cache)


def ensure_trained(
    config: TrainingConfig,
    out: Path,
    folder: Path,
    more: Sequence[Path],
    show: Show,
    device: torch.device | None = None,
) -> Path:
    """Return the folder of a trained method; train it first if it is missing or unfinished.

    Args:
        config: of the method.
        out: holds one folder per trained method.
        folder: holds the simulated sequences of the configuration.
        more: sequence files to train on besides them.
        show: receives the progress.
        device: that trains; None: the CPU.

    Raises:
        InvalidField: the folder holds a run of another configuration. BadModel: so does its checkpoint.
    """
    run = out / (f"{config.name}-mvsec" if more else config.name)
    path, record = run / f"{config.name}{bundle.SUFFIX}", run / RUN_JSON
    if path.exists() and record.exists():
        if TrainingConfig.model_validate(json.loads(record.read_text())["config"]) != config:
            why = "it holds a run of another configuration: choose another --out, or delete it"
            raise InvalidField("reproduce velocity", "out", run.name, why)
        return run
    train(
        config,
        run,
        folder,
        more=more,
        resume=True,
        ranks=alone(device),
        on_progress=lambda at: show(
            config.name, at.step, at.steps, f"{at.linear_m_s:.3f} m/s {at.angular_rad_s:.4f} rad/s"
        ),
    )
    return run


def _evaluate(
    method: str, config: TrainingConfig, run: Path, scenarios: list[Scenario], cache: HeldOutCache
) -> VelocityRun:
    model = bundle.load(run / f"{config.name}{bundle.SUFFIX}")
    record = json.loads((run / RUN_JSON).read_text())
    figures, tracks = _held_out_figures(model, scenarios, cache)
    row = {
        "method": method,
        "seed": config.recipe.seed,
        "updates": record["step"],
        "commit": record["commit"],
        "torch": record["torch"],
        "curve": [{name: value for name, value in point.items() if name != "cpu_s"} for point in record["curve"]],
    }
    return VelocityRun(row | figures, tracks, record["cpu_s"] / record["step"])


def _held_out_figures(
    model: Bundle, scenarios: list[Scenario], cache: HeldOutCache
) -> tuple[dict[str, Any], list[Track]]:
    spikes, neurons, tracks = 0, 0, []
    for scenario in scenarios:
        track, (scenario_spikes, scenario_neurons) = follow(model, cache.path(scenario), scenario)
        tracks.append(track)
        spikes, neurons = spikes + scenario_spikes, neurons + scenario_neurons
    figures = {
        "parameters": model.info.parameters,
        "digest": model.digest,
        "firing_rate": spikes / neurons if neurons else None,
        "groups": summaries(tracks),
        "recordings": {f"{track.group}: {track.name}": summary([track]) for track in tracks},
    }
    return figures, tracks


def default_model_figures(experiment: Experiment, folder: Path) -> dict[str, Any] | None:
    """The figures of the default model on the same scenarios; None if it uses another window or canonical grid.

    The default model was trained longer than the methods, and on none of MVSEC's trajectories.

    Args:
        experiment: whose scenarios `reproduce` has simulated.
        folder: holds the simulated sequences.
    """
    model = models.find(models.DEFAULT)
    own, wanted = model.config, experiment.config.model
    if (own.window, own.canonical) != (wanted.window, wanted.canonical):
        return None
    figures, _ = _held_out_figures(model, experiment.scenarios(), HeldOutCache(folder, wanted))
    made_by = model.metadata.made_by
    return figures | {"updates": made_by and made_by.updates, "program": made_by and made_by.program}


def contrast_figures(experiment: Experiment, folder: Path) -> dict[str, dict[str, Any]]:
    """The angular figures of contrast maximisation by group, from a few instants of each scenario.

    Args:
        experiment: whose scenarios `reproduce` has simulated.
        folder: holds the simulated sequences.
    """
    cache = HeldOutCache(folder, experiment.config.model)
    found: dict[str, list[Track]] = {}
    for scenario in experiment.scenarios():
        if scenario.group in CONTRAST_GROUPS:
            instants = json.loads(cache.contrast_path(scenario).read_text())
            t_s = np.array([one["t_s"] for one in instants])
            truth, estimate = (
                np.array([[0.0, 0.0, 0.0, *one[name]] for one in instants]) for name in ("truth", "answer")
            )
            found.setdefault(scenario.group, []).append(Track(scenario.group, scenario.name, t_s, truth, estimate, 1))
    linear = ("re_v_l", "re_v_l_unfloored", "rmse_v_l_m_s", "r2_v_l", "median_direction_error_v_l_deg")
    return {group: summary(tracks) | dict.fromkeys(linear) for group, tracks in found.items()}


def results(experiment: Experiment, folder: Path, found: list[VelocityRun]) -> dict[str, Any]:
    """The results of an experiment as JSON values; only the cost ratios depend on the speed of the machine.

    Args:
        experiment: what was trained and evaluated.
        folder: holds the simulated sequences.
        found: all runs that `reproduce` yielded.
    """
    ours = {one.row["seed"]: one.cpu_s_per_update for one in found if one.row["method"] == "nve"}
    runs = []
    for one in found:
        reference = ours.get(one.row["seed"])
        runs.append(one.row | {"cost": one.cpu_s_per_update / reference if reference else None})
    tracks = found[0].tracks
    groups = dict.fromkeys(track.group for track in tracks)
    config = experiment.config.model_dump(mode="json")
    return {
        "quick": experiment.quick,
        "config": config | {"methods": {method: METHODS[method] for method in experiment.methods}},
        "drives": len(experiment.drives()),
        "no_mvsec": None if "mvsec" in groups else "MVSEC's poses are missing: --recordings DIR",
        "groups": {
            group: {
                "items": sum(track.group == group for track in tracks),
                "windows": sum(len(track.truth) // track.bins for track in tracks if track.group == group),
            }
            for group in groups
        },
        "runs": runs,
        "shipped": default_model_figures(experiment, folder),
        "blind": {"contrast maximisation": contrast_figures(experiment, folder), **blind_predictors(tracks)},
    }
