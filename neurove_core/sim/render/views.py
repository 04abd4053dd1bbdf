"""Views of a world from a pose: each panel in the frame of the camera, as one row of numbers."""

from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from neurove_core.sim.render.compile import fast
from neurove_core.sim.world.panels import Panels, Sky
from neurove_core.sim.world.textures import Textures

VIEW: Final = 20
"""Length of the row of a panel: u, v, normal (3 each); position of the camera along u and v, and its distance from the
panel; half of each side (2); density (2); offset (2); texture; gain."""

NEAR_M: Final = 0.02
"""Least visible depth [m]."""


class World(NamedTuple):
    """Everything that can be seen."""

    panels: Panels
    textures: Textures
    sky: Sky


class Backdrop(NamedTuple):
    """Data of a world that the kernels need in addition to the views of its panels."""

    texels: NDArray[np.float32]  # see Textures
    sky: NDArray[np.float32]  # see Sky.image
    haze: float
    far_m: float
    eps: float  # added to the linear intensity before its logarithm

    @classmethod
    def of(cls, world: World, eps: float) -> "Backdrop":
        """Create the backdrop of a world."""
        return cls(world.textures.texels, world.sky.image, world.sky.haze, world.sky.far_m, eps)


@fast
def views_of(
    panels: Panels, position: NDArray[np.float64], rotation: NDArray[np.float64]
) -> NDArray[np.float64]:  # pragma: no cover (machine code)
    """Compute the views of panels from several poses.

    Args:
        panels: N panels in the world.
        position: (G, 3) of the camera.
        rotation: (G, 3, 3) camera to world.

    Returns:
        (G, N, VIEW).
    """
    out = np.empty((position.shape[0], panels.gain.size, VIEW))
    us, vs, centres = panels.u, panels.v, panels.centre
    for j in range(position.shape[0]):
        for i in range(panels.gain.size):
            u0, u1, u2, v0, v1, v2 = us[i, 0], us[i, 1], us[i, 2], vs[i, 0], vs[i, 1], vs[i, 2]
            n0, n1, n2 = u1 * v2 - u2 * v1, u2 * v0 - u0 * v2, u0 * v1 - u1 * v0
            x = centres[i, 0] - position[j, 0]
            y = centres[i, 1] - position[j, 1]
            z = centres[i, 2] - position[j, 2]
            row = out[j, i]
            for k in range(3):
                a, b, c = rotation[j, 0, k], rotation[j, 1, k], rotation[j, 2, k]
                row[k] = u0 * a + u1 * b + u2 * c
                row[3 + k] = v0 * a + v1 * b + v2 * c
                row[6 + k] = n0 * a + n1 * b + n2 * c
            row[9] = -(u0 * x + u1 * y + u2 * z)
            row[10] = -(v0 * x + v1 * y + v2 * z)
            row[11] = n0 * x + n1 * y + n2 * z
            for k in range(2):
                row[12 + k], row[14 + k], row[16 + k] = panels.half[i, k], panels.density[i, k], panels.offset[i, k]
            row[18], row[19] = panels.texture[i], panels.gain[i]
    return out
