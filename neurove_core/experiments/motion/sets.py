"""The simulated sets of the motion experiment: who moves how, and where.

No model of ours is trained on any of these scenes and trajectories, and no constant is chosen on them.
"""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np

from neurove_core import models
from neurove_core.experiments.velocity.held_out import HEIGHT_M, held_out_scenarios
from neurove_core.sim.inertial import ImuConfig
from neurove_core.sim.motion.trajectory import Trajectory, driving, parse_trajectory, rotation, slider
from neurove_core.sim.render.camera import DEFAULT_CAMERA, named_camera
from neurove_core.sim.simulate import Simulation, simulate
from neurove_core.sim.source import simulation_of
from neurove_core.training.data import DRIVE_S, Part, turning_part
from neurove_protocol.errors import InvalidField


class Item(NamedTuple):
    """One simulated recording of a set."""

    group: str
    name: str
    simulation: Simulation


GROUPS: Final = {
    "forward": "constant speed along a street, camera at 0.4, 1 and 1.5 m",
    "turning": "turning in place at 0.5 rad/s, a street and a room",
    "trajectories": "recorded trajectories of hands, drones and robots, in a room",
    "hand-held": "a camera waved about in rooms, at a quarter of a wild hand's speed",
    "slow": "ten drives at 0.2 to 3 m/s, camera at 0.31 to 2.4 m",
    "streets": "drives that turn, camera at 1.5 m",
    "cameras": "drives that turn, five other lenses and resolutions",
    "heights": "drives that turn, camera at 0.3 to 2.5 m",
    "drives": "the ten drives of heldout.txt, 24 s each",
    "aided": "the same with the samples of a simulated gyroscope (bias 0.01, noise 0.003 rad/s) and accelerometer",
}
"""The sets, cheapest first, with their descriptions."""

REAL: Final = "real"
"""The set of the real recordings, which are not items."""

SPEEDS_M_S: Final = (0.3, 0.5, 1.0, 2.0, 4.0)
FORWARD_HEIGHTS_M: Final = (0.4, 1.0, 1.5)
TURNING_RAD_S: Final = 0.5
SLOW_M_S: Final = (0.2, 0.27, 0.37, 0.5, 0.67, 0.91, 1.2, 1.6, 2.2, 3.0)
"""Mean speeds of the slow drives."""

TRAJECTORIES: Final = (
    "poster_6dof.csv?start=20",
    "rpg_desk2.txt?start=5",
    "tum_vie_desk.txt?start=5",
    "upenn_stamped_groundtruth_of_indoorflying1.txt?start=15",
    "upenn_stamped_groundtruth_of_indoorflying2.txt?start=15",
    "upenn_stamped_groundtruth_of_indoorflying3.txt?start=15",
)
"""Files of poses in the folder `trajectories` of the recordings, and where their excerpts start [s]."""

_SLOW_HEIGHTS_M: Final = (1.35, 0.55, 2.0, 0.31, 0.88, 2.4, 0.42, 1.6, 0.7, 1.1)  # as those of heldout.txt
_OF_VELOCITY: Final = {"streets": "driving", "cameras": "cameras", "heights": "heights", "hand-held": "hand-held"}
"""Sets of the velocity experiment under their names there."""

_SECONDS: Final = 6.0
_FORWARD_S, _TURNING_S = 3.0, 3.0
_USUAL_SPEED_M_S: Final = 8.0  # of a drive, as a first guess
_QUICK_CAMERA: Final = "pinhole:24x18:75"
_QUICK_S: Final = 1.0


def items(groups: Sequence[str], recordings: Path | None = None, *, quick: bool = False) -> list[Item]:
    """The recordings of some sets.

    Args:
        groups: names of GROUPS, or REAL.
        recordings: folder that holds `trajectories`; without it the set of that name is empty.
        quick: only the first recording of each set, one second long, with a tiny camera.

    Raises:
        InvalidField: a set is unknown.
    """
    for group in groups:
        if group not in (*GROUPS, REAL):
            raise InvalidField("reproduce motion", "--sets", group, f"known are {', '.join((*GROUPS, REAL))}")
    found: list[Item] = []
    for group in GROUPS:
        if group in groups:
            own = list(_items_of(group, recordings))
            found += [_quickened(item) for item in own[:1]] if quick else own
    return found


def _items_of(group: str, recordings: Path | None) -> Iterator[Item]:
    trajectory: Trajectory
    if group == "forward":
        for h, height_m in enumerate(FORWARD_HEIGHTS_M):
            for v, speed in enumerate(SPEEDS_M_S):
                name = f"{speed:g} m/s at {height_m:g} m"
                trajectory = slider(0.0, 0.0, speed, _FORWARD_S)
                yield Item(group, name, _simulated("street", trajectory, height_m, 5100 + 10 * h + v))
    elif group == "turning":
        for s, scene in enumerate(("street", "room")):
            for rate in (TURNING_RAD_S, -TURNING_RAD_S):
                trajectory = rotation(0.0, rate, 0.0, _TURNING_S)
                yield Item(group, f"{scene}, {rate:+g} rad/s", _simulated(scene, trajectory, 1.0, 5130 + s))
    elif group == "trajectories":
        for number, name in enumerate(TRAJECTORIES):
            file = None if recordings is None else recordings / "trajectories" / name
            if file is not None and Path(str(file).partition("?")[0]).is_file():
                trajectory = parse_trajectory(str(file), _SECONDS)
                yield Item(group, name.partition(".")[0], _simulated("room", trajectory, HEIGHT_M, 5140 + number))
    elif group == "slow":
        for number, (speed, height_m) in enumerate(zip(SLOW_M_S, _SLOW_HEIGHTS_M, strict=True)):
            trajectory = _slow_drive(5010 + number, speed)
            yield Item(
                group, f"{speed:g} m/s at {height_m:g} m", _simulated("street", trajectory, height_m, 5010 + number)
            )
    elif group in ("drives", "aided"):
        unit = ImuConfig() if group == "aided" else None
        for url in (Path(models.__file__).parent / "heldout.txt").read_text().split():
            yield Item(group, url.removeprefix("sim://"), replace(simulation_of(url), imu_config=unit))
    else:
        for scenario in held_out_scenarios():
            if scenario.group == _OF_VELOCITY[group]:
                yield Item(group, scenario.name, scenario.simulation)


def _simulated(scene: str, trajectory: Trajectory, height_m: float, seed: int) -> Simulation:
    return simulate(scene, trajectory, named_camera(DEFAULT_CAMERA, height_m), seed=seed)


def _slow_drive(seed: int, speed_m_s: float) -> Trajectory:
    """A drive, slowed to this mean speed; its rates of turning shrink alike."""
    rng = np.random.default_rng((seed, 80))
    slowed = _USUAL_SPEED_M_S / speed_m_s
    part = turning_part(rng, driving(seed, DRIVE_S + _SECONDS), slowed, _SECONDS)
    mean_m_s = float(np.linalg.norm(part.twist(np.linspace(0, _SECONDS, 100))[:, :3], axis=1).mean())
    # a part that is slowed less is longer, so that its mean speed is not exactly the wanted one
    return Part(part.trajectory, part.start_s, max(1.0, slowed * mean_m_s / speed_m_s), _SECONDS)


def _quickened(item: Item) -> Item:
    lens = named_camera(_QUICK_CAMERA, item.simulation.lens.height_m)
    return item._replace(simulation=replace(item.simulation, lens=lens, duration_s=_QUICK_S))
