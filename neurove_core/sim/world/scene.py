"""Scenes by name: the surroundings of a trajectory."""

from collections.abc import Callable
from typing import Final, Protocol

import numpy as np
from numpy.typing import NDArray

from neurove_core.sim.world.panels import ENDLESS, SKY_COLUMNS, SKY_ROWS, Panels, Sky, box, panel, upright
from neurove_core.sim.world.path import CameraPath
from neurove_core.sim.world.street import BARE, CORRIDOR, STREET, Street
from neurove_protocol.errors import InvalidField


class Scene(Protocol):
    """The surroundings of a trajectory."""

    sky: Sky

    def near(self, t_s: float) -> Panels:
        """All panels that may be visible at a time; times must not go backwards."""


class FixedScene:
    """A scene that does not change."""

    def __init__(self, panels: Panels, sky: Sky) -> None:
        self._panels, self.sky = panels, sky

    def near(self, t_s: float) -> Panels:
        """All panels."""
        return self._panels


def street(trajectory: CameraPath, seed: int) -> Scene:
    """Ground with lane lines, houses on both sides with gaps and side streets, parked cars, poles, a skyline."""
    return Street(trajectory, seed, STREET, _skyline(seed, STREET.far))


def bare_street(trajectory: CameraPath, seed: int) -> Scene:
    """The same street on a ground of one colour without lines: the ground makes no events."""
    return Street(trajectory, seed, BARE, _skyline(seed, BARE.far))


def corridor(trajectory: CameraPath, seed: int) -> Scene:
    """Ground, ceiling, close walls, and boxes along them."""
    return Street(trajectory, seed, CORRIDOR, Sky(_flat(0.1), 0.1, CORRIDOR.far))


def room(trajectory: CameraPath, seed: int) -> Scene:
    """A textured room around the whole trajectory, with boards and boxes along its walls.

    The room is built around the first two minutes of a longer trajectory.
    """
    t_s = np.linspace(0, min(trajectory.duration_s, 120.0), 2400)
    position = trajectory.pose(t_s)[0]
    rng = np.random.default_rng((seed, 103))
    low, high = position.min(0) - rng.uniform(1.6, 2.6, 3), position.max(0) + rng.uniform(1.6, 2.6, 3)
    floor, ceiling = max(0.0, float(position[:, 1].max()) + 0.6), min(-2.6, float(position[:, 1].min()) - 0.9)
    corners = [
        np.array(corner) for corner in ((low[0], low[2]), (high[0], low[2]), (high[0], high[2]), (low[0], high[2]))
    ]
    middle = np.array([(low[0] + high[0]) / 2, 0, (low[2] + high[2]) / 2])
    right, ahead = np.array([1.0, 0, 0]), np.array([0, 0, 1.0])
    size = (float(high[0] - low[0]), float(high[2] - low[2]))
    height = floor - ceiling
    down = np.array([0, floor, 0])
    parts = [
        panel(middle + down, right, ahead, size, "brick", repeat_m=3.0),
        panel(middle + np.array([0, ceiling, 0]), right, ahead, size, "plaster", repeat_m=3.0),
    ]
    for i in range(4):
        start, end = corners[i], corners[(i + 1) % 4]
        texture = ("plaster", "posters", "brick", "plaster")[i]
        parts.append(_lowered(upright(start, end, height, texture, repeat_m=3.5), floor))
        parts += [_lowered(part, floor) for part in _furniture(rng, start, end, height)]
    return FixedScene(Panels.join(parts), Sky(_flat(0.3), 0.3, 200.0))


def plain_room(trajectory: CameraPath, seed: int) -> Scene:
    """A room of plain walls around the whole trajectory, with a few flat shapes on them: few features except edges.

    The room is built around the first two minutes of a longer trajectory.
    """
    t_s = np.linspace(0, min(trajectory.duration_s, 120.0), 2400)
    position = trajectory.pose(t_s)[0]
    rng = np.random.default_rng((seed, 106))
    low, high = position.min(0) - rng.uniform(0.8, 4.0, 3), position.max(0) + rng.uniform(0.8, 4.0, 3)
    middle, size, light = (low + high) / 2, high - low, rng.uniform(0.5, 1.0)
    axes = np.eye(3)
    parts = []
    for axis in range(3):
        u, v = axes[axis - 2], axes[axis - 1]
        sides = (float(size[axis - 2]), float(size[axis - 1]))
        for side in (-1.0, 1.0):
            centre = middle + side * size[axis] / 2 * axes[axis]
            parts.append(panel(centre, u, v, sides, "paint", repeat_m=3.0, gain=light * rng.uniform(0.8, 1.0)))
            parts += _shapes(rng, centre, -side * axes[axis], u, v, sides)
    return FixedScene(Panels.join(parts), Sky(_flat(0.3), 0.3, 200.0))


def _shapes(
    rng: np.random.Generator,
    centre: NDArray[np.float64],
    inward: NDArray[np.float64],
    u: NDArray[np.float64],
    v: NDArray[np.float64],
    sides: tuple[float, float],
) -> list[Panels]:
    """Create randomly rotated rectangles on a wall: about one per square metre, at most forty.

    Each rectangle lies a little further from the wall than the previous one, so that overlapping ones are not coplanar.
    """
    count = min(40, 1 + int(rng.poisson(sides[0] * sides[1] * rng.uniform(0.5, 1.5))))
    parts = []
    for k in range(count):
        on_wall = centre + (0.01 + 0.002 * k) * inward
        at = on_wall + rng.uniform(-0.45, 0.45) * sides[0] * u + rng.uniform(-0.45, 0.45) * sides[1] * v
        angle = rng.uniform(0, np.pi)
        along, across = np.cos(angle) * u + np.sin(angle) * v, np.cos(angle) * v - np.sin(angle) * u
        wide, high = (float(length) for length in rng.uniform(0.08, 0.7, 2))
        texture = "paint" if rng.uniform() < 0.8 else "posters"
        parts.append(panel(at, along, across, (wide, high), texture, repeat_m=1.0, gain=rng.uniform(0.05, 0.6)))
    return parts


def _furniture(
    rng: np.random.Generator, start: NDArray[np.float64], end: NDArray[np.float64], height: float
) -> list[Panels]:
    """Create boards on a wall and boxes in front of it."""
    length = float(np.linalg.norm(end - start))
    along = (end - start) / length
    inward = np.array([-along[1], along[0]])
    parts = []
    for k in range(max(1, int(length / 1.6))):
        at = start + along * min(length - 0.8, 0.8 + 1.6 * k)
        wide, high = rng.uniform(0.4, 0.7), rng.uniform(0.6, 1.2)
        a, b = at - along * wide + inward * 0.03, at + along * wide + inward * 0.03
        board = upright(a, b, high, "posters", repeat_m=2.0, offset=(rng.uniform(), rng.uniform()))
        parts.append(_lowered(board, -rng.uniform(0.8, max(0.9, height - 1.4))))
        if rng.uniform() < 0.6:
            size = (rng.uniform(0.3, 0.8), rng.uniform(0.3, 0.6), rng.uniform(0.4, 1.3))
            where = at + inward * rng.uniform(0.4, 0.9) + along * rng.uniform(-0.4, 0.4)
            texture = str(rng.choice(("posters", "metal", "brick")))
            parts.append(box(where, along, size, texture, repeat_m=1.5, offset=(rng.uniform(), 0)))
    return parts


def _lowered(panels: Panels, down_m: float) -> Panels:
    return panels._replace(centre=panels.centre + np.array([0.0, down_m, 0.0]))


def wall(trajectory: CameraPath, seed: int, distance_m: float = 1.0) -> Scene:
    """One endless textured plane, perpendicular to the first viewing direction, at a distance [m] from the camera."""
    position, rotation = trajectory.pose(np.zeros(1))
    right, down, ahead = rotation[0].T
    size, offset = (2 * ENDLESS, 2 * ENDLESS), tuple(np.random.default_rng((seed, 104)).uniform(size=2))
    plane = panel(position[0] + ahead * distance_m, right, down, size, "posters", repeat_m=1.2, offset=offset)
    return FixedScene(plane, Sky(_flat(0.3), 0.3, 1000.0))


SCENES: Final[dict[str, Callable[[CameraPath, int], Scene]]] = {
    "street": street,
    "bare-street": bare_street,
    "corridor": corridor,
    "room": room,
    "plain-room": plain_room,
    "wall": wall,
}
"""Functions that build each scene from the trajectory of the camera and a seed."""


def named_scene(name: str) -> Callable[[CameraPath, int], Scene]:
    """Return the function that builds the scene of this name.

    Raises:
        InvalidField: the name is unknown.
    """
    if name not in SCENES:
        raise InvalidField("simulation", "scene", name, f"known scenes: {', '.join(SCENES)}")
    return SCENES[name]


def _flat(value: float) -> NDArray[np.float32]:
    return np.full((SKY_ROWS, SKY_COLUMNS), value, np.float32)


def _skyline(seed: int, far_m: float) -> Sky:
    """Create a bright sky over hills and distant houses in haze."""
    rng = np.random.default_rng((seed, 105))
    haze = rng.uniform(0.45, 0.7)
    image = np.tile(np.linspace(haze, 1.3 * haze, SKY_ROWS)[:, None], (1, SKY_COLUMNS))
    angle = np.linspace(0, 2 * np.pi, SKY_COLUMNS, endpoint=False)
    hills = sum(rng.uniform(1, 3) / k * np.sin(k * angle + rng.uniform(0, 7)) for k in (2, 3, 5, 9))
    top = 5 + np.round(hills)
    left = 0
    while left < SKY_COLUMNS:  # houses of random width and height
        wide = int(rng.integers(6, 40))
        if rng.uniform() < 0.6:
            top[left : left + wide] += rng.uniform(1, 8)
        left += wide
    rows = np.arange(SKY_ROWS)[:, None]
    dark = np.repeat(rng.uniform(0.55, 0.9, SKY_COLUMNS // 8), 8) * haze
    image = np.where(rows < top, dark, image)
    image[0] = haze
    return Sky(image.astype(np.float32), float(haze), far_m)
