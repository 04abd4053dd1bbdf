"""Training sequences: for each window the event counts and the true twists of the camera.

A sequence is simulated once and kept in a safetensors file. The file is mapped into memory, so that a run reads only
the segments that it needs. The windows come from the same `windows.push` and look-up table that the service uses.
"""

import hashlib
import json
import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np
import safetensors
import safetensors.numpy
from numpy.typing import ArrayLike, NDArray

from neurove_core.config import CanonicalConfig, ModelConfig
from neurove_core.files import write_atomically
from neurove_core.geometry.camera import lookup_table
from neurove_core.ingest import windows
from neurove_core.ingest.windows import WindowsState
from neurove_core.io.errors import BrokenRecording
from neurove_core.sim.motion.generated import robot, rocked
from neurove_core.sim.motion.trajectory import Mounted, Trajectory, driving, hand_held, rotation
from neurove_core.sim.render.camera import Camera, named_camera
from neurove_core.sim.render.pixels import PixelConfig
from neurove_core.sim.simulate import Simulation
from neurove_core.sim.world.path import CameraPath
from neurove_core.sim.world.scene import named_scene
from neurove_core.tasks import HERE, Pool
from neurove_core.training.config import SINCE, DataConfig, TrainingConfig
from neurove_core.training.config import Span as Range
from neurove_protocol.errors import InvalidField

FORMAT: Final = 1
"""Version of the files; it is part of the name of their folder."""

DRIVE_S: Final = 120.0
"""Length of the drive that a sequence is a part of."""

HAND_HELD_SCENES: Final = ("room", "plain-room")
"""Scenes for a hand-held camera."""

_HANDS: Final = {"waved": (1.0, 1.0), "turned": (0.0, 1.0), "slid": (1.0, 0.0), "spun": (0.0, 1.0)}
"""Each motion of a hand-held camera: how much of the translation and of the rotation it has; `spun` is steady."""

_DEFAULT: Final = DataConfig()

_SAMPLES: Final = 4  # samples of the exact twist per bin; the bin has their mean


class Sequence(NamedTuple):
    """T consecutive windows of one camera."""

    counts: NDArray[np.uint8]  # (T, 2n, H, W)
    twists: NDArray[np.float32]  # (T, n, 6): vx vy vz per metre of camera height [1/s], wx wy wz [rad/s]; nan: unknown
    height_m: float
    name: str


@dataclass(frozen=True, slots=True)
class Part(Trajectory):
    """A part of a trajectory, at a fraction of its speed.

    Args:
        trajectory: the whole trajectory.
        start_s: start of the part in the trajectory.
        slowed: how many times slower the part is.
        duration_s: duration of the part; the trajectory must cover it.
    """

    trajectory: Trajectory
    start_s: float
    slowed: float
    duration_s: float

    @property
    def name(self) -> str:  # type: ignore[override]
        """Name of the trajectory, with start and speed."""
        return f"{self.trajectory.name} from {self.start_s:.1f} s, {self.slowed:.2f} times slower"

    def position_orientation(self, t_s: ArrayLike) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """See `Trajectory`."""
        return self.trajectory.position_orientation(self.start_s + self._within(t_s) / self.slowed)

    def twist(self, t_s: ArrayLike) -> NDArray[np.float64]:
        """See `Trajectory`."""
        return self.trajectory.twist(self.start_s + self._within(t_s) / self.slowed) / self.slowed


def check_names(config: DataConfig) -> None:
    """Check the names of scenes, motions and cameras that the sequences are drawn from.

    Raises:
        InvalidField: a name is unknown, or the mount of a camera is out of bounds.
    """
    for scene in _drawn(config.scenes):
        named_scene(scene)
    for hand in _drawn(config.hands):
        if hand not in _HANDS:
            raise InvalidField("training", "data.hands", hand, f"known motions: {', '.join(_HANDS)}")
    for name in _drawn(config.cameras):
        for height_m, pitch_deg, hfov_deg in zip(config.height_m, config.pitch_deg, config.hfov_deg, strict=True):
            named_camera(f"{name}:{hfov_deg:.2f}" if name.count(":") == 1 else name, height_m, pitch_deg)


def _drawn(shares: dict[str, float]) -> list[str]:
    return [name for name, share in shares.items() if share > 0]


def draw_simulation(config: DataConfig, index: int) -> Simulation:
    """Draw the simulation of sequence `index`; the same configuration and index give the same simulation."""
    rng = np.random.default_rng((config.seed, 201, index))
    seed = config.seed + index
    scene = _choice(rng, config.scenes)
    height_m, pitch_deg = log_uniform(rng, config.height_m), rng.uniform(*config.pitch_deg)
    camera = _camera(rng, config, height_m, float(pitch_deg))
    on = log_uniform(rng, config.threshold)
    pixels = PixelConfig(
        threshold_on=on,
        threshold_off=on * float(rng.uniform(*config.off_ratio)),
        threshold_sigma=float(rng.uniform(*config.threshold_sigma)),
        refractory_us=int(rng.uniform(*config.refractory_us)),
        leak_hz=float(rng.uniform(*config.leak_hz)),
        shot_noise_hz=log_uniform(rng, config.shot_noise_hz),
        cutoff_hz=log_uniform(rng, config.cutoff_hz),
        eps=log_uniform(rng, config.eps),
    )
    hand_held_scene = scene in HAND_HELD_SCENES
    slowed = log_uniform(rng, config.slowed_hand if hand_held_scene else config.slowed_drive)
    trajectory = _hand_held(rng, config, seed, slowed) if hand_held_scene else _drive(rng, config, seed, slowed)
    mounted = Mounted(trajectory, camera.height_m, camera.pitch_deg)
    simulation = Simulation(scene, named_scene(scene), mounted, camera, pixels, seed, config.seconds)
    return replace(simulation, motion_px=config.motion_px)


def stored_grid(config: TrainingConfig) -> CanonicalConfig:
    """The grid of stored counts: the canonical grid, or with `data.subcells` = 2 one that is twice as fine."""
    return config.model.canonical.model_copy(update={"subcells": config.data.subcells}).fine


def sequence_of(simulation: Simulation, config: ModelConfig, grid: CanonicalConfig | None = None) -> Sequence:
    """Split a simulation into windows as the service does, with the mean exact twist of each bin.

    Args:
        simulation: of the sequence.
        config: of the model; its windows.
        grid: of the counts, see `stored_grid`; by default that of the model's subcells.
    """
    grid = grid or config.canonical.fine
    height_m = simulation.lens.height_m
    lut = lookup_table(grid, simulation.sensor, simulation.lens.info)
    state, counts = WindowsState(), []
    for step in simulation.steps():
        pushed = windows.push(step.events, step.stop_us, state, lut, config.window, grid)
        state = pushed.state
        counts += [window.counts for window in pushed.windows]
    twists = true_twists(simulation.trajectory, len(counts), config)
    twists[..., :3] /= height_m
    name = f"{simulation.name} {simulation.lens.name} h={height_m:.2f} m pitch={simulation.lens.pitch_deg:.1f} deg"
    return Sequence(np.stack(counts), twists.astype(np.float32), height_m, name)


def true_twists(trajectory: CameraPath, count: int, config: ModelConfig) -> NDArray[np.float64]:
    """Compute the mean exact twist (count, n, 6) [m/s, rad/s] of each bin of the first `count` windows."""
    bins = count * config.window.bins
    t_s = (np.arange(bins * _SAMPLES, dtype=np.float64) + 0.5) * (config.window.bin_us / _SAMPLES * 1e-6)
    twist: NDArray[np.float64] = trajectory.twist(t_s).reshape(count, config.window.bins, _SAMPLES, 6).mean(axis=2)
    return twist


class Cache:
    """Simulated sequences of a configuration in a folder; only missing sequences are simulated.

    Args:
        folder: shared by all configurations; each has its own folder inside.
        config: of the run.
    """

    def __init__(self, folder: Path, config: TrainingConfig) -> None:
        self._config = config
        data = config.data.model_dump(exclude={"sequences", "recordings", "subcells"})
        for name in SINCE:  # sequences that were simulated before a setting existed stay valid
            if name in data and getattr(config.data, name) == getattr(_DEFAULT, name):
                del data[name]
        kind: list[Any] = [FORMAT, data]
        kind += [config.model.window.model_dump(), stored_grid(config).model_dump()]
        self.folder = folder / hashlib.sha256(json.dumps(kind, sort_keys=True).encode()).hexdigest()[:16]

    def path(self, index: int) -> Path:
        """File of a sequence."""
        return self.folder / f"{index:06d}.safetensors"

    def missing(self) -> list[int]:
        """Indices of the sequences that do not exist yet."""
        return [index for index in range(self._config.data.sequences) if not self.path(index).exists()]

    def fill(self, pool: Pool = HERE, share: tuple[int, int] = (0, 1)) -> Iterator[str]:
        """Simulate the missing sequences, and yield the name of each one when it is done.

        Several processes and several runs may fill one folder at once, because files are written atomically.

        Args:
            pool: where the simulations run.
            share: (i, n): only the i-th of n equal shares of all sequences.

        Raises:
            FailedTasks: some sequences could not be simulated; all others are there.
        """
        self.folder.mkdir(parents=True, exist_ok=True)
        missing = [index for index in self.missing() if index % share[1] == share[0]]
        jobs = {f"sequence {index}": (self._config, index) for index in missing}
        paths = {f"sequence {index}": self.path(index) for index in missing}
        for task, (name, content) in pool.run(_simulated, jobs):
            write_atomically(paths[task], content)
            yield name

    def open(self) -> "Sequences":
        """Open all simulated sequences of the configuration.

        Raises:
            BrokenRecording: a file is missing or invalid.
        """
        return Sequences(self.paths())

    def paths(self) -> list[Path]:
        """Files of all simulated sequences, whether they exist or not."""
        return [self.path(index) for index in range(self._config.data.sequences)]


def _simulated(job: tuple[TrainingConfig, int]) -> tuple[str, bytes]:
    """Name and content of a sequence of a configuration."""
    config, index = job
    sequence = sequence_of(draw_simulation(config.data, index), config.model, stored_grid(config))
    return sequence.name, to_bytes(sequence, sparse=config.data.subcells > 1)


def save(sequence: Sequence, path: Path, *, sparse: bool = False) -> None:
    """Write a sequence to a file, atomically; see `to_bytes`."""
    write_atomically(path, to_bytes(sequence, sparse=sparse))


def to_bytes(sequence: Sequence, *, sparse: bool = False) -> bytes:
    """The content of the file of a sequence.

    Args:
        sequence: to write.
        sparse: store only counts above 0: `cells`, their flat index in a window, `values`, and `starts` (T + 1), the
            first of each window. A fine grid, where few cells have events, takes about a tenth of the space.
    """
    arrays: dict[str, NDArray[Any]] = {"counts": sequence.counts, "twists": sequence.twists}
    metadata = {"height_m": repr(sequence.height_m), "name": sequence.name}
    if sparse:
        flat = arrays.pop("counts").reshape(len(sequence.counts), -1)
        window, cells = np.nonzero(flat)
        starts = np.searchsorted(window, np.arange(len(flat) + 1)).astype(np.int64)
        arrays |= {"cells": cells.astype(np.uint32), "values": flat[window, cells], "starts": starts}
        metadata["shape"] = json.dumps(sequence.counts.shape)
    return safetensors.numpy.save(arrays, metadata)


class Span(NamedTuple):
    """Consecutive windows of a file: all of them, or [start, stop)."""

    path: Path
    start: int = 0
    stop: int | None = None


class Sequences:
    """Sequences in memory-mapped files; counts are read on demand.

    Args:
        paths: of the files, or spans of their windows.

    Raises:
        BrokenRecording: a file is missing, or `save` did not write it.
    """

    def __init__(self, paths: Iterable[Path | Span]) -> None:
        self.paths = list(paths)
        self._files: list[_Stored] = []
        self._first: list[int] = []
        self.twists: list[NDArray[np.float32]] = []  # each (T, n, 6)
        self.height_m: list[float] = []
        for one in self.paths:
            path, start, stop = one if isinstance(one, Span) else Span(one)
            try:
                file: Any = safetensors.safe_open(path, "numpy")
                metadata = file.metadata()
                twists, height_m = file.get_tensor("twists"), float(metadata["height_m"])
                starts = file.get_tensor("starts") if "shape" in metadata else None
                shape = file.get_slice("counts").get_shape() if starts is None else json.loads(metadata["shape"])
            except (OSError, KeyError, TypeError, ValueError, safetensors.SafetensorError) as error:
                raise BrokenRecording(path, "its header", f"not a training sequence: {error}") from None
            if len(shape) != 4 or shape[0] != len(twists) or shape[1] != 2 * twists.shape[1] or not height_m > 0:
                why = f"counts {tuple(shape)} do not match twists {twists.shape}"
                raise BrokenRecording(path, "its header", why)
            self._files.append(_Stored(file, tuple(shape), starts))
            self._first.append(start)
            self.twists.append(twists[start:stop])
            self.height_m.append(height_m)

    def __len__(self) -> int:
        return len(self._files)

    def counts(self, index: int, start: int, stop: int) -> NDArray[np.uint8]:
        """Counts (stop - start, 2n, H, W) of windows start to stop of a sequence."""
        first = self._first[index]
        return self._files[index].counts(first + start, first + stop)


class _Stored(NamedTuple):
    """The counts in a file of `save`."""

    file: Any
    shape: tuple[int, ...]  # (T, 2n, H, W)
    starts: NDArray[np.int64] | None  # of each window, in a sparse file

    def counts(self, start: int, stop: int) -> NDArray[np.uint8]:
        """Counts (stop - start, 2n, H, W) of these windows."""
        if self.starts is None:
            dense: NDArray[np.uint8] = self.file.get_slice("counts")[start:stop]
            return dense
        stop = min(stop, self.shape[0])
        first, last = self.starts[start], self.starts[stop]
        cells = self.file.get_slice("cells")[first:last].astype(np.int64)
        window = np.repeat(np.arange(stop - start), np.diff(self.starts[start : stop + 1]))
        found = np.zeros((stop - start, int(np.prod(self.shape[1:]))), np.uint8)
        found[window, cells] = self.file.get_slice("values")[first:last]
        return found.reshape(stop - start, *self.shape[1:])


def _hand_held(rng: np.random.Generator, config: DataConfig, seed: int, slowed: float) -> Trajectory:
    """Draw a trajectory in a room: waved, only turned, only moved, or spun about a random axis."""
    motion = _choice(rng, config.hands)
    if motion == "spun":
        axis = rng.standard_normal(3) * config.spun_axis
        rate = log_uniform(rng, config.spun_rad_s) * axis / np.linalg.norm(axis)
        wx, wy, wz = (float(one) for one in rate)
        return rotation(wx, wy, wz, config.seconds)
    moved, turned = _HANDS[motion]
    return Part(hand_held(seed, config.seconds, moved, turned), 0.0, slowed, config.seconds)


def _drive(rng: np.random.Generator, config: DataConfig, seed: int, slowed: float) -> Trajectory:
    """Draw a drive: of a car or, where the configuration asks for it, of a robot, and with or without rocking."""
    drive: Trajectory
    if config.robots and rng.uniform() < config.robots:
        drive = robot(seed, config.seconds, config.robot_m_s, config.robot_rad_s)
    else:
        drive = turning_part(rng, driving(seed, DRIVE_S + config.seconds), slowed, config.seconds)
    if config.rocked and rng.uniform() < config.rocked:
        drive = rocked(drive, seed, log_uniform(rng, config.rocked_rad_s), config.seconds)
    return drive


def turning_part(rng: np.random.Generator, drive: Trajectory, slowed: float, seconds: float) -> Part:
    """Draw three parts of a drive and return the one that turns most, because most of a drive is straight."""
    parts = [Part(drive, float(start_s), slowed, seconds) for start_s in rng.uniform(0, DRIVE_S, 3)]
    t_s = np.linspace(0, seconds, 100)
    return max(parts, key=lambda part: float(np.abs(part.twist(t_s)[:, 4]).mean()))


def _choice(rng: np.random.Generator, shares: dict[str, float]) -> str:
    names = sorted(shares)
    weights = np.array([shares[name] for name in names])
    return str(rng.choice(names, p=weights / weights.sum()))


def log_uniform(rng: np.random.Generator, span: Range) -> float:
    """Draw a number from a span, with a uniform logarithm."""
    return math.exp(rng.uniform(math.log(span[0]), math.log(span[1])))


def _camera(rng: np.random.Generator, config: DataConfig, height_m: float, pitch_deg: float) -> Camera:
    name = _choice(rng, config.cameras)
    hfov_deg = rng.uniform(*config.hfov_deg)
    if name.count(":") == 1:
        name = f"{name}:{hfov_deg:.2f}"
    return named_camera(name, height_m, pitch_deg)
