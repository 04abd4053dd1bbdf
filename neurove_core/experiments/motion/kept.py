"""Simulated recordings whose events are kept in files, so that another model is evaluated without simulating again."""

import hashlib
import json
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from neurove_core.experiments.motion.sets import Item
from neurove_core.files import atomic_path
from neurove_core.geometry.motion import Twists
from neurove_core.io.recording import CHUNK_EVENTS, EventsOnly
from neurove_core.sim.simulate import Simulation
from neurove_core.tasks import HERE, Pool
from neurove_protocol import CameraInfo, Events, Sensor
from neurove_protocol.errors import InvalidField
from neurove_protocol.imu import Imu

_FORMAT: Final = 1  # of the files, and of what the simulator makes of the same values
_KEY_POINTS: Final = 16  # positions of a trajectory that enter the key of its file


@dataclass(frozen=True)
class KeptRecording(EventsOnly):
    """The events of a simulation from a file, with the truth of the simulation; see `Recording`."""

    simulation: Simulation
    file: Path

    @property
    def name(self) -> str:
        """Name of the simulation."""
        return self.simulation.name

    @property
    def sensor(self) -> Sensor:
        """The pixel array of the camera."""
        return self.simulation.sensor

    @property
    def endless(self) -> bool:
        """False."""
        return False

    @property
    def streams(self) -> tuple[str, ...]:
        """Those of the simulation."""
        return self.simulation.streams

    def imu(self) -> Iterator[Imu]:
        """The samples of the simulated unit, if there is one."""
        return self.simulation.imu()

    def camera(self, stream: str) -> CameraInfo:
        """The lens and its height above the ground."""
        return self.simulation.camera(stream)

    def twists(self) -> Twists | None:
        """The exact twists of the camera."""
        return self.simulation.twists()

    def chunks(self) -> Iterator[Events]:
        """All events; see `Recording`."""
        rows: NDArray[np.uint32] = np.load(self.file, mmap_mode="r")
        for first in range(0, len(rows), CHUNK_EVENTS):
            t, place = np.array(rows[first : first + CHUNK_EVENTS]).T
            pixel, p = place >> 1, place & 1
            yield Events.from_columns(t, pixel % self.sensor.width, pixel // self.sensor.width, p)


def fill(items: list[Item], folder: Path, pool: Pool = HERE) -> Iterator[str]:
    """Simulate the items whose events are not in the folder, and yield the name of each one when it is done.

    Args:
        items: what is wanted.
        folder: holds the events.
        pool: where the simulations run.

    Raises:
        InvalidField: a file cannot be written.
    """
    missing = {f"{one.group}: {one.name}": one for one in items if not _file(one.simulation, folder).exists()}
    for name, rows in pool.run(_rows_of, {name: one.simulation for name, one in missing.items()}):
        _write(rows, _file(missing[name].simulation, folder))
        yield name


def kept(item: Item, folder: Path) -> KeptRecording:
    """The recording of an item; it is simulated and written into the folder if it is not there.

    The file does not depend on the inertial unit, whose samples are made anew. It has two uint32 per event: the time
    [us], and twice the number of the pixel plus the polarity.

    Raises:
        InvalidField: the file cannot be written.
    """
    file = _file(item.simulation, folder)
    if not file.exists():
        _write(_rows_of(item.simulation), file)
    return KeptRecording(item.simulation, file)


def _rows_of(simulation: Simulation) -> NDArray[np.uint32]:
    """The events (N, 2) as the file has them."""
    width = simulation.sensor.width
    parts = [np.zeros((0, 2), np.uint32)]
    for events in simulation.chunks():
        place = (events.y.astype(np.uint32) * width + events.x) * 2 + events.p
        parts.append(np.stack([events.t.astype(np.uint32), place], axis=1))
    return np.concatenate(parts)


def _write(rows: NDArray[np.uint32], file: Path) -> None:
    try:
        file.parent.mkdir(parents=True, exist_ok=True)
        with atomic_path(file) as part, part.open("wb") as stream:
            np.save(stream, rows)
    except OSError as error:
        raise InvalidField("reproduce", "data", str(file.parent), error.strerror or str(error)) from None


def _file(simulation: Simulation, folder: Path) -> Path:
    return folder / f"{_key(simulation)}.npy"


def _key(simulation: Simulation) -> str:
    position_m, rotation = simulation.trajectory.pose(np.linspace(0, simulation.duration_s, _KEY_POINTS))
    kind: list[Any] = [
        _FORMAT,
        simulation.name,
        simulation.seed,
        simulation.duration_s,
        simulation.motion_px,
        simulation.lens.name,
        simulation.lens.info.model_dump(),
        simulation.lens.pitch_deg,
        simulation.pixels.model_dump(),
        position_m.round(6).tolist(),  # the name of a trajectory does not define it
        rotation.round(6).tolist(),
    ]
    return hashlib.sha256(json.dumps(kind, sort_keys=True).encode()).hexdigest()[:16]
