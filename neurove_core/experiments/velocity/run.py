"""The paper's velocity experiment (sections IV-C and IV-D): methods trained by one recipe, judged alike.

A trained method is a folder with its bundle, so that an interrupted experiment goes on where it was.
"""

import json
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np

from neurove_core import models
from neurove_core.experiments.velocity.held_out import CM_GROUPS, Item, Kept, drives, items
from neurove_core.experiments.velocity.tracks import Track, blind, follow, summaries, summary
from neurove_core.models import bundle
from neurove_core.models.bundle import Bundle
from neurove_core.networks.snn_ang import CHANNELS
from neurove_core.training import config as configs
from neurove_core.training import data
from neurove_core.training.config import TrainingConfig
from neurove_core.training.loop import RUN_JSON, train
from neurove_protocol.errors import InvalidField

METHODS: Final[dict[str, dict[str, Any]]] = {
    "nve": {},
    "nve-wo": {"network": {"diffusion": False}},
    "ann": {"kind": "ann", "network": {"precision": "float32"}},
    "snn-ang": {"kind": "snn-ang", "network": {"channels": CHANNELS, "precision": "float32"}},
}
"""What of the model's configuration each method changes; nothing else differs between them."""

Show = Callable[[str, int, int, str], None]
"""What is being done, how far, of how much, and a word on it."""


class Plan(NamedTuple):
    """What an experiment trains and judges."""

    config: TrainingConfig
    methods: tuple[str, ...]
    seeds: range
    recordings: Path | None  # where MVSEC's poses lie
    quick: bool = False


class Trained(NamedTuple):
    """One method from one seed, judged."""

    row: dict[str, Any]  # as it goes into the results
    tracks: list[Track]
    cpu_s_per_update: float  # of this machine, so it is only told as a ratio


def config_of(base: TrainingConfig, method: str, seed: int) -> TrainingConfig:
    """The configuration of a method: the base's in everything but what METHODS says, and the seed.

    Raises:
        InvalidField: there is no such method.
    """
    if method not in METHODS:
        raise InvalidField("reproduce velocity", "methods", method, f"known are {', '.join(METHODS)}")
    told = base.model_dump()
    changes = METHODS[method]
    told["model"] |= {name: value for name, value in changes.items() if name != "network"}
    told["model"]["network"] |= changes.get("network", {})
    told["recipe"]["seed"] = base.recipe.seed + seed
    return TrainingConfig.model_validate(told | {"name": f"{method}-{seed}"})


def base_config(source: str | None = None, steps: int | None = None, *, quick: bool = False) -> TrainingConfig:
    """The recipe of all methods.

    Args:
        source: a configuration's file or name; by default `driving`, or `velocity-quick`.
        steps: so many updates, not those of the configuration.
        quick: see Plan.

    Raises:
        InvalidField: there is no such configuration, or it or `steps` is wrong.
    """
    found = configs.load(source or ("velocity-quick" if quick else "driving"))
    if steps is None:
        return found
    if steps < 1:
        raise InvalidField("reproduce velocity", "steps", steps, "must be at least 1")
    return found.model_copy(update={"recipe": found.recipe.model_copy(update={"steps": steps, "cycles": 1})})


def reproduce(plan: Plan, folder: Path, out: Path, show: Show, workers: int = 1) -> Iterator[Trained]:
    """Make the sequences, then train and judge each method from each seed; what is there already is not made again.

    Args:
        plan: what to do.
        folder: of the simulated sequences.
        out: folder of the trained methods, each in its own.
        show: told how far it is.
        workers: processes that simulate the configuration's sequences.

    Raises:
        InvalidField: a method is unknown, or a folder holds another run. BrokenRecording: a sequence is broken.
    """
    if not plan.methods or not len(plan.seeds):
        raise InvalidField("reproduce velocity", "seeds", len(plan.seeds), "must be at least 1")
    wanted = [(method, config_of(plan.config, method, seed)) for seed in plan.seeds for method in plan.methods]
    cache = data.Cache(folder, plan.config)
    total = plan.config.data.sequences
    for done, name in enumerate(cache.fill(workers), total - len(cache.missing()) + 1):
        show("simulated", done, total, name)
    ways = drives(plan.recordings, plan.config.data.seconds, plan.config.data.motion_px, quick=plan.quick)
    judged_on = items(plan.recordings, quick=plan.quick)
    kept = Kept(folder, plan.config.model)
    for done, item in enumerate(kept.fill([*ways, *judged_on]), 1):
        show("held out", done, len(ways) + len(judged_on), f"{item.group} {item.name}")
    more = [kept.path(item) for item in ways]
    for method, config in wanted:
        run = trained(config, out, folder, more, show)
        yield _judged(method, config, run, judged_on, kept)


def trained(config: TrainingConfig, out: Path, folder: Path, more: Sequence[Path], show: Show) -> Path:
    """The folder of a trained method; it is trained where it is not yet, or not to the end.

    Raises:
        InvalidField: the folder holds a run of another configuration. BadModel: so does its checkpoint.
    """
    run = out / (f"{config.name}-mvsec" if more else config.name)
    path, about = run / f"{config.name}{bundle.SUFFIX}", run / RUN_JSON
    if path.exists() and about.exists():
        if TrainingConfig.model_validate(json.loads(about.read_text())["config"]) != config:
            why = "it holds a run of another configuration: choose another --out, or delete it"
            raise InvalidField("reproduce velocity", "out", run.name, why)
        return run
    train(
        config,
        run,
        folder,
        more=more,
        resume=True,
        on_progress=lambda at: show(
            config.name, at.step, at.steps, f"{at.linear_m_s:.3f} m/s {at.angular_rad_s:.4f} rad/s"
        ),
    )
    return run


def _judged(method: str, config: TrainingConfig, run: Path, judged_on: list[Item], kept: Kept) -> Trained:
    model = bundle.load(run / f"{config.name}{bundle.SUFFIX}")
    about = json.loads((run / RUN_JSON).read_text())
    figures, tracks = _figures(model, judged_on, kept)
    row = {
        "method": method,
        "seed": config.recipe.seed,
        "updates": about["step"],
        "commit": about["commit"],
        "torch": about["torch"],
        "curve": [{name: value for name, value in point.items() if name != "cpu_s"} for point in about["curve"]],
    }
    return Trained(row | figures, tracks, about["cpu_s"] / about["step"])


def _figures(model: Bundle, judged_on: list[Item], kept: Kept) -> tuple[dict[str, Any], list[Track]]:
    spikes, neurons, tracks = 0, 0, []
    for item in judged_on:
        track, fires = follow(model, kept.path(item), item)
        tracks.append(track)
        spikes, neurons = spikes + fires[0], neurons + fires[1]
    told = {
        "parameters": model.info.parameters,
        "digest": model.digest,
        "firing_rate": spikes / neurons if neurons else None,
        "groups": summaries(tracks),
        "recordings": {f"{track.group}: {track.name}": summary([track]) for track in tracks},
    }
    return told, tracks


def shipped(plan: Plan, folder: Path) -> dict[str, Any] | None:
    """What the default model reaches on the same items, which `reproduce` has made; None where it sees another grid.

    It learned longer than the methods, and from none of MVSEC's ways.
    """
    model = models.find(models.DEFAULT)
    if (model.config.window, model.config.canonical) != (plan.config.model.window, plan.config.model.canonical):
        return None
    figures, _ = _figures(model, items(plan.recordings, quick=plan.quick), Kept(folder, plan.config.model))
    made_by = model.metadata.made_by
    return figures | {"updates": made_by and made_by.updates, "program": made_by and made_by.program}


def turning(plan: Plan, folder: Path) -> dict[str, dict[str, Any]]:
    """The angular figures of contrast maximisation, group by group, at a few instants of each item."""
    kept = Kept(folder, plan.config.model)
    found: dict[str, list[Track]] = {}
    for item in items(plan.recordings, quick=plan.quick):
        if item.group in CM_GROUPS:
            told = json.loads(kept.turning_path(item).read_text())
            t_s = np.array([one["t_s"] for one in told])
            truth, said = (np.array([[0.0, 0.0, 0.0, *one[name]] for one in told]) for name in ("truth", "answer"))
            found.setdefault(item.group, []).append(Track(item.group, item.name, t_s, truth, said, 1))
    linear = ("re_v_l", "re_v_l_unfloored", "rmse_v_l_m_s", "r2_v_l", "median_direction_error_v_l_deg")
    return {group: summary(tracks) | dict.fromkeys(linear) for group, tracks in found.items()}


def results(plan: Plan, folder: Path, found: list[Trained]) -> dict[str, Any]:
    """All that is told of an experiment; nothing in it depends on how fast the machine is but ratios.

    Args:
        plan: of the experiment.
        folder: of the simulated sequences.
        found: what `reproduce` gave, all of it.
    """
    ours = {one.row["seed"]: one.cpu_s_per_update for one in found if one.row["method"] == "nve"}
    runs = []
    for one in found:
        reference = ours.get(one.row["seed"])
        runs.append(one.row | {"cost": one.cpu_s_per_update / reference if reference else None})
    tracks = found[0].tracks
    groups = dict.fromkeys(track.group for track in tracks)
    config = plan.config.model_dump(mode="json")
    return {
        "quick": plan.quick,
        "config": config | {"methods": {method: METHODS[method] for method in plan.methods}},
        "drives": len(drives(plan.recordings, plan.config.data.seconds, plan.config.data.motion_px, quick=plan.quick)),
        "no_mvsec": None if "mvsec" in groups else "MVSEC's poses are not there: --recordings DIR",
        "groups": {
            group: {
                "items": sum(track.group == group for track in tracks),
                "windows": sum(len(track.truth) // track.bins for track in tracks if track.group == group),
            }
            for group in groups
        },
        "runs": runs,
        "shipped": shipped(plan, folder),
        "blind": {"contrast maximisation": turning(plan, folder), **blind(tracks)},
    }
