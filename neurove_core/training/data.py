"""Sequences to learn from: per window the counts that the service would see, and how the camera truly moved.

A sequence is simulated once and kept in a file: safetensors, mapped into memory, so that a run needs no more of it than
the segments it reads. The windows come from the very `windows.push` and look-up table that serve.
"""

import concurrent.futures
import hashlib
import json
import math
import multiprocessing
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np
import safetensors
import safetensors.numpy
from numpy.typing import ArrayLike, NDArray

from neurove_core.config import ModelConfig
from neurove_core.files import write_atomically
from neurove_core.geometry.camera import lookup_table
from neurove_core.ingest import windows
from neurove_core.ingest.windows import WindowsState
from neurove_core.io.errors import BrokenRecording
from neurove_core.sim.motion.trajectory import Mounted, Trajectory, driving, hand_held, rotation
from neurove_core.sim.render.camera import Camera, named_camera
from neurove_core.sim.render.pixels import PixelConfig
from neurove_core.sim.simulate import Simulation
from neurove_core.sim.world.path import CameraPath
from neurove_core.sim.world.scene import named_scene
from neurove_core.training.config import DataConfig, Span, TrainingConfig

FORMAT: Final = 1
"""Of the files; part of their folder's name."""

DRIVE_S: Final = 120.0
"""A sequence is a part of a drive of this length."""

HAND_HELD_SCENES: Final = ("room", "plain-room")
"""Scenes through which nothing drives."""

_SAMPLES: Final = 4  # of the exact twist in each bin, whose mean is the bin's


class Sequence(NamedTuple):
    """T consecutive windows of one camera."""

    counts: NDArray[np.uint8]  # (T, 2n, H, W)
    twists: NDArray[np.float32]  # (T, n, 6): vx vy vz per metre of camera height [1/s], wx wy wz [rad/s]; nan: unknown
    height_m: float
    name: str


@dataclass(frozen=True, slots=True)
class Part(Trajectory):
    """A trajectory from some time on, at a fraction of its speed.

    Args:
        trajectory: that it is a part of.
        start_s: where it begins.
        slowed: how many times slower it is.
        duration_s: how long it lasts; the trajectory must last so long.
    """

    trajectory: Trajectory
    start_s: float
    slowed: float
    duration_s: float

    @property
    def name(self) -> str:  # type: ignore[override]
        """Of the trajectory, and which part of it."""
        return f"{self.trajectory.name} from {self.start_s:.1f} s, {self.slowed:.2f} times slower"

    def position_orientation(self, t_s: ArrayLike) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """See `Trajectory`."""
        return self.trajectory.position_orientation(self.start_s + self._within(t_s) / self.slowed)

    def twist(self, t_s: ArrayLike) -> NDArray[np.float64]:
        """See `Trajectory`."""
        return self.trajectory.twist(self.start_s + self._within(t_s) / self.slowed) / self.slowed


def draw_simulation(config: DataConfig, index: int) -> Simulation:
    """The simulation that sequence `index` of a configuration is; the same each time."""
    rng = np.random.default_rng((config.seed, 201, index))
    seed = config.seed + index
    scene = _choice(rng, config.scenes)
    height_m, pitch_deg = log_uniform(rng, config.height_m), rng.uniform(*config.pitch_deg)
    camera = _camera(rng, config, height_m, float(pitch_deg))
    on = log_uniform(rng, config.threshold)
    pixels = PixelConfig(
        threshold_on=on,
        threshold_off=on * float(rng.uniform(0.85, 1.15)),
        threshold_sigma=float(rng.uniform(*config.threshold_sigma)),
        refractory_us=int(rng.uniform(*config.refractory_us)),
        leak_hz=float(rng.uniform(*config.leak_hz)),
        shot_noise_hz=log_uniform(rng, config.shot_noise_hz),
        cutoff_hz=log_uniform(rng, config.cutoff_hz),
        eps=log_uniform(rng, config.eps),
    )
    hand_held_scene = scene in HAND_HELD_SCENES
    slowed = log_uniform(rng, config.slowed_hand if hand_held_scene else config.slowed_drive)
    trajectory: Trajectory
    if hand_held_scene:
        trajectory = _hand_held(rng, config, seed, slowed)
    else:
        trajectory = turning_part(rng, driving(seed, DRIVE_S + config.seconds), slowed, config.seconds)
    mounted = Mounted(trajectory, camera.height_m, camera.pitch_deg)
    simulation = Simulation(scene, named_scene(scene), mounted, camera, pixels, seed, config.seconds)
    return replace(simulation, motion_px=config.motion_px)


def sequence_of(simulation: Simulation, config: ModelConfig) -> Sequence:
    """The windows of a simulation as the service cuts them, with the mean exact twist of each bin."""
    height_m = simulation.lens.height_m
    lut = lookup_table(config.canonical, simulation.sensor, simulation.lens.info)
    state, counts = WindowsState(), []
    for step in simulation.steps():
        pushed = windows.push(step.events, step.stop_us, state, lut, config.window, config.canonical)
        state = pushed.state
        counts += [window.counts for window in pushed.windows]
    twists = true_twists(simulation.trajectory, len(counts), config)
    twists[..., :3] /= height_m
    name = f"{simulation.name} {simulation.lens.name} h={height_m:.2f} m pitch={simulation.lens.pitch_deg:.1f} deg"
    return Sequence(np.stack(counts), twists.astype(np.float32), height_m, name)


def true_twists(trajectory: CameraPath, count: int, config: ModelConfig) -> NDArray[np.float64]:
    """Mean exact twist (count, n, 6) [m/s, rad/s] of each bin of the first windows of a trajectory."""
    bins = count * config.window.bins
    t_s = (np.arange(bins * _SAMPLES, dtype=np.float64) + 0.5) * (config.window.bin_us / _SAMPLES * 1e-6)
    twist: NDArray[np.float64] = trajectory.twist(t_s).reshape(count, config.window.bins, _SAMPLES, 6).mean(axis=2)
    return twist


class Cache:
    """Simulated sequences in a folder; what is missing is made, what is there is read.

    Args:
        folder: of all configurations; each has its own folder within.
        config: whose sequences these are.
    """

    def __init__(self, folder: Path, config: TrainingConfig) -> None:
        self._config = config
        data = config.data.model_dump(exclude={"sequences", "recordings"})
        if config.data.spun_axis == DataConfig().spun_axis:
            del data["spun_axis"]  # older than this setting is what was simulated as its default says
        kind: list[Any] = [FORMAT, data]
        kind += [config.model.window.model_dump(), config.model.canonical.model_dump()]
        self.folder = folder / hashlib.sha256(json.dumps(kind, sort_keys=True).encode()).hexdigest()[:16]

    def path(self, index: int) -> Path:
        """The file of a sequence."""
        return self.folder / f"{index:06d}.safetensors"

    def missing(self) -> list[int]:
        """The sequences that are not there yet."""
        return [index for index in range(self._config.data.sequences) if not self.path(index).exists()]

    def fill(self, workers: int = 1) -> Iterator[str]:
        """Make all that is missing; yields the name of each as it is done.

        Several processes, or several runs at once, may fill one folder: a file is whole or it is not there.
        """
        self.folder.mkdir(parents=True, exist_ok=True)
        jobs = [(self._config, index, self.path(index)) for index in self.missing()]
        if workers <= 1:
            yield from map(_make, jobs)
            return
        context = multiprocessing.get_context("spawn")  # torch's threads do not survive a fork
        with concurrent.futures.ProcessPoolExecutor(workers, mp_context=context) as pool:
            for done in concurrent.futures.as_completed([pool.submit(_make, job) for job in jobs]):
                yield done.result()

    def open(self) -> "Sequences":
        """All simulated sequences of the configuration.

        Raises:
            BrokenRecording: a file is not what this module wrote.
        """
        return Sequences(self.paths())

    def paths(self) -> list[Path]:
        """The files of all simulated sequences, there or not."""
        return [self.path(index) for index in range(self._config.data.sequences)]


def _make(job: tuple[TrainingConfig, int, Path]) -> str:
    config, index, path = job
    sequence = sequence_of(draw_simulation(config.data, index), config.model)
    save(sequence, path)
    return sequence.name


def save(sequence: Sequence, path: Path) -> None:
    """Write a sequence's file; it is whole or it is not there."""
    arrays: dict[str, NDArray[Any]] = {"counts": sequence.counts, "twists": sequence.twists}
    about = {"height_m": repr(sequence.height_m), "name": sequence.name}
    write_atomically(path, safetensors.numpy.save(arrays, about))


class Sequences:
    """Sequences in files, mapped: a slice is read when it is asked for.

    Args:
        paths: of the files.

    Raises:
        BrokenRecording: one is missing, or not what `save` writes.
    """

    def __init__(self, paths: list[Path]) -> None:
        self.paths = paths
        self._files: list[Any] = []
        self.twists: list[NDArray[np.float32]] = []  # each (T, n, 6)
        self.height_m: list[float] = []
        for path in paths:
            try:
                file: Any = safetensors.safe_open(path, "numpy")
                about = file.metadata()
                twists, height_m = file.get_tensor("twists"), float(about["height_m"])
                shape = file.get_slice("counts").get_shape()
            except (OSError, KeyError, TypeError, ValueError, safetensors.SafetensorError) as error:
                raise BrokenRecording(path, "its header", f"no sequence to learn from: {error}") from None
            if len(shape) != 4 or shape[0] != len(twists) or shape[1] != 2 * twists.shape[1] or not height_m > 0:
                why = f"counts {tuple(shape)} do not go with twists {twists.shape}"
                raise BrokenRecording(path, "its header", why)
            self._files.append(file)
            self.twists.append(twists)
            self.height_m.append(height_m)

    def __len__(self) -> int:
        return len(self._files)

    def counts(self, index: int, start: int, stop: int) -> NDArray[np.uint8]:
        """Windows start to stop of a sequence (stop - start, 2n, H, W)."""
        found: NDArray[np.uint8] = self._files[index].get_slice("counts")[start:stop]
        return found


def _hand_held(rng: np.random.Generator, config: DataConfig, seed: int, slowed: float) -> Trajectory:
    """A camera that is waved about, only turned, or only moved; or one that spins on a random axis."""
    way = _choice(rng, config.hands)
    if way == "spun":
        axis = rng.standard_normal(3) * config.spun_axis
        rate = log_uniform(rng, config.spun_rad_s) * axis / np.linalg.norm(axis)
        wx, wy, wz = (float(one) for one in rate)
        return rotation(wx, wy, wz, config.seconds)
    moved, turned = {"waved": (1.0, 1.0), "turned": (0.0, 1.0), "slid": (1.0, 0.0)}[way]
    return Part(hand_held(seed, config.seconds, moved, turned), 0.0, slowed, config.seconds)


def turning_part(rng: np.random.Generator, drive: Trajectory, slowed: float, seconds: float) -> Part:
    """Of three parts of a drive the one that turns most: most of any drive goes straight on."""
    parts = [Part(drive, float(start_s), slowed, seconds) for start_s in rng.uniform(0, DRIVE_S, 3)]
    t_s = np.linspace(0, seconds, 100)
    return max(parts, key=lambda part: float(np.abs(part.twist(t_s)[:, 4]).mean()))


def _choice(rng: np.random.Generator, shares: dict[str, float]) -> str:
    names = sorted(shares)
    weights = np.array([shares[name] for name in names])
    return str(rng.choice(names, p=weights / weights.sum()))


def log_uniform(rng: np.random.Generator, span: Span) -> float:
    """A number between these two, drawn so that its logarithm is uniform."""
    return math.exp(rng.uniform(math.log(span[0]), math.log(span[1])))


def _camera(rng: np.random.Generator, config: DataConfig, height_m: float, pitch_deg: float) -> Camera:
    name = _choice(rng, config.cameras)
    hfov_deg = rng.uniform(*config.hfov_deg)
    if name.count(":") == 1:
        name = f"{name}:{hfov_deg:.2f}"
    return named_camera(name, height_m, pitch_deg)
