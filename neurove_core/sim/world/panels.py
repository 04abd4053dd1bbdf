"""The parts of a simulated world: textured rectangles, and a sky."""

from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from neurove_core.sim.world.textures import NAMES, SIZE

ENDLESS: Final = 1e5
"""Half of the side of an endless panel [m]."""

SKY_ROWS: Final = 64
SKY_COLUMNS: Final = 1024
CLEAR2: Final = 0.25
"""A panel begins to fade at this squared ratio of its distance to far_m."""

SKY_TOP: Final = 0.5
"""Slope (height over distance) of the last row of the sky; higher directions look the same."""


class Panels(NamedTuple):
    """N rectangles in the world (x right, y down, z forward), visible from both sides."""

    centre: NDArray[np.float64]  # (N, 3) [m]
    u: NDArray[np.float64]  # (N, 3) unit vector along one side
    v: NDArray[np.float64]  # (N, 3) unit vector along the other side, perpendicular to u
    half: NDArray[np.float64]  # (N, 2) half of each side [m]
    density: NDArray[np.float64]  # (N, 2) of the texture along u and v [texels/m]
    offset: NDArray[np.float64]  # (N, 2) texture coordinates of the centre [texels]
    texture: NDArray[np.int64]  # (N,) index into textures.NAMES
    gain: NDArray[np.float64]  # (N,) brightness of its light, 1 for full light

    @property
    def n(self) -> int:
        """Number of panels."""
        return int(self.gain.size)

    @classmethod
    def join(cls, parts: list["Panels"]) -> "Panels":
        """Join the panels of at least one part."""
        columns: list[Any] = [np.concatenate(column) for column in zip(*parts, strict=True)]
        return cls(*columns)

    def take(self, chosen: NDArray[np.bool_] | NDArray[np.int64]) -> "Panels":
        """Select panels."""
        columns: list[Any] = [column[chosen] for column in self]
        return Panels(*columns)


class Sky(NamedTuple):
    """The infinitely distant background: a skyline by azimuth and slope, and haze below the horizon.

    From CLEAR2 on, a panel fades into the background with its distance d, as (1 - d^2 / far_m^2)^2, and vanishes at
    far_m. Panels therefore do not appear or disappear suddenly.
    """

    image: NDArray[np.float32]  # (SKY_ROWS, SKY_COLUMNS) linear intensity, row 0 at the horizon
    haze: float  # linear intensity below the horizon where there is no panel
    far_m: float  # distance at which a panel has vanished


def panel(
    centre: NDArray[np.float64],
    u: NDArray[np.float64],
    v: NDArray[np.float64],
    size_m: tuple[float, float],
    texture: str,
    *,
    repeat_m: float = 8.0,
    offset: tuple[float, float] = (0.0, 0.0),
    gain: float = 1.0,
) -> Panels:
    """Create one rectangle.

    Args:
        centre: (3,) in the world [m].
        u: (3,) along its first side, of any length.
        v: (3,) along the second side, perpendicular to u.
        size_m: its sides [m].
        texture: one of textures.NAMES.
        repeat_m: length after which the texture repeats.
        offset: of the texture [repeats].
        gain: of its light.
    """
    density = SIZE / repeat_m
    return Panels(
        np.asarray(centre, np.float64)[None],
        (u / np.linalg.norm(u))[None],
        (v / np.linalg.norm(v))[None],
        np.array([size_m]) / 2,
        np.full((1, 2), density),
        np.array([offset]) * SIZE,
        np.array([NAMES.index(texture)]),
        np.array([gain]),
    )


NOTHING: Final = panel(np.zeros(3), np.eye(3)[0], np.eye(3)[1], (1.0, 1.0), NAMES[0]).take(np.zeros(1, bool))
"""No panels."""


def upright(start: NDArray[np.float64], end: NDArray[np.float64], top_m: float, texture: str, **more: object) -> Panels:
    """Create an upright rectangle between two points (x, z) on the ground; `more` as for `panel`.

    The default light depends on the direction of the rectangle.
    """
    along = np.array([end[0] - start[0], 0.0, end[1] - start[1]])
    length = float(np.linalg.norm(along))
    centre = np.array([(start[0] + end[0]) / 2, -top_m / 2, (start[1] + end[1]) / 2])
    light = 0.75 + 0.25 * float((along[0] * 0.8 + along[2] * 0.6) / length) ** 2
    return panel(centre, along, np.array([0.0, 1.0, 0.0]), (length, top_m), texture, **({"gain": light} | more))  # type: ignore[arg-type]


def box(
    centre: NDArray[np.float64],
    heading: NDArray[np.float64],
    size_m: tuple[float, float, float],
    texture: str,
    *,
    repeat_m: float = 3.0,
    offset: tuple[float, float] = (0.0, 0.0),
    bottom_m: float = 0.0,
) -> Panels:
    """Create the four sides and the top of a box on or above the ground.

    Args:
        centre: (x, z) of its centre [m].
        heading: (x, z) unit vector along its length.
        size_m: length, width, height.
        texture: of all its faces.
        repeat_m: length after which the texture repeats.
        offset: of the texture [repeats].
        bottom_m: height of its bottom above the ground.
    """
    length, width, height = size_m
    along, across = heading * length / 2, np.array([-heading[1], heading[0]]) * width / 2
    corners = [centre + along + across, centre + along - across, centre - along - across, centre - along + across]
    sides = [
        upright(corners[i], corners[(i + 1) % 4], height, texture, repeat_m=repeat_m, offset=offset) for i in range(4)
    ]
    top = panel(
        np.array([centre[0], -height, centre[1]]),
        np.array([heading[0], 0.0, heading[1]]),
        np.array([-heading[1], 0.0, heading[0]]),
        (length, width),
        texture,
        repeat_m=repeat_m,
        offset=offset,
        gain=1.1,
    )
    faces = Panels.join([*sides, top])
    return faces._replace(centre=faces.centre - np.array([0.0, bottom_m, 0.0]))
