"""Classical baselines: how a camera moved, by contrast maximisation, without any training.

Source: Gallego and Scaramuzza 2017 (angular velocity), Gallego, Rebecq and Scaramuzza 2018 (the general case). Events
of one edge lie on top of each other, and their image is sharp, when each is moved back along the right motion; so the
motion is sought for which the variance of that image is greatest. Counts of events, whatever their polarity.
"""

from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from neurove_core.compiled import compiled
from neurove_core.geometry.camera import undistort
from neurove_protocol import CameraInfo, Events
from neurove_protocol.errors import InvalidField

Array = NDArray[np.float64]

SCALES: Final = ((8, 1.0), (4, 1.0), (2, 1.0), (1, 0.5))
"""Coarse to fine: pixels per cell of the image of moved events, and its smoothing [cells, standard deviation].

The last is what the answer is read from. With more smoothing it leans to where a long window's motion was fastest: on
shapes_rotation w_z goes from 1.38 to 1.63 rad/s between 0.5 and 2 px, w_x and w_y by 3 %.
"""

STARTS_PX: Final = 30.0
"""How far apart in the image, over the events' duration, the motions lie from which the search begins."""

MARGIN: Final = 0.25  # of the image's side, on each: what the events may move out of the sensor
_COARSE_EVENTS: Final = 40_000  # over the pixels of a cell: so many are enough to see its blurred image
_STEPS: Final = 40  # most steps of one search
_TOLERANCE_PX: Final = 3e-3  # a step below it ends the search


class AngularMotion(NamedTuple):
    """A camera's rate of rotation as its events tell it."""

    w_rad_s: Array  # (3,) wx wy wz in the optical frame
    contrast: float  # variance of the image of moved events [events^2 per px]
    contrast_stationary: float  # the same if it had not turned: the more below `contrast`, the surer


class PlanarMotion(NamedTuple):
    """A camera's motion along a fronto-parallel plane as its events tell it."""

    flow_px_s: Array  # (2,) how the image moves, right and down, at the optical centre
    velocity_per_depth: Array  # (2,) vx and vy of the camera over the plane's depth [1/s]
    contrast: float  # as in AngularMotion
    contrast_stationary: float


class _Rays(NamedTuple):
    """Undistorted events (N,): x/z, y/z and the time since their middle, in units of their duration."""

    x: Array
    y: Array
    time: Array


class Grid(NamedTuple):
    """Where rays fall in the image of moved events."""

    focal: float  # [cells]
    width: int
    height: int
    turning: bool  # motions are rotations, else shifts
    kernel: Array  # (7,) weights that smooth it


def angular(events: Events, camera: CameraInfo, start: Array | None = None) -> AngularMotion:
    """The constant rate of rotation that explains the events best, if the camera did nothing but turn.

    Args:
        events: of a time so short that the rate is about constant, and of some thousand events at least.
        camera: whose lens they came through.
        start: a rate (3,) [rad/s] near which it is sought; by default at rest and a few that move the image.

    Raises:
        InvalidField: the events are of another sensor, or fewer than two times are among them.
    """
    rays, duration_s = _rays(events, camera)
    to_rad = 1 / camera.fx  # a motion is sought in pixels over the duration
    found, contrast, stationary = _search(rays, camera, True, None if start is None else start * duration_s / to_rad)
    return AngularMotion(found * to_rad / duration_s, contrast, stationary)


def planar(events: Events, camera: CameraInfo, start: Array | None = None) -> PlanarMotion:
    """The constant velocity that explains the events best, if the camera slid along a fronto-parallel plane.

    Events tell velocity only over depth: times the plane's depth [m] it is in m/s.

    Args:
        events: as `angular`.
        camera: as `angular`.
        start: a flow (2,) [px/s] near which it is sought; by default at rest and a few that move the image.

    Raises:
        InvalidField: as `angular`.
    """
    rays, duration_s = _rays(events, camera)
    focal = np.array([camera.fx, camera.fy])
    begin = None if start is None else np.append(-start / focal * camera.fx * duration_s, 0.0)
    found, contrast, stationary = _search(rays, camera, False, begin)
    velocity = found[:2] / camera.fx / duration_s
    return PlanarMotion(-velocity * focal, velocity, contrast, stationary)


def _rays(events: Events, camera: CameraInfo) -> tuple[_Rays, float]:
    """The events as rays, without those that the lens can not have seen, and their duration [s]."""
    if not events.n or events.t[0] == events.t[-1]:
        raise InvalidField("contrast maximisation", "events", events.n, "events of at least two times are needed")
    if int(events.x.max()) >= camera.width or int(events.y.max()) >= camera.height:
        raise InvalidField("camera info", "width x height", str(camera.sensor), "an event lies outside this sensor")
    u, v = np.meshgrid(np.arange(camera.width, dtype=np.float64), np.arange(camera.height, dtype=np.float64))
    x, y = undistort((u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, camera)
    duration_us = int(events.t[-1] - events.t[0])
    time = (events.t - events.t[0]) / duration_us - 0.5
    at = events.y, events.x
    seen = np.isfinite(x[at])
    return _Rays(x[at][seen], y[at][seen], time[seen]), duration_us / 1e6


def _search(rays: _Rays, camera: CameraInfo, turning: bool, start: Array | None) -> tuple[Array, float, float]:
    """The motion (3,) [px over the duration] of greatest contrast, that contrast, and the contrast at rest."""
    motions = [start] if start is not None else [np.zeros(3), *np.eye(3) * STARTS_PX, *np.eye(3) * -STARTS_PX]
    if start is None and not turning:
        motions = [motion for motion in motions if motion[2] == 0]
    for scale, smoothing in SCALES:
        grid = image_grid(camera, scale, smoothing, turning)
        some = rays if scale == 1 else _thinned(rays, _COARSE_EVENTS // scale)
        found = [_ascend(some, grid, motion, camera.fx) for motion in motions]
        found.sort(key=lambda pair: -pair[1])
        best = found[0][0]
        # the best of a coarse image may not be that of a fine one: the next best goes on too, if it is another
        others = [motion for motion, _ in found if np.abs(motion - best).max() > scale]
        motions = [best, *others[:1]]
    return found[0][0], found[0][1], _contrast(rays, grid, np.zeros(3), camera.fx)[0]


def _thinned(rays: _Rays, most: int) -> _Rays:
    """At most this many of the events, evenly chosen."""
    stride = -(-rays.x.size // most)
    return _Rays(*(np.ascontiguousarray(column[::stride]) for column in rays))


def image_grid(camera: CameraInfo, scale: int, smoothing: float, turning: bool) -> Grid:
    """An image somewhat larger than the sensor's, with cells of `scale` px and smoothing in cells."""
    width, height = (int(side * (1 + 2 * MARGIN) / scale) for side in (camera.width, camera.height))
    kernel = np.exp(-0.5 * (np.arange(-3, 4) / smoothing) ** 2)
    return Grid(camera.fx / scale, width, height, turning, kernel / kernel.sum())


def _ascend(rays: _Rays, grid: Grid, motion: Array, focal_px: float) -> tuple[Array, float]:
    """The nearest motion (3,) of locally greatest contrast, and that contrast: BFGS with a halving line search."""
    value, slope = _contrast(rays, grid, motion, focal_px)
    inverse_hessian = (
        np.eye(3) * (focal_px / grid.focal) / max(float(np.linalg.norm(slope)), 1e-12)
    )  # a first step of one cell
    for _ in range(_STEPS):
        step = inverse_hessian @ slope
        if step @ slope <= 0:  # rounding has spoilt it
            inverse_hessian = np.eye(3) / max(float(np.linalg.norm(slope)), 1e-12)
            step = inverse_hessian @ slope
        while np.abs(step).max() > _TOLERANCE_PX:
            here, slope_here = _contrast(rays, grid, motion + step, focal_px)
            if here > value + 1e-4 * float(step @ slope):
                break
            step = step / 2
        else:
            break
        inverse_hessian = _updated_inverse_hessian(inverse_hessian, step, slope - slope_here)
        motion, value, slope = motion + step, here, slope_here
    return motion, value


def _updated_inverse_hessian(inverse_hessian: Array, step: Array, change: Array) -> Array:
    """The BFGS estimate of the inverse curvature after a step that changed the slope by this."""
    along = float(step @ change)
    if along <= 1e-12 * float(np.linalg.norm(step) * np.linalg.norm(change)):
        return inverse_hessian
    left = np.eye(len(step)) - np.outer(step, change) / along
    return np.asarray(left @ inverse_hessian @ left.T + np.outer(step, step) / along)


def _contrast(rays: _Rays, grid: Grid, motion: Array, focal_px: float) -> tuple[float, Array]:
    """Variance of the smoothed image of moved events, and its slope (3,) by the motion."""
    rate = motion / focal_px  # [rad or 1/depth, over the duration]
    image = np.zeros((grid.height, grid.width))
    accumulate(rays.x, rays.y, rays.time, rate, grid, image)
    smooth = _smoothed(image, grid.kernel)
    deviation = smooth - smooth.mean()
    # the slope of the sum of squares by each event's place is that of the image smoothed once more
    slope = _slope(rays.x, rays.y, rays.time, rate, grid, _smoothed(deviation, grid.kernel))
    return float((deviation**2).mean()), slope * (2 / image.size / focal_px)


@compiled
def _smoothed(image: Array, kernel: Array) -> Array:  # pragma: no cover (machine code)
    """The image smoothed along rows and columns, dark beyond its borders."""
    height, width = image.shape
    rows, out = np.zeros_like(image), np.zeros_like(image)
    for y in range(height):
        for k in range(-3, 4):
            weight = kernel[k + 3]
            for x in range(max(0, -k), min(width, width - k)):
                rows[y, x] += weight * image[y, x + k]
    for k in range(-3, 4):
        weight = kernel[k + 3]
        for y in range(max(0, -k), min(height, height - k)):
            for x in range(width):
                out[y, x] += weight * rows[y + k, x]
    return out


@compiled
def _moved(
    x: float, y: float, time: float, rate: Array, turning: bool
) -> tuple[float, float, float]:  # pragma: no cover (machine code)
    """Direction that a ray had at time 0, if the camera's motion is this."""
    a, b, c = rate[0] * time, rate[1] * time, rate[2] * time
    if not turning:
        return x + a, y + b, 1.0
    angle2 = a * a + b * b + c * c
    # Rodrigues' formula
    if angle2 < 1e-8:
        first, second = 1 - angle2 / 6, 0.5 - angle2 / 24
    else:
        angle = np.sqrt(angle2)
        first, second = np.sin(angle) / angle, (1 - np.cos(angle)) / angle2
    px, py, pz = b - c * y, c * x - a, a * y - b * x
    qx, qy, qz = b * pz - c * py, c * px - a * pz, a * py - b * px
    return x + first * px + second * qx, y + first * py + second * qy, 1.0 + first * pz + second * qz


@compiled
def accumulate(
    xs: Array, ys: Array, times: Array, rate: Array, grid: Grid, image: Array
) -> None:  # pragma: no cover (machine code)
    """Add each moved event to the four cells around it, in place; those that leave the image are lost."""
    for i in range(xs.size):
        x, y, z = _moved(xs[i], ys[i], times[i], rate, grid.turning)
        if z <= 0.1:
            continue
        u, v = grid.focal * x / z + 0.5 * (grid.width - 1), grid.focal * y / z + 0.5 * (grid.height - 1)
        if not (0 <= u < grid.width - 1 and 0 <= v < grid.height - 1):
            continue
        column, row = int(u), int(v)
        u, v = u - column, v - row
        image[row, column] += (1 - u) * (1 - v)
        image[row, column + 1] += u * (1 - v)
        image[row + 1, column] += (1 - u) * v
        image[row + 1, column + 1] += u * v


def accumulate_reference(xs: Array, ys: Array, times: Array, rate: Array, grid: Grid, image: Array) -> None:
    """What accumulate computes, in plain numpy."""
    from neurove_core.geometry import rotations

    rays = np.stack([xs, ys, np.ones_like(xs)], axis=1)
    turned = rotations.turn(rotations.exp(times[:, None] * rate), rays)
    shifted = rays + times[:, None] * rate * [1.0, 1.0, 0.0]
    x, y, z = (turned if grid.turning else shifted).T
    u, v = grid.focal * x / z + 0.5 * (grid.width - 1), grid.focal * y / z + 0.5 * (grid.height - 1)
    inside = (z > 0.1) & (u >= 0) & (u < grid.width - 1) & (v >= 0) & (v < grid.height - 1)
    u, v = u[inside], v[inside]
    column, row = u.astype(int), v.astype(int)
    for right in (0, 1):
        for below in (0, 1):
            weight = np.abs(1 - right - (u - column)) * np.abs(1 - below - (v - row))
            np.add.at(image, (row + below, column + right), weight)


@compiled
def _slope(
    xs: Array, ys: Array, times: Array, rate: Array, grid: Grid, image: Array
) -> Array:  # pragma: no cover (machine code)
    """Slope (3,) by the rate of the sum of an image's values, interpolated at the moved events."""
    slope = np.zeros(3)
    for i in range(xs.size):
        t = times[i]
        x, y, z = _moved(xs[i], ys[i], t, rate, grid.turning)
        if z <= 0.1:
            continue
        u, v = grid.focal * x / z + 0.5 * (grid.width - 1), grid.focal * y / z + 0.5 * (grid.height - 1)
        if not (0 <= u < grid.width - 1 and 0 <= v < grid.height - 1):
            continue
        column, row = int(u), int(v)
        u, v = u - column, v - row
        a, b = image[row, column], image[row, column + 1]
        c, d = image[row + 1, column], image[row + 1, column + 1]
        by_u = ((b - a) * (1 - v) + (d - c) * v) * grid.focal / z * t
        by_v = ((c - a) * (1 - u) + (d - b) * u) * grid.focal / z * t
        if not grid.turning:
            slope[0] += by_u
            slope[1] += by_v
            continue
        # of the direction d at time 0: e = its change, and -d x (J e) per unit of rate; J = 1 + phi/2 + phi^2/6 ...
        gx, gy, gz = by_u, by_v, -(by_u * x + by_v * y) / z
        nx, ny, nz = y * gz - z * gy, z * gx - x * gz, x * gy - y * gx
        # transposed Jacobian: half a turn back along the rotation
        p, q, r = -rate[0] * t, -rate[1] * t, -rate[2] * t
        mx, my, mz = q * nz - r * ny, r * nx - p * nz, p * ny - q * nx
        kx, ky, kz = q * mz - r * my, r * mx - p * mz, p * my - q * mx
        slope[0] += nx + mx / 2 + kx / 6
        slope[1] += ny + my / 2 + ky / 6
        slope[2] += nz + mz / 2 + kz / 6
    return slope
