"""Contrast maximisation: a classical baseline that estimates the motion of a camera without training.

If each event is moved back along the true motion, the events of one edge fall on each other and the image of all events
is sharp. The search therefore maximises the variance of the image of moved events. Polarity is ignored.

Source: Gallego and Scaramuzza 2017 (angular velocity), Gallego, Rebecq and Scaramuzza 2018 (the general case).
"""

import functools
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from neurove_core.compiled import compiled
from neurove_core.geometry.camera import undistort
from neurove_protocol import CameraInfo, Events
from neurove_protocol.errors import InvalidField

Array = NDArray[np.float64]

SCALES: Final = ((25, 1.0), (100, 1.0))
"""Coarse to fine: cells of the image of moved events per radian, and its smoothing [cells, standard deviation].

The result comes from the last scale; its cells have 2 px of a DAVIS240C. Events lie on whole pixels, which draws slow
motion to some values if the cells are fine: in a simulated room (seed 20003, DAVIS346, 0.2 rad/s, 50 ms windows) the
error is 15 % with cells of 1 px smoothed by half a cell, and 5 % here. Fast motion through dense texture is better with
fine cells: at 1.3 rad/s (seed 20002, DAVIS240C) the error is 0.3 % with them, and 3 % here.
"""

STARTS_PX: Final = 30.0
"""Image motion of the start values of the search, over the duration of the events."""

MARGIN: Final = 0.25  # margin on each side, as a share of the sensor's side: events may move out of the sensor
_COARSE_EVENTS: Final = 100  # at a coarse scale, times its cells per radian: a blurred image needs no more events
_STEPS: Final = 40  # greatest number of steps of one search
_TOLERANCE: Final = 1e-2  # cells: a smaller step ends the search


class AngularMotion(NamedTuple):
    """Angular velocity of a camera, estimated from events."""

    w_rad_s: Array  # (3,) wx wy wz in the optical frame
    contrast: float  # variance of the image of moved events [events^2 per px]
    contrast_stationary: float  # the same without motion; the further below `contrast`, the more certain the result


class PlanarMotion(NamedTuple):
    """Motion of a camera along a fronto-parallel plane, estimated from events."""

    flow_px_s: Array  # (2,) motion of the image, right and down, at the optical centre
    velocity_per_depth: Array  # (2,) vx and vy of the camera divided by the depth of the plane [1/s]
    contrast: float  # as in `AngularMotion`
    contrast_stationary: float


class _Rays(NamedTuple):
    """Undistorted events (N,): x/z, y/z, and the time from the middle of the events in units of their duration."""

    x: Array
    y: Array
    time: Array


class Grid(NamedTuple):
    """The image of moved events: its size and projection."""

    focal: float  # [cells]
    width: int
    height: int
    turning: bool  # True: motions are rotations; False: they are shifts
    kernel: Array  # (7,) weights of the smoothing


def angular(events: Events, camera: CameraInfo, start: Array | None = None) -> AngularMotion:
    """Estimate the constant angular velocity of a camera that only rotates.

    Args:
        events: at least some thousand, from a time in which the rate is about constant.
        camera: lens of the sensor.
        start: rate (3,) [rad/s] to start from; by default zero and six rates that move the image.

    Raises:
        InvalidField: an event lies outside the sensor, or all events have the same time.
    """
    rays, duration_s = _rays(events, camera)
    to_rad = 1 / camera.fx  # the search uses pixels over the duration
    found, contrast, stationary = _search(rays, camera, True, None if start is None else start * duration_s / to_rad)
    return AngularMotion(found * to_rad / duration_s, contrast, stationary)


def planar(events: Events, camera: CameraInfo, start: Array | None = None) -> PlanarMotion:
    """Estimate the constant velocity of a camera that translates along a fronto-parallel plane.

    Events give the velocity only relative to depth; multiply the result by the depth of the plane [m] to get m/s.

    Args:
        events: as `angular`.
        camera: as `angular`.
        start: flow (2,) [px/s] to start from; by default zero and four motions of the image.

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
    """The events as rays, without those outside the lens model, and their duration [s]."""
    if not events.n or events.t[0] == events.t[-1]:
        raise InvalidField(
            "contrast maximisation", "events", events.n, "events with at least two different times are needed"
        )
    if int(events.x.max()) >= camera.width or int(events.y.max()) >= camera.height:
        raise InvalidField("camera info", "width x height", str(camera.sensor), "an event lies outside this sensor")
    x, y = _pixel_rays(camera)
    duration_us = int(events.t[-1] - events.t[0])
    time = (events.t - events.t[0]) / duration_us - 0.5
    at = events.y, events.x
    seen = np.isfinite(x[at])
    return _Rays(x[at][seen], y[at][seen], time[seen]), duration_us / 1e6


@functools.lru_cache(maxsize=4)
def _pixel_rays(camera: CameraInfo) -> tuple[Array, Array]:
    """x/z and y/z (height, width) of the rays through all pixels; nan outside the lens model."""
    u, v = np.meshgrid(np.arange(camera.width, dtype=np.float64), np.arange(camera.height, dtype=np.float64))
    return undistort((u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, camera)


def _search(rays: _Rays, camera: CameraInfo, turning: bool, start: Array | None) -> tuple[Array, float, float]:
    """The motion (3,) [px over the duration] of greatest contrast, its contrast, and the contrast without motion."""
    motions = [start] if start is not None else [np.zeros(3), *np.eye(3) * STARTS_PX, *np.eye(3) * -STARTS_PX]
    if start is None and not turning:
        motions = [motion for motion in motions if motion[2] == 0]
    for number, (cells, smoothing) in enumerate(SCALES, 1):
        scale = camera.fx / cells
        grid = image_grid(camera, scale, smoothing, turning)
        some = rays if number == len(SCALES) else _thinned(rays, _COARSE_EVENTS * cells)
        found = [_ascend(some, grid, motion, camera.fx) for motion in motions]
        found.sort(key=lambda pair: -pair[1])
        best = found[0][0]
        # the best motion at a coarse scale may not be the best at a fine one, so a different second best is kept too
        others = [motion for motion, _ in found if np.abs(motion - best).max() > scale]
        motions = [best, *others[:1]]
    return found[0][0], found[0][1], _contrast(rays, grid, np.zeros(3), camera.fx)[0]


def _thinned(rays: _Rays, most: int) -> _Rays:
    """At most this many events, evenly selected."""
    stride = -(-rays.x.size // most)
    return _Rays(*(np.ascontiguousarray(column[::stride]) for column in rays))


def image_grid(camera: CameraInfo, scale: float, smoothing: float, turning: bool) -> Grid:
    """Create an image somewhat larger than the sensor, with cells of `scale` px and a smoothing in cells."""
    width, height = (int(side * (1 + 2 * MARGIN) / scale) for side in (camera.width, camera.height))
    kernel = np.exp(-0.5 * (np.arange(-3, 4) / smoothing) ** 2)
    return Grid(camera.fx / scale, width, height, turning, kernel / kernel.sum())


def _ascend(rays: _Rays, grid: Grid, motion: Array, focal_px: float) -> tuple[Array, float]:
    """The local maximum of the contrast near a motion (3,), and its contrast; BFGS with a backtracking line search."""
    value, slope = _contrast(rays, grid, motion, focal_px)
    cell_px = focal_px / grid.focal
    inverse_hessian = np.eye(3) * cell_px / max(float(np.linalg.norm(slope)), 1e-12)  # a first step of one cell
    for _ in range(_STEPS):
        step = inverse_hessian @ slope
        if step @ slope <= 0:  # rounding has made it a descent direction
            inverse_hessian = np.eye(3) / max(float(np.linalg.norm(slope)), 1e-12)
            step = inverse_hessian @ slope
        while np.abs(step).max() > _TOLERANCE * cell_px:
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
    """The BFGS estimate of the inverse Hessian after a step that changed the slope by `change`."""
    along = float(step @ change)
    if along <= 1e-12 * float(np.linalg.norm(step) * np.linalg.norm(change)):
        return inverse_hessian
    left = np.eye(len(step)) - np.outer(step, change) / along
    return np.asarray(left @ inverse_hessian @ left.T + np.outer(step, step) / along)


def _contrast(rays: _Rays, grid: Grid, motion: Array, focal_px: float) -> tuple[float, Array]:
    """Variance of the smoothed image of moved events, and its gradient (3,) with respect to the motion."""
    rate = motion / focal_px  # [rad or 1/depth, over the duration]
    image = np.zeros((grid.height, grid.width))
    accumulate(rays.x, rays.y, rays.time, rate, grid, image)
    smooth = _smoothed(image, grid.kernel)
    deviation = smooth - smooth.mean()
    # the gradient of the sum of squares at an event is that of the image smoothed once more
    slope = _slope(rays.x, rays.y, rays.time, rate, grid, _smoothed(deviation, grid.kernel))
    return float((deviation**2).mean()), slope * (2 / image.size / focal_px)


@compiled
def _smoothed(image: Array, kernel: Array) -> Array:  # pragma: no cover (machine code)
    """Smooth the image along rows and columns, with zeros outside its borders."""
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
    """Direction of a ray at time 0 for this motion of the camera."""
    a, b, c = rate[0] * time, rate[1] * time, rate[2] * time
    if not turning:
        return x + a, y + b, 1.0
    angle2 = a * a + b * b + c * c
    # Rodrigues' formula
    if angle2 < 0.04:  # by their series, exact to 1e-11
        first = 1 - angle2 / 6 * (1 - angle2 / 20 * (1 - angle2 / 42))
        second = 0.5 - angle2 / 24 * (1 - angle2 / 30 * (1 - angle2 / 56))
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
    """Add each moved event to the four cells around it, in place; events outside the image are dropped."""
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
    """Reference implementation of `accumulate`, in plain numpy."""
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
    """Gradient (3,), by the rate, of the sum of the values of an image at the moved events, interpolated."""
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
        # gradient by the direction d at time 0, turned into one by the rate; J = 1 + phi/2 + phi^2/6 ...
        gx, gy, gz = by_u, by_v, -(by_u * x + by_v * y) / z
        nx, ny, nz = y * gz - z * gy, z * gx - x * gz, x * gy - y * gx
        # the transposed Jacobian: the same series with the rotation reversed
        p, q, r = -rate[0] * t, -rate[1] * t, -rate[2] * t
        mx, my, mz = q * nz - r * ny, r * nx - p * nz, p * ny - q * nx
        kx, ky, kz = q * mz - r * my, r * mx - p * mz, p * my - q * mx
        slope[0] += nx + mx / 2 + kx / 6
        slope[1] += ny + my / 2 + ky / 6
        slope[2] += nz + mz / 2 + kz / 6
    return slope
