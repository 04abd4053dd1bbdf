"""The simulator as a recording: events of a camera that moves through a scene, with its exact twists."""

import itertools
import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from neurove_core.geometry.motion import Twists
from neurove_core.io.recording import EventsOnly, in_chunks
from neurove_core.sim import inertial
from neurove_core.sim.motion.trajectory import Mounted, Trajectory
from neurove_core.sim.render.camera import Camera, Rays, rays_of
from neurove_core.sim.render.cull import Candidates, candidates_of
from neurove_core.sim.render.interval import GRIDS, run_tiles, tile_speeds
from neurove_core.sim.render.pixels import (
    USUAL,
    PixelConfig,
    Pixels,
    PixelState,
    add_noise,
    low_pass,
    make_pixels,
    settled_state,
    sort_events,
)
from neurove_core.sim.render.render import render_all
from neurove_core.sim.render.views import Backdrop, World, views_of
from neurove_core.sim.world.path import CameraPath
from neurove_core.sim.world.scene import Scene, named_scene
from neurove_core.sim.world.textures import make_textures
from neurove_protocol.camera import CameraInfo
from neurove_protocol.errors import InvalidField
from neurove_protocol.events import Events, Sensor
from neurove_protocol.imu import Imu

INTERVAL_US: Final = 20_000
"""Time that is simulated at once; the events of one interval are a chunk."""

MOTION_PX: Final = 0.5
"""Greatest motion of a pixel between two of its renders."""

TRUTH_HZ: Final = 1000
"""Sampling rate of `Simulation.twists`."""


class Step(NamedTuple):
    """One interval: its events, and the twists of the camera at the times of all renders."""

    start_us: int
    stop_us: int
    events: Events
    twists: Twists  # exact, at the renders; the last one is at the end of the interval
    renders: float  # number of rendered images, in whole sensors; tiles have their own rates

    def shifted(self, shift_us: int) -> "Step":
        """The same step with all times shifted."""
        events, twists = (part._replace(t=part.t + shift_us) for part in (self.events, self.twists))
        return Step(self.start_us + shift_us, self.stop_us + shift_us, events, twists, self.renders)  # type: ignore[arg-type]


def stop_us(trajectory: CameraPath) -> int:
    """End of the last whole interval of a trajectory, where an endless simulation goes on with the next one [us]."""
    return math.floor(trajectory.duration_s * 1e6) // INTERVAL_US * INTERVAL_US


class View(NamedTuple):
    """The image of the camera at one instant; see `Simulation.view`."""

    light: NDArray[np.float32]  # (N,) log intensity
    depth: NDArray[np.float32]  # (N,) along z [m]; infinite where there is only sky


@dataclass(frozen=True, slots=True, eq=False)
class Simulation(EventsOnly):
    """A camera that moves through a scene along a trajectory; see `Recording`.

    Each reading starts anew and gives the same events for the same seed. If the simulation lasts longer than its
    trajectory, it continues along the next trajectory in another scene of the same kind.
    """

    scene: str
    make_scene: Callable[[CameraPath, int], Scene]
    trajectory: CameraPath  # of the mounted camera
    lens: Camera
    pixels: PixelConfig
    seed: int
    duration_s: float  # infinite for one without end
    next_trajectory: Callable[[int], CameraPath] | None = None  # trajectory number 1, 2, ...; None: there is only one
    imu_config: inertial.ImuConfig | None = None  # of the inertial unit; None: the camera has none
    motion_px: float = MOTION_PX  # a larger bound is faster, and less exact in the times of events; training uses one

    @property
    def name(self) -> str:
        """Name: scene, trajectory and seed."""
        return f"{self.scene} {self.trajectory.name} {self.seed}"

    @property
    def sensor(self) -> Sensor:
        """The pixel array of the camera."""
        return self.lens.info.sensor

    @property
    def endless(self) -> bool:
        """Whether the simulation never ends."""
        return math.isinf(self.duration_s)

    @property
    def streams(self) -> tuple[str, ...]:
        """Events, imu if there is a unit, and twists. An endless simulation has no twists here; `steps` has them."""
        return ("events", *["imu"] * (self.imu_config is not None), *["twists"] * (not self.endless))

    def camera(self, stream: str) -> CameraInfo:
        """The lens and its height above the ground."""
        return self.lens.info.model_copy(update={"stream": stream})

    def chunks(self) -> Iterator[Events]:
        """All events from t = 0 on; see `Recording`."""
        for step in self.steps():
            yield from in_chunks(step.events)

    def twists(self) -> Twists | None:
        """The exact twists of the camera at TRUTH_HZ; None for an endless simulation."""
        if self.endless:
            return None
        t_us = np.arange(0, round(self.duration_s * 1e6) + 1, 1_000_000 // TRUTH_HZ, dtype=np.int64)
        return Twists(t_us, self.trajectory.twist(t_us / 1e6))

    def imu(self) -> Iterator[Imu]:
        """The samples of the inertial unit in the optical frame, with gravity, bias and noise; see `inertial`."""
        if self.imu_config is None:
            return
        if self.next_trajectory is None:
            stop = round(min(self.duration_s, self.trajectory.duration_s) * 1e6)
            yield from inertial.samples(self.trajectory, stop, self.imu_config, self.seed)
            return
        shift_us, trajectory = 0, self.trajectory
        for number in itertools.count(1):
            end_us = stop_us(trajectory)
            yield from inertial.samples(trajectory, end_us, self.imu_config, self.seed, shift_us)
            shift_us, trajectory = shift_us + end_us, self.next_trajectory(number)

    def steps(self, start_s: float = 0.0) -> Iterator[Step]:
        """All intervals with their events and truth, including intervals without events.

        Args:
            start_s: time to start at; the pixels are settled at that time, as they are at 0 by default.
        """
        if self.next_trajectory is None or start_s:
            yield from _Playback(self, self.trajectory, self.seed, start_s).run(round(start_s * 1e6), self.duration_s)
            return
        shift_us, trajectory = 0, self.trajectory
        for number in itertools.count(1):
            end_us = stop_us(trajectory)
            for step in _Playback(self, trajectory, self.seed + number - 1).run(0, end_us * 1e-6):
                yield step.shifted(shift_us)
            shift_us, trajectory = shift_us + end_us, self.next_trajectory(number)

    def view(self, t_s: float) -> View:
        """Render the image at a time, with the pixels in the order of `rays_of`."""
        playback = _Playback(self, self.trajectory, self.seed, t_s)
        return View(playback.state.light, playback.depth)


class _Playback:
    """One reading of a simulation: its state from interval to interval."""

    def __init__(self, simulation: Simulation, trajectory: CameraPath, seed: int, t_s: float = 0.0) -> None:
        self._simulation, self._trajectory = simulation, trajectory
        self._rays: Rays = rays_of(simulation.lens.info)
        self._margin = float(max(self._rays.step_x.max(), self._rays.step_y.max()))
        self._textures = make_textures(seed)
        self._scene = simulation.make_scene(trajectory, seed)
        self._grid_of_tiles = tuple(int(side.max()) + 1 for side in (self._rays.tile_row, self._rays.tile_column))
        self._pixels: Pixels = make_pixels(simulation.pixels, self._rays.x.size, simulation.seed)
        self._weights: dict[tuple[int, int], NDArray[np.float64]] = {}
        self.depth = np.full(self._rays.x.size, np.inf, np.float32)
        self.state: PixelState = settled_state(self._pixels, self._first_render(t_s))

    def _first_render(self, t_s: float) -> NDArray[np.float32]:
        world, when = self._world(t_s), np.array([t_s])
        position, rotation = self._places(when)
        candidates = self._candidates(world, position, rotation)
        views = views_of(world.panels.take(candidates.kept), position, rotation)
        light = np.empty(self._rays.x.size, np.float32)
        backdrop = Backdrop.of(world, self._simulation.pixels.eps)
        render_all(backdrop, self._rays, candidates, views[0], rotation[0], light, self.depth)
        return light

    def _candidates(self, world: World, position: NDArray[np.float64], rotation: NDArray[np.float64]) -> Candidates:
        """The panels that each tile may see from some poses in an interval; its ends are among them."""
        views = views_of(world.panels, position, rotation)
        return candidates_of(views, self._rays.box, world.sky.far_m, self._margin)

    def _places(self, t_s: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        position, rotation = self._trajectory.pose(t_s)
        return np.ascontiguousarray(position), np.ascontiguousarray(
            rotation
        )  # one memory layout avoids a second compilation

    def _world(self, t_s: float) -> World:
        return World(self._scene.near(t_s), self._textures, self._scene.sky)

    def run(self, start_us: int, end_s: float) -> Iterator[Step]:
        """Simulate all intervals up to a time."""
        end_us = math.inf if math.isinf(end_s) else round(end_s * 1e6)
        while start_us < end_us:
            stop_us = int(min(start_us + INTERVAL_US, end_us))
            yield self.step(start_us, stop_us)
            start_us = stop_us

    def step(self, start_us: int, stop_us: int) -> Step:
        """Simulate the next interval."""
        span_us, config = stop_us - start_us, self._simulation.pixels
        parts, steps = self._parts(start_us, stop_us)
        when = (start_us + span_us * np.arange(steps + 1) / steps) * 1e-6
        position, rotation = self._places(when)
        world = self._world(start_us * 1e-6)
        candidates = self._candidates(world, position[[0, steps // 2, steps]], rotation[[0, steps // 2, steps]])
        views = views_of(world.panels.take(candidates.kept), position, rotation)
        weights = self._weights_of(span_us, steps)
        found = run_tiles(
            Backdrop.of(world, config.eps),
            self._rays,
            candidates,
            views,
            rotation,
            parts,
            float(span_us),
            weights,
            self._pixels.mismatch,
            self.state,
            self.depth,
        )
        found = add_noise(self._pixels, start_us, stop_us, found)
        found = sort_events(found, start_us, span_us, config.refractory_us, self.state.last_us)
        t, pixel = found.t[: found.n] + np.int64(start_us), found.pixel[: found.n]
        events = Events(t, self._rays.column[pixel], self._rays.row[pixel], found.p[: found.n])
        rendered = when[steps // int(parts.max()) :: steps // int(parts.max())]
        twists = Twists(np.rint(rendered * 1e6).astype(np.int64), self._trajectory.twist(rendered))
        sizes = np.diff(self._rays.first)
        return Step(start_us, stop_us, events, twists, float((parts * sizes).sum() / sizes.sum()))

    def _parts(self, start_us: int, stop_us: int) -> tuple[NDArray[np.int64], int]:
        """The number of steps of each tile in the interval, and the number of steps of the grid.

        Each number of steps divides that of the grid. It follows from the greatest motion in a tile and its neighbours,
        because objects may enter the tile from them.
        """
        speeds = np.zeros(self._rays.first.size - 1)
        ends = np.array([start_us, (start_us + stop_us) / 2, stop_us]) * 1e-6
        tile_speeds(self._rays, self.depth, self._trajectory.twist(ends), speeds)
        grid = np.zeros((self._grid_of_tiles[0] + 2, self._grid_of_tiles[1] + 2))
        row, column = self._rays.tile_row + 1, self._rays.tile_column + 1
        grid[row, column] = speeds
        around = np.max([grid[row + i, column + j] for i in (-1, 0, 1) for j in (-1, 0, 1)], axis=0)
        needed = around * (stop_us - start_us) * 1e-6 / self._simulation.motion_px
        steps = next((steps for steps in GRIDS if steps >= needed.max()), GRIDS[-1])
        counts = np.arange(1, steps + 1)
        divisors = counts[steps % counts == 0]
        return divisors[np.minimum(divisors.searchsorted(needed), divisors.size - 1)], steps

    def _weights_of(self, span_us: int, steps: int) -> NDArray[np.float64]:
        if (span_us, steps) not in self._weights:
            cutoff_hz = self._simulation.pixels.cutoff_hz
            rows = [low_pass(cutoff_hz, span_us / count) for count in range(1, steps + 1)]
            self._weights[span_us, steps] = np.array([rows[0], *rows])
        return self._weights[span_us, steps]


def simulate(
    scene: str,
    trajectory: Trajectory,
    camera: Camera,
    pixels: PixelConfig = USUAL,
    *,
    seed: int = 0,
    seconds: float | None = None,
) -> Simulation:
    """Create a simulation; it renders while it is read.

    Args:
        scene: one of `scene.SCENES`.
        trajectory: of a level camera at height 0; the camera's mount is added.
        camera: see `camera.named_camera`.
        pixels: configuration of the pixels.
        seed: of the scene and of the pixels.
        seconds: duration; by default that of the trajectory.

    Raises:
        InvalidField: the scene is unknown, the seed is below 0, or `seconds` exceeds the trajectory.
    """
    make_scene = named_scene(scene)
    if seed < 0:
        raise InvalidField("simulation", "seed", seed, "must be 0 or more")
    duration_s = trajectory.duration_s if seconds is None else seconds
    if not 0 < duration_s <= trajectory.duration_s:
        raise InvalidField(
            "simulation", "seconds", seconds, f"must be above 0 and at most the trajectory's {trajectory.duration_s:g}"
        )
    mounted = Mounted(trajectory, camera.height_m, camera.pitch_deg)
    return Simulation(scene, make_scene, mounted, camera, pixels, seed, duration_s)
