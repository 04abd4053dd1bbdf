"""Motion in a scene with depth: velocity over depth and turning of a camera that is on no vehicle.

A camera in a hand, on a drone or on a slide translates in all directions, over a scene whose depth is not known. Then
the image shows turning and translation alike, and a search for the rotation takes one for the other. Here the unknowns
of a window are the angular velocity, the velocity over the mean depth, and the inverse depth at COLUMNS x ROWS nodes of
the view, between which it is linear. The events are aligned as in `search`.

What holds them apart is known before:
- the depth changes slowly from window to window, and differs little from that of a slanted plane;
- the velocity changes slowly;
- a camera turns to and fro: its angular velocity is drawn to zero, and to the network's answer.
All three are one normal distribution, which goes on from window to window with all its covariances (a Kalman filter,
whose measurement is the alignment).

Source: Gallego and Scaramuzza 2017 (contrast maximisation); Longuet-Higgins and Prazdny 1980 (motion of the image).
Differs: the depth is a part of the state, instead of one plane per window.
"""

from typing import Final, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from neurove_core.compiled import compiled
from neurove_core.refine.alignment import Grid, Rays, Tiles
from neurove_core.refine.search import Found, agreement, jacobian, measure, scale_of

Array = NDArray[np.float64]
Floats = NDArray[np.float32]

COLUMNS: Final = 4
ROWS: Final = 3
"""Nodes of the inverse depth."""

Outcome = Literal["accepted", "at rest", "turning", "disagreeing", "out of range"]

MIN_EVENTS: Final = 500
MAX_APART: Final = 2.5
MIN_SHARP: Final = 0.7
MIN_INSIDE: Final = 0.8
"""Of the parts of the image, as in `rotation`."""

MIN_SIGMAS: Final = 4.0
"""Least velocity over depth of a camera that moves [sigma], in two windows in a row."""

SURE_SIGMAS: Final = 6.0
"""With more, one window is enough."""

MOVES: Final = 20
"""Windows for which a camera that moved is taken to move."""

MIN_SHARE: Final = 0.4
"""Least velocity over depth against the angular velocity; with less, the camera turns only."""

MAX_TURN_RAD_S: Final = 0.3
"""A faster turn is left to `rotation`, which is exact for a hand that waves."""

MAX_WAIT: Final = 6
"""Windows without a search after which the scene is forgotten."""

_N: Final = 6 + COLUMNS * ROWS
_LEAST_NEAR: Final = 0.03
_STEPS: Final = 4
_MAX_STEP_CELLS: Final = 3.0
_MAX_STEP_NEAR: Final = 0.5
_TOLERANCE_CELLS: Final = 0.04
_DISPERSION: Final = 2.0
_SLOPE: Final = 0.3  # sigma of the slopes of the inverse depth [per unit of the ray]
_FREE: Final = 0.1  # sigma of the inverse depth about the plane
_REACH: Final = 0.5  # distance in which it varies [rays]
_NEAR_RENEWED: Final = 0.03  # share of the variance of the depth that is new in a window
_SHIFT_SIGMA: Final = 0.2  # of the velocity over depth, when nothing is known [1/s]
_SHIFT_KEPT: Final = 0.98
_SHIFT_NOISE: Final = 0.02  # growth of its sigma in a window [1/s]
_TURN_KEPT: Final = 0.5  # share of the angular velocity that goes on to the next window
_TURN_NOISE: Final = 0.06  # growth of its sigma [rad/s]
_TURN_NOISE_SHARE: Final = 0.3
_TURN_SIGMA: Final = 10.0  # when nothing is known [rad/s]


class Scene(NamedTuple):
    """State of the filter of one stream."""

    mean: Array  # (6 + nodes,) angular velocity [rad/s], velocity over depth [1/s], inverse depth at the nodes
    covariance: Array
    end_us: int  # end of its newest window
    seen: bool = False  # whether the camera moved in that window
    moves: int = 0  # windows for which it is taken to move


class Moved(NamedTuple):
    """The motion in one window."""

    outcome: Outcome
    w_rad_s: Array  # (3,)
    shift: Array  # (3,) velocity over depth [1/s]
    covariance: Array  # (6, 6) of both
    scene: Scene


class Window(NamedTuple):
    """What is known of a window."""

    rays: Rays
    grid: Grid
    start_us: int
    end_us: int
    w_rad_s: Array  # (3,) the network's
    covariance: Array  # (3, 3) of it
    guess: Array | None = None  # (6,) angular velocity and velocity over one depth by another search


def moved(window: Window, before: Scene | None) -> Moved:
    """The motion in a window."""
    seconds = (window.end_us - window.start_us) / 1e6
    grid = window.grid
    if before is not None and not 1 <= _windows_since(window, before) <= MAX_WAIT:
        before = None
    mean, information = _predicted(window, before)
    units = np.concatenate([np.full(6, seconds), np.ones(_N - 6)])
    mean, information = mean * units, information / np.outer(units, units)
    found, of_events = _search(window, mean, information, seconds)
    values, vectors = np.linalg.eigh(of_events)
    of_events = vectors @ (np.maximum(values, 0)[:, None] * vectors.T)
    covariance = np.linalg.inv(of_events / _DISPERSION + information) / np.outer(units, units)
    at = found.unknowns / units
    w, shift = at[:3], at[3:6]
    sigmas = float(np.sqrt(shift @ np.linalg.solve(covariance[3:6, 3:6], shift)))
    seen = sigmas > MIN_SIGMAS
    again = before is not None and before.seen
    moves = MOVES if sigmas > SURE_SIGMAS or (seen and again) else max(before.moves - 1, 0) if before else 0
    scene = Scene(at, (covariance + covariance.T) / 2, window.end_us, seen, moves)
    parts = agreement(Found(found.unknowns[:6], 0.0, of_events, found.tiles, grid))
    turn = float(np.linalg.norm(w))
    outcome: Outcome = "accepted"
    if float(found.tiles.events.sum()) < MIN_INSIDE * window.rays.x.size:
        outcome = "out of range"
    elif parts.apart > MAX_APART * parts.noise or parts.sharp < MIN_SHARP:
        outcome = "disagreeing"
    elif not moves:
        outcome = "at rest"
    elif turn > MAX_TURN_RAD_S or float(np.linalg.norm(shift)) < MIN_SHARE * turn:
        outcome = "turning"
    return Moved(outcome, w, shift, scene.covariance[:6, :6], scene)


class _At(NamedTuple):
    unknowns: Array  # (N,) over the window
    score: float
    tiles: Tiles


def _search(window: Window, mean: Array, information: Array, seconds: float) -> tuple[_At, Array]:
    """The most probable unknowns over the window, and the information of the events there."""
    rays, grid = window.rays, window.grid
    scale: float | None = None

    def at(unknowns: Array) -> _At:
        nonlocal scale
        tiles = measure(rays._replace(near=near(rays, unknowns[6:], grid)), grid, unknowns[:6])
        scale = scale_of(tiles) if scale is None else scale
        off = unknowns - mean
        return _At(unknowns, scale * float(tiles.value.sum()) / 2 - float(off @ information @ off) / 2, tiles)

    here = at(mean)
    if window.guess is not None:
        there = at(np.concatenate([window.guess * seconds, mean[6:]]))
        here = max(here, there, key=lambda one: one.score)
    for _ in range(_STEPS):
        gradient, of_events = _model(here, grid, scale or 0.0)
        gradient = gradient - information @ (here.unknowns - mean)
        values, vectors = np.linalg.eigh(of_events + information)
        step = vectors @ ((vectors.T @ gradient) / np.maximum(np.abs(values), 1e-9))
        step *= min(1.0, _MAX_STEP_CELLS / max(float(np.linalg.norm(step[:6])) * grid.focal, 1e-9))
        step *= min(1.0, _MAX_STEP_NEAR / max(float(np.abs(step[6:]).max()), 1e-9))
        for _ in range(3):
            unknowns = here.unknowns + step
            unknowns[6:] = np.maximum(unknowns[6:], _LEAST_NEAR)
            there = at(unknowns)
            if there.score > here.score:
                break
            step = step / 3
        else:
            break
        here = there
        if float(np.linalg.norm(step[:6])) * grid.focal < _TOLERANCE_CELLS:
            break
    return here, _model(here, grid, scale or 0.0)[1]


def _model(here: _At, grid: Grid, scale: float) -> tuple[Array, Array]:
    """Gradient and information of the events by the unknowns."""
    tiles, basis = here.tiles, _basis(here.tiles.x, here.tiles.y, grid)
    depth = np.maximum(basis @ here.unknowns[6:], _LEAST_NEAR)
    by = jacobian(tiles.x, tiles.y) * grid.focal
    by_depth = (by[:, :, 3:] @ here.unknowns[3:6])[:, :, None] * basis[:, None, :]
    by = np.concatenate([by[:, :, :3], by[:, :, 3:] * depth[:, None, None], by_depth], 2)
    gradient = np.einsum("kia,ki->a", by, tiles.gradient)
    flat = by.transpose(0, 2, 1) @ tiles.hessian  # (K, N, 2)
    second = np.tensordot(flat, by, ([0, 2], [0, 1]))
    return scale * gradient, -scale * second


def compile_kernels(grid: Grid) -> None:
    """Compile what `search.compile_kernels` does not, so that the first window does not wait for it."""
    some = np.linspace(-0.5, 0.5, 16).astype(np.float32)
    near(Rays(some, some, some, some), np.ones(_N - 6), grid)


def _windows_since(window: Window, before: Scene) -> int:
    return 1 + (window.start_us - before.end_us) // (window.end_us - window.start_us)


def _predicted(window: Window, before: Scene | None) -> tuple[Array, Array]:
    """Mean and information of the unknowns before the events, per second."""
    start = _unknown(window.grid)
    if before is None:
        mean, covariance = np.concatenate([np.zeros(6), np.ones(_N - 6)]), start
    else:
        windows = _windows_since(window, before)
        renewed = 1 - (1 - _NEAR_RENEWED) ** windows
        kept = np.concatenate(
            [
                np.full(3, _TURN_KEPT**windows),
                np.full(3, _SHIFT_KEPT**windows),
                np.full(_N - 6, np.sqrt(1 - renewed)),
            ]
        )
        mean = before.mean * kept
        mean[6:] += 1 - kept[6:]
        covariance = before.covariance * np.outer(kept, kept)
        turn = _TURN_NOISE + _TURN_NOISE_SHARE * float(np.linalg.norm(mean[:3]))
        covariance[np.arange(6), np.arange(6)] += windows * np.repeat([turn**2, _SHIFT_NOISE**2], 3)
        covariance[6:, 6:] += renewed * start[6:, 6:]
    information = np.linalg.inv(covariance)
    weighted = information @ mean
    known = np.linalg.inv(window.covariance)
    weighted[:3] += known @ window.w_rad_s
    information[:3, :3] += known
    return np.asarray(np.linalg.solve(information, weighted)), np.asarray(information)


def _unknown(grid: Grid) -> Array:
    """Covariance of the unknowns when nothing is known."""
    x, y = _nodes(grid)
    apart = (x[:, None] - x) ** 2 + (y[:, None] - y) ** 2
    found = np.diag(np.repeat([_TURN_SIGMA**2, _SHIFT_SIGMA**2, 1e-4], [3, 3, _N - 6]))
    plane = _SLOPE**2 * (np.outer(x, x) + np.outer(y, y))
    found[6:, 6:] += plane + _FREE**2 * np.exp(-apart / (2 * _REACH**2))
    return found


def _nodes(grid: Grid) -> tuple[Array, Array]:
    x = grid.left + grid.width / grid.focal * np.linspace(0, 1, COLUMNS)
    y = grid.top + grid.height / grid.focal * np.linspace(0, 1, ROWS)
    across, along = np.meshgrid(x, y)
    return across.ravel(), along.ravel()


def near(rays: Rays, depth: Array, grid: Grid) -> Floats:
    """The inverse depth (N,) at some events, linear between the nodes.

    Args:
        rays: the events.
        depth: inverse depth (ROWS * COLUMNS,) at the nodes, row by row.
        grid: the view.
    """
    out = np.empty_like(rays.x)
    _interpolate(rays.x, rays.y, depth.astype(np.float32).reshape(ROWS, COLUMNS), grid, out)
    return out


def near_reference(rays: Rays, depth: Array, grid: Grid) -> Floats:
    """Reference implementation of `near`, in numpy."""
    found = _basis(rays.x.astype(np.float64), rays.y.astype(np.float64), grid) @ depth
    return np.asarray(np.maximum(found, _LEAST_NEAR), np.float32)


@compiled
def _interpolate(
    xs: Floats, ys: Floats, nodes: Floats, grid: Grid, out: Floats
) -> None:  # pragma: no cover (machine code)
    height, width = nodes.shape
    per_x, per_y = (
        np.float32(grid.focal / grid.width * (width - 1)),
        np.float32(grid.focal / grid.height * (height - 1)),
    )
    left, top, zero, one = np.float32(grid.left), np.float32(grid.top), np.float32(0), np.float32(1)
    most_x, most_y, least = np.float32(width - 1), np.float32(height - 1), np.float32(_LEAST_NEAR)
    for i in range(xs.size):
        u, v = min(max((xs[i] - left) * per_x, zero), most_x), min(max((ys[i] - top) * per_y, zero), most_y)
        column, row = min(np.int32(u), width - 2), min(np.int32(v), height - 2)
        u, v = u - np.float32(column), v - np.float32(row)
        above = nodes[row, column] * (one - u) + nodes[row, column + 1] * u
        below = nodes[row + 1, column] * (one - u) + nodes[row + 1, column + 1] * u
        out[i] = max(above * (one - v) + below * v, least)


def _basis(x: Array, y: Array, grid: Grid) -> Array:
    """Weights (K, nodes) of the nodes at some rays (K,)."""
    hats = []
    for ray, first, size, count in ((x, grid.left, grid.width, COLUMNS), (y, grid.top, grid.height, ROWS)):
        place = np.clip((ray - first) * (grid.focal / size * (count - 1)), 0, count - 1)
        hats.append(np.maximum(1 - np.abs(place[:, None] - np.arange(count)), 0))
    return np.asarray((hats[1][:, :, None] * hats[0][:, None, :]).reshape(x.size, -1))
