"""Reference implementation of `render` in plain numpy: every ray against every panel."""

import numpy as np
from numpy.typing import NDArray

from neurove_core.sim.render.camera import Rays
from neurove_core.sim.render.shade import TAPS
from neurove_core.sim.render.views import NEAR_M, World
from neurove_core.sim.world.panels import CLEAR2, SKY_COLUMNS, SKY_ROWS, SKY_TOP, Panels, Sky
from neurove_core.sim.world.textures import LEVELS, NAMES, Textures

Array = NDArray[np.float64]


def render_reference(world: World, rays: Rays, position: Array, rotation: Array, eps: float) -> tuple[Array, Array]:
    """Compute log intensity (N,) and depth (N,) of each ray; see `render.render`."""
    direction = np.stack([rays.x, rays.y, np.ones_like(rays.x)], 1)
    n, behind = rays.x.size, _sky(world.sky, direction @ rotation.T)
    depths, shares, values = np.full((2, n), np.inf), np.zeros((2, n)), np.zeros((2, n))  # of the two nearest panels
    for i in range(world.panels.n):
        t, cover, value = _panel(world, i, rays, direction, position, rotation)
        far = t**2 * (direction**2).sum(1) / world.sky.far_m**2
        clear = np.where(far <= CLEAR2, 1.0, ((1 - far) / (1 - CLEAR2)) ** 2)
        value = behind + clear * (value - behind)
        seen = (t > NEAR_M) & (cover > 0) & (far < 1)
        first, second = seen & (t < depths[0]), seen & (t >= depths[0]) & (t < depths[1])
        for stack, new in ((shares, cover), (values, value), (depths, t)):
            stack[1] = np.where(first, stack[0], np.where(second, new, stack[1]))
            stack[0] = np.where(first, new, stack[0])
    back = np.where(np.isfinite(depths[1]), values[1], behind)
    light = np.where(np.isfinite(depths[0]), back + shares[0] * (values[0] - back), behind)
    return np.log(light + eps), depths[0]


def _panel(
    world: World, i: int, rays: Rays, direction: Array, position: Array, rotation: Array
) -> tuple[Array, Array, Array]:
    """Depth, covered share of the pixel, and intensity of one panel for all rays (N,)."""
    panels: Panels = world.panels
    u, v = panels.u[i] @ rotation, panels.v[i] @ rotation  # in the frame of the camera
    normal, place = np.cross(u, v), (position - panels.centre[i]) @ rotation
    with np.errstate(all="ignore"):  # a ray parallel to the plane does not meet it
        t = -(normal @ place) / (direction @ normal)
        at = np.stack([t * (direction @ axis) + axis @ place for axis in (u, v)])  # (2, N) on the panel [m]
        # sides of the pixel on the panel, (2, N) each: for the step in x and the step in y
        across, down = (
            np.stack([t * step * (axis[k] - (direction @ axis) * normal[k] / (direction @ normal)) for axis in (u, v)])
            for k, step in ((0, rays.step_x), (1, rays.step_y))
        )
        reach = 6 * t * (rays.step_x + rays.step_y)
        inside = panels.half[i][:, None] - np.abs(at)
        wide = np.maximum(np.minimum(np.abs(across) + np.abs(down), reach), 1e-12)
        share = np.where((inside > reach).all(0), 1.0, np.clip(inside / wide + 0.5, 0, 1))
        share = np.where((inside < -reach).any(0), 0.0, share)
        scale = panels.density[i][:, None]
        where = at * scale + panels.offset[i][:, None]
        value = panels.gain[i] * _sample(world.textures, NAMES[panels.texture[i]], where, across * scale, down * scale)
    return np.nan_to_num(t, nan=-1.0, posinf=-1.0, neginf=-1.0), np.nan_to_num(share.prod(0)), np.nan_to_num(value)


def _sample(textures: Textures, name: str, where: Array, side_x: Array, side_y: Array) -> Array:
    """Intensity (N,) at positions (2, N) [texels], for a footprint with these sides (2, N)."""
    size_x, size_y = (side_x**2).sum(0), (side_y**2).sum(0)
    along = np.where(size_x < size_y, side_y, side_x)
    long2, short2 = np.maximum(size_x, size_y), np.minimum(size_x, size_y)
    ratio = np.sqrt(long2 / np.maximum(short2, 1e-12))
    taps = np.where(long2 > 2.25 * short2, np.minimum(np.floor(np.nan_to_num(ratio) + 0.999), TAPS), 1)
    width2 = np.maximum(np.maximum(short2, long2 / taps**2), 1.0)
    mantissa, exponent = np.frexp(np.nan_to_num(width2, nan=1.0, posinf=1e30))
    lod = np.minimum(0.5 * exponent + mantissa - 1.0, LEVELS - 1 - 1e-6)
    level = lod.astype(int)
    blend = np.clip(2 * (lod - level) - 0.5, 0, 1)
    total = np.zeros_like(lod)
    for tap in range(TAPS):
        at = np.clip(np.nan_to_num(where + ((tap + 0.5) / taps - 0.5) * along), -1e15, 1e15)
        value = np.zeros_like(lod)
        for k in range(LEVELS):
            weight = np.where(level == k, 1 - blend, np.where(level + 1 == k, blend, 0))
            value += weight * _bilinear(textures.level(name, k), at / (1 << k))
        total += np.where(tap < taps, value, 0)
    sampled: Array = total / taps
    return sampled


def _bilinear(image: NDArray[np.float32], at: Array) -> Array:
    """Interpolate a periodic image at positions (2, N), column and row; the centre of its first texel is at 0.5."""
    side = image.shape[0]
    left, top = np.floor(at - 0.5)
    du, dv = (at - 0.5) - (left, top)
    i, j = left.astype(np.int64), top.astype(np.int64)
    corners = [[image[(j + b) % side, (i + a) % side].astype(np.float64) for a in (0, 1)] for b in (0, 1)]
    upper, lower = (row[0] + du * (row[1] - row[0]) for row in corners)
    mixed: Array = upper + dv * (lower - upper)
    return mixed


def _sky(sky: Sky, direction: Array) -> Array:
    """Intensity (N,) of the sky in directions (N, 3) of the world."""
    x, y, z = direction.T
    slope = -y / np.sqrt(x * x + z * z + 1e-12)
    row = np.clip(slope * (SKY_ROWS - 1) / SKY_TOP, 0, SKY_ROWS - 1.001)
    column = (np.arctan2(x, z) / (2 * np.pi) + 1) * SKY_COLUMNS
    top, left = row.astype(int), column.astype(int)
    i, j = left % SKY_COLUMNS, (left + 1) % SKY_COLUMNS
    image = sky.image.astype(np.float64)
    upper = image[top, i] + (column - left) * (image[top, j] - image[top, i])
    lower = image[top + 1, i] + (column - left) * (image[top + 1, j] - image[top + 1, i])
    mixed: Array = np.where(slope <= 0, sky.haze, upper + (row - top) * (lower - upper))
    return mixed
