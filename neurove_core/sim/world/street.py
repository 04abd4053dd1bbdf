"""A street or a corridor along any trajectory: blocks are built ahead of the camera and dropped behind it."""

from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from neurove_core.sim.world.panels import ENDLESS, NOTHING, Panels, Sky, box, panel, upright
from neurove_core.sim.world.path import STEP_M, CameraPath, Waypoints

BLOCK: Final = 6
"""Waypoints of one block: 12 m of street."""

_FACADES: Final = ("facade", "brick", "plaster", "facade", "foliage", "posters")
_OBJECTS: Final = ("metal", "posters", "brick", "foliage")


class Style(NamedTuple):
    """Parameters of a street [m]."""

    far: float  # greatest visible distance
    verge: tuple[float, float]  # distance of the walls from the path
    height: tuple[float, float]  # of the walls
    gap: float  # share of the blocks with a side street instead of a wall
    clearance: float  # least distance of objects from the path
    objects: float  # mean number of objects per block and side
    lanes: bool  # lines on the ground
    ceiling: float | None  # height of the ceiling
    ground: float = 9.0  # period of the texture of the ground; that of BARE is so large that the ground has one colour


STREET: Final = Style(
    far=100.0, verge=(4.0, 10.0), height=(4.0, 12.0), gap=0.18, clearance=1.7, objects=1.2, lanes=True, ceiling=None
)
BARE: Final = STREET._replace(lanes=False, ground=1e6)
"""A street with a ground without features; only the distance of the houses determines the scale of the speed."""

CORRIDOR: Final = Style(
    far=50.0, verge=(1.6, 2.4), height=(3.0, 3.0), gap=0.0, clearance=0.9, objects=0.25, lanes=False, ceiling=3.0
)


class Street:
    """Ground, walls and objects along the path of a trajectory; see `scene.Scene`.

    The same seed and number give the same block. Objects on the path are left out. A path that returns to a place finds
    it changed, because a street is not a map.

    Args:
        trajectory: of the camera.
        seed: of the objects and walls.
        style: parameters of the street.
        sky: above it.
    """

    def __init__(self, trajectory: CameraPath, seed: int, style: Style, sky: Sky) -> None:
        self._trajectory, self._seed, self._style, self.sky = trajectory, seed, style, sky
        self._path = Waypoints(trajectory, 1.5 * style.far + 2 * BLOCK * STEP_M)
        self._blocks: dict[int, Panels] = {}
        self._standing = NOTHING  # panels of all blocks
        self._reach = int(1.5 * style.far / STEP_M / BLOCK)

    def near(self, t_s: float) -> Panels:
        """All panels that may be visible at a time; times must not go backwards."""
        here = self._path.advance(t_s) // BLOCK
        wanted = range(here - self._reach, here + self._reach + 1)
        missing = [number for number in wanted if number not in self._blocks]
        if missing:
            waypoints = self._path.array()
            self._blocks = {number: panels for number, panels in self._blocks.items() if number in wanted}
            self._blocks |= {number: self._block(number, waypoints) for number in missing}
            self._standing = Panels.join(list(self._blocks.values()))
        position = self._trajectory.pose(np.array([t_s]))[0][0]
        around = Panels.join([self._ground(position), self._standing])
        radius = np.hypot(*np.minimum(around.half, ENDLESS).T)
        distance = np.linalg.norm((around.centre - position)[:, [0, 2]], axis=1)
        return around.take(distance - radius < self._style.far)

    def _ground(self, position: NDArray[np.float64]) -> Panels:
        """Ground and ceiling; their texture is fixed in the world, however far the camera goes."""
        repeat = self._style.ground
        middle = np.round(position[[0, 2]] / repeat) * repeat
        right, ahead = np.array([1.0, 0, 0]), np.array([0, 0, 1.0])
        size = (2 * ENDLESS, 2 * ENDLESS)
        ground = panel(np.array([middle[0], 0, middle[1]]), right, ahead, size, "asphalt", repeat_m=repeat)
        parts = [ground] if self._style.ground else [NOTHING]
        if self._style.ceiling:
            above = np.array([middle[0], -self._style.ceiling, middle[1]])
            parts.append(panel(above, right, ahead, size, "plaster", repeat_m=repeat))
        return Panels.join(parts)

    def _block(self, number: int, waypoints: NDArray[np.float64]) -> Panels:
        """Build the panels along one block of the path, without those on the path."""
        rng = np.random.default_rng((self._seed, 102, number + (1 << 32)))
        first = number * BLOCK - self._path.first
        start, end = waypoints[first], waypoints[first + BLOCK]
        ahead = (end - start) / max(float(np.linalg.norm(end - start)), 1e-9)
        parts = self._lines(start, ahead) if self._style.lanes else []
        for side in (-1.0, 1.0):
            out = side * np.array([ahead[1], -ahead[0]])  # to the right for 1: x right, z forward
            parts += self._walls(rng, start, end, out)
            parts += self._objects(rng, start, ahead, out, float(np.linalg.norm(end - start)))
        return Panels.join([NOTHING, *(part for part in parts if self._stands_clear(part, waypoints))])

    def _lines(self, start: NDArray[np.float64], ahead: NDArray[np.float64]) -> list[Panels]:
        """Lane lines, 6 mm above the ground: dashes in the middle and a line on each side."""
        along, across = np.array([ahead[0], 0, ahead[1]]), np.array([-ahead[1], 0, ahead[0]])
        origin = np.array([start[0], -0.006, start[1]])
        rows = [(2.0, 0.0, 3.0), (8.0, 0.0, 3.0), (6.0, 2.8, 12.4), (6.0, -2.8, 12.4)]
        return [
            panel(origin + along * at + across * aside, along, across, (length, 0.14), "paint", repeat_m=2.0)
            for at, aside, length in rows
        ]

    def _walls(
        self, rng: np.random.Generator, start: NDArray[np.float64], end: NDArray[np.float64], out: NDArray[np.float64]
    ) -> list[Panels]:
        """One wall, or a side street between two."""
        style = self._style
        verge, height = rng.uniform(*style.verge), rng.uniform(*style.height)
        texture, repeat = str(rng.choice(_FACADES)), rng.uniform(6, 11)
        offset = (rng.uniform(), -height / 2 / repeat)  # the border of the texture lies on the ground
        a, b = start + out * verge, end + out * verge
        if rng.uniform() < style.gap:
            return [upright(p, p + out * 18, height, texture, repeat_m=repeat, offset=offset) for p in (a, b)]
        if not style.ceiling:  # the sides of a house are visible where its neighbour stands further back
            sides = [upright(p, p + out * 8, height, texture, repeat_m=repeat, offset=offset) for p in (a, b)]
            return [upright(a, b, height, texture, repeat_m=repeat, offset=offset), *sides]
        return [upright(a, b, height, texture, repeat_m=repeat, offset=offset)]

    def _objects(
        self,
        rng: np.random.Generator,
        start: NDArray[np.float64],
        ahead: NDArray[np.float64],
        out: NDArray[np.float64],
        length: float,
    ) -> list[Panels]:
        """Parked cars, poles and boxes between the path and the walls."""
        style = self._style
        parts = []
        for _ in range(rng.poisson(style.objects)):
            at = start + ahead * rng.uniform(0, length)
            kind, texture, offset = rng.uniform(), str(rng.choice(_OBJECTS)), (rng.uniform(), rng.uniform())
            if style.ceiling:
                size = (rng.uniform(0.4, 1.0), rng.uniform(0.3, 0.6), rng.uniform(0.4, 1.6))
                parts.append(box(at + out * (style.clearance + 0.35), ahead, size, texture, offset=offset))
            elif kind < 0.45:
                aside = out * rng.uniform(2.9, 3.6)
                parts.append(box(at + aside, ahead, (4.2, 1.7, rng.uniform(0.7, 0.9)), "metal", offset=offset))
                parts.append(box(at + aside, ahead, (2.3, 1.5, 0.7), "metal", offset=offset, bottom_m=0.8))
            elif kind < 0.75:
                aside = out * rng.uniform(2.2, 4.0)
                parts.append(box(at + aside, ahead, (0.16, 0.16, rng.uniform(3, 6)), "metal", offset=offset))
            else:
                size = (rng.uniform(0.5, 1.5), rng.uniform(0.5, 1.2), rng.uniform(0.8, 2.2))
                parts.append(box(at + out * rng.uniform(2.6, 4.0), ahead, size, texture, offset=offset))
        return parts

    def _stands_clear(self, part: Panels, waypoints: NDArray[np.float64]) -> bool:
        """Whether no upright panel of the part stands on the path."""
        standing = part.take(np.abs(part.v[:, 1]) > 0.5)
        if not standing.n:
            return True
        centre, along = standing.centre[:, [0, 2]], standing.u[:, [0, 2]]
        away = waypoints[None] - centre[:, None]
        on = np.clip(np.einsum("nkc,nc->nk", away, along), -standing.half[:, :1], standing.half[:, :1])
        distance = np.linalg.norm(away - on[..., None] * along[:, None], axis=2)
        return bool(distance.min() >= self._style.clearance - 0.1)
