"""The kernels of the refinement do what their plain form does, and their derivatives are those of the alignment."""

import numpy as np
import pytest

from neurove_core.refine.alignment import Grid, Rays, image, image_reference, tiles, tiles_reference
from neurove_core.refine.search import jacobian

GRID = Grid(focal=80.0, left=-0.75, top=-0.55, width=120, height=88)


def edges(motion, seed=0, n=4000):
    """Events of points at one depth that a camera with this motion over the window sees."""
    rng = np.random.default_rng(seed)
    at = rng.uniform([-0.6, -0.4], [0.6, 0.4], (150, 2))[rng.integers(0, 150, n)]
    time = rng.uniform(-0.5, 0.5, n)
    at = at + rng.normal(0, 0.7, at.shape) / GRID.focal
    flow = np.einsum("kia,a->ki", jacobian(*at.T), motion)
    x, y = (at - time[:, None] * flow).astype(np.float32).T
    return Rays(x, y, time.astype(np.float32), np.ones(n, np.float32))


@pytest.mark.parametrize(
    "motion", [(0, 0, 0, 0, 0, 0), (0.03, -0.05, 0.1, 0, 0, 0), (0.1, 0.2, -0.2, 0.02, 0.01, -0.05)]
)
def test_the_kernels_equal_their_reference(motion):
    rays, motion = edges(np.zeros(6)), np.array(motion, float)
    rays = rays._replace(near=np.linspace(0.5, 2.0, rays.x.size, dtype=np.float32))
    smooth = image(rays, motion, GRID)
    np.testing.assert_allclose(smooth, image_reference(rays, motion, GRID), atol=1e-4)
    for name, ours, plain in zip(
        tiles(rays, motion, GRID, smooth)._fields,
        tiles(rays, motion, GRID, smooth),
        tiles_reference(rays, motion, GRID, smooth),
        strict=True,
    ):
        # an event on the border of a tile may be counted in the other one
        np.testing.assert_allclose(ours.sum(0), plain.sum(0), rtol=2e-3, atol=0.05, err_msg=name)


def test_the_gradient_and_the_hessian_are_those_of_the_alignment():
    rays = edges(np.zeros(6))

    def at(motion):
        return tiles(rays, motion, GRID, image(rays, motion, GRID))

    here = at(np.zeros(6))
    by = jacobian(here.x, here.y) * GRID.focal
    gradient = np.einsum("kia,ki->a", by, here.gradient)
    hessian = np.einsum("kia,kij,kjb->ab", by, here.hessian, by)
    for axis in range(3):
        step = np.zeros(6)
        step[axis] = 0.01
        rise = (at(step).value.sum() - at(-step).value.sum()) / 0.02 / 2
        bend = (at(step).value.sum() + at(-step).value.sum() - 2 * here.value.sum()) / 0.01**2 / 2
        assert abs(gradient[axis] - rise) < 0.02 * abs(hessian[axis, axis]) * 0.1
        assert hessian[axis, axis] == pytest.approx(bend, rel=0.25)
        assert bend < 0
