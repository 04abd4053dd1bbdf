"""Held-out scenarios and training drives of the velocity experiment, simulated once and cached in a folder.

No scene and no trajectory here is used for training by our configurations, whose seeds start at 1,000,000. The training
drives along MVSEC's trajectories are the exception: the methods of this experiment train on them.
"""

import hashlib
import json
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np

from neurove_core.config import ModelConfig
from neurove_core.evaluation.contrast import angular
from neurove_core.files import write_atomically
from neurove_core.sim.motion.trajectory import Trajectory, driving, hand_held, parse_trajectory
from neurove_core.sim.render.camera import named_camera
from neurove_core.sim.render.pixels import USUAL, PixelConfig
from neurove_core.sim.simulate import Simulation, simulate
from neurove_core.tasks import HERE, Pool
from neurove_core.training.data import DRIVE_S, FORMAT, Part, log_uniform, sequence_of, to_bytes, turning_part
from neurove_protocol.errors import InvalidField
from neurove_protocol.events import Events

CAMERA: Final = "davis346-half"
"""MVSEC's equidistant lens and sensor, with pixels of twice the size."""

HEIGHT_M: Final = 1.5
DAY1, DAY2 = "mvsec/outdoor_day1_odom.h5", "mvsec/outdoor_day2_odom.h5"
"""Files of MVSEC's poses in a folder of recordings."""

DAY1_TRAINED_S: Final = 150.0
"""Training uses this much of day 1. Evaluation uses the rest of its 257 s, from some seconds later."""

_DAY1_TESTED_S: Final = range(154, 245, 10)  # start of each evaluated drive
_DAY2_S: Final = 600.0
_TRAIN_DRIVES: Final = 48  # 38 of them along day 2
_HAND_SLOWED: Final = 4.0
_DRIVE_SLOWED: Final = (1.0, 2.0)
_QUICK_CAMERA: Final = "pinhole:24x18:75"
_QUICK_S: Final = 1.0
_WINDOW_US: Final = 50_000  # of contrast maximisation
_CONTRAST_INSTANTS: Final = 5  # per scenario
_KEY_POINTS: Final = 16  # positions of a trajectory that enter the key of its file


class Scenario(NamedTuple):
    """One simulated recording to evaluate on or to train on."""

    group: str
    name: str
    simulation: Simulation


GROUPS: Final = {
    "driving": "unseen streets at 1.5 m, MVSEC's lens",
    "heights": "unseen streets, camera at 0.3 to 2.5 m",
    "cameras": "unseen streets, five other lenses and resolutions",
    "pixels": "unseen streets, thresholds 0.12 and 0.5, and 50 times the noise (5 Hz per pixel)",
    "hand-held": "a camera waved about in unseen rooms, at a quarter of a wild hand's speed",
    "bare street": "unseen streets whose ground has no texture",
    "town 1": "24 s through an unseen town",
    "town 2": "24 s through another",
    "mvsec": "the unused part of MVSEC's outdoor_day1, its real way through unseen streets",
}
"""The groups of held-out scenarios and their descriptions."""

CONTRAST_GROUPS: Final = ("driving", "hand-held", "town 1", "town 2", "mvsec")
"""Groups on which contrast maximisation is evaluated too."""

_CAMERAS: Final = ("pinhole:86x65:75", "pinhole:128x96:90", "pinhole:172x130:55", "davis240c", "pinhole:320x240:62")
_PIXELS: Final = {
    "threshold 0.12": USUAL.model_copy(update={"threshold_on": 0.12, "threshold_off": 0.12}),
    "threshold 0.5": USUAL.model_copy(update={"threshold_on": 0.5, "threshold_off": 0.5}),
    "noise 5 Hz": USUAL.model_copy(update={"shot_noise_hz": 5.0}),
}


def held_out_scenarios(recordings: Path | None = None, *, quick: bool = False) -> list[Scenario]:
    """All held-out scenarios, group by group.

    Args:
        recordings: folder with MVSEC's poses; without them the group `mvsec` is missing.
        quick: only the first scenario of each group, one second long, with a tiny camera.
    """
    found = [
        *(_street_scenario("driving", f"seed {seed}", seed, 8.0) for seed in range(6000, 6006)),
        *(
            _street_scenario("heights", f"{h} m", 6010 + i, 6.0, height_m=h)
            for i, h in enumerate((0.3, 0.5, 0.8, 1.1, 2.0, 2.5))
        ),
        *(_street_scenario("cameras", name, 6000 + i, 6.0, camera=name) for i, name in enumerate(_CAMERAS)),
        *(
            _street_scenario("pixels", name, 6000 + i, 6.0, pixels=made)
            for i, (name, made) in enumerate(_PIXELS.items())
        ),
        *(_scenario("hand-held", f"seed {seed}", "room", _slowed_hand(seed, 6.0), seed) for seed in range(6020, 6024)),
        *(_scenario("bare street", f"seed {seed}", "bare-street", driving(seed, 6.0), seed) for seed in (6030, 6031)),
        *(_scenario(f"town {n}", f"seed {7000 + n}", "street", driving(7000 + n, 24.0), 7000 + n) for n in (1, 2)),
    ]
    if recordings is not None and (recordings / DAY1).exists():
        for start_s in _DAY1_TESTED_S:
            trajectory = _recorded_path(recordings / DAY1, start_s, 10.0)
            found.append(_scenario("mvsec", f"from {start_s} s", "street", trajectory, 8000 + start_s))
    if not quick:
        return found
    firsts = {scenario.group: scenario for scenario in reversed(found)}
    camera = named_camera(_QUICK_CAMERA, HEIGHT_M)
    return [
        scenario._replace(simulation=replace(scenario.simulation, lens=camera, duration_s=_QUICK_S))
        for scenario in reversed(firsts.values())
    ]


def training_drives(
    recordings: Path | None, seconds: float, motion_px: float, *, quick: bool = False
) -> list[Scenario]:
    """Simulated drives to train on besides the sequences of a configuration: MVSEC's day 2 and the first part of day 1.

    Source: NeuroVE, section IV-A: trained on outdoor_day2 and a subset of outdoor_day1, evaluated on the rest of it.

    Args:
        recordings: folder with the poses; without them the list is empty.
        seconds: length of each drive.
        motion_px: of the simulation, see `Simulation`.
        quick: only two drives, with a tiny camera.
    """
    if recordings is None or not all((recordings / day).exists() for day in (DAY1, DAY2)):
        return []
    count = 2 if quick else _TRAIN_DRIVES
    on_day1 = max(1, round(count * DAY1_TRAINED_S / (DAY1_TRAINED_S + _DAY2_S)))
    found: list[Scenario] = []
    for day, number, until_s in ((DAY1, on_day1, DAY1_TRAINED_S), (DAY2, count - on_day1, _DAY2_S)):
        for start in np.linspace(0, until_s - seconds - 1, number).round(2).tolist():
            trajectory = _recorded_path(recordings / day, start, seconds)
            name = f"{Path(day).stem} from {start:g} s"
            scenario = _scenario(
                "drives", name, "street", trajectory, 9000 + len(found), _QUICK_CAMERA if quick else CAMERA
            )
            found.append(scenario._replace(simulation=replace(scenario.simulation, motion_px=motion_px)))
    return found


def _slowed_hand(seed: int, seconds: float) -> Trajectory:
    """A fast hand-held trajectory at a quarter of its speed: about 87 deg/s RMS."""
    return Part(hand_held(seed, seconds), 0.0, _HAND_SLOWED, seconds)


def _turning_drive(seed: int, seconds: float) -> Trajectory:
    """The part with the most rotation out of three parts of a drive, slowed by up to 2: most driving is straight."""
    rng = np.random.default_rng((seed, 204))
    slowed = log_uniform(rng, _DRIVE_SLOWED)
    return turning_part(rng, driving(seed, DRIVE_S + seconds), slowed, seconds)


def _recorded_path(poses: Path, start_s: float, seconds: float) -> Trajectory:
    return parse_trajectory(f"{poses}?start={start_s:g}&flat=1", seconds)


def _street_scenario(
    group: str,
    name: str,
    seed: int,
    seconds: float,
    *,
    camera: str = CAMERA,
    height_m: float = HEIGHT_M,
    pixels: PixelConfig = USUAL,
) -> Scenario:
    return _scenario(group, name, "street", _turning_drive(seed, seconds), seed, camera, height_m, pixels)


def _scenario(
    group: str,
    name: str,
    scene: str,
    trajectory: Trajectory,
    seed: int,
    camera: str = CAMERA,
    height_m: float = HEIGHT_M,
    pixels: PixelConfig = USUAL,
) -> Scenario:
    return Scenario(group, name, simulate(scene, trajectory, named_camera(camera, height_m), pixels, seed=seed))


class HeldOutCache:
    """Simulated scenarios in a folder; missing ones are simulated.

    Args:
        folder: holds the scenarios of all model configurations.
        config: defines the windows and the canonical grid of the model.
    """

    def __init__(self, folder: Path, config: ModelConfig) -> None:
        self._folder, self._config = folder / "held-out", config

    def path(self, scenario: Scenario) -> Path:
        """The sequence file of a scenario, as `training.data.save` writes it."""
        return self._folder / f"{self._key(scenario)}.safetensors"

    def contrast_path(self, scenario: Scenario) -> Path:
        """The file with the estimates of contrast maximisation for a scenario."""
        return self._folder / f"{self._key(scenario)}.turning.json"

    def fill(self, wanted: list[Scenario], pool: Pool = HERE) -> Iterator[Scenario]:
        """Simulate the missing scenarios, and yield each scenario when its files exist.

        Args:
            wanted: scenarios.
            pool: where the simulations run.
        """
        self._folder.mkdir(parents=True, exist_ok=True)
        named = {f"{number} {scenario.group} {scenario.name}": scenario for number, scenario in enumerate(wanted)}
        jobs = {}
        for name, scenario in named.items():
            sequence = not self.path(scenario).exists()
            contrast = scenario.group in CONTRAST_GROUPS and not self.contrast_path(scenario).exists()
            if sequence or contrast:
                jobs[name] = _Missing(scenario.simulation, self._config, sequence, contrast)
            else:
                yield scenario
        for name, (sequence_file, contrast_file) in pool.run(_simulated, jobs):
            if sequence_file:
                write_atomically(self.path(named[name]), sequence_file)
            if contrast_file:
                write_atomically(self.contrast_path(named[name]), contrast_file)
            yield named[name]

    def _key(self, scenario: Scenario) -> str:
        simulation = scenario.simulation
        kind: list[Any] = [
            FORMAT,
            *scenario[:2],
            simulation.name,
            simulation.seed,
            simulation.duration_s,
            simulation.motion_px,
            simulation.lens.name,
        ]
        kind += [simulation.lens.info.model_dump(), simulation.lens.pitch_deg, simulation.pixels.model_dump()]
        kind += [self._config.window.model_dump(), self._config.canonical.model_dump()]
        position_m, _ = simulation.trajectory.pose(np.linspace(0, simulation.duration_s, _KEY_POINTS))
        kind += position_m.round(6).tolist()  # the name of a trajectory does not define it
        return hashlib.sha256(json.dumps(kind, sort_keys=True).encode()).hexdigest()[:16]


class _Missing(NamedTuple):
    """Which files of a scenario are missing."""

    simulation: Simulation
    config: ModelConfig
    sequence: bool
    contrast: bool


def _simulated(missing: _Missing) -> tuple[bytes, bytes]:
    """The files of the sequence and of the contrast maximisation; empty where it is there."""
    sequence = to_bytes(sequence_of(missing.simulation, missing.config)) if missing.sequence else b""
    contrast = json.dumps(list(_contrast_rates(missing.simulation))).encode() if missing.contrast else b""
    return sequence, contrast


def _contrast_rates(simulation: Simulation) -> Iterator[dict[str, Any]]:
    """Contrast maximisation at some instants: `truth` and its `answer` [rad/s], means over a window."""
    last_s = simulation.duration_s - _WINDOW_US / 1e6
    count = _CONTRAST_INSTANTS if simulation.duration_s > _QUICK_S else 1
    for start_s in np.linspace(0.5, last_s - 0.02, count).round(2).tolist():
        start_us = round(start_s * 1e6)
        events = Events.empty()
        for step in simulation.steps(start_s):
            events = Events.join([events, step.events])
            if step.stop_us >= start_us + _WINDOW_US:
                break
        events = events.span(0, int(events.t.searchsorted(start_us + _WINDOW_US)))
        t_s = start_s + (np.arange(20) + 0.5) * _WINDOW_US / 20e6
        truth = simulation.trajectory.twist(t_s)[:, 3:].mean(axis=0)
        try:
            answer = angular(events, simulation.lens.info).w_rad_s
        except InvalidField:  # almost no events: the camera is stationary
            answer = np.zeros(3)
        yield {"t_s": start_s, "truth": truth.tolist(), "answer": answer.tolist()}
