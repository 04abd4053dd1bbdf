"""Search: the motion of the camera in a window at which its events are best aligned, given what is known before.

A motion has six numbers: the rotation over the window [rad], and the translation over the depth of the scene. The model
is exact for a scene of one depth. Its second part absorbs what a translation adds to a rotation, so that a rotation is
not taken for what a translation did.

The search maximises the log of the probability: the alignment, scaled as a quasi-likelihood, and a normal prior. It
goes from coarse cells, which reach far, to fine ones, which are exact. On each it takes Newton steps with the analytic
Hessian, and a step that does not help is shortened.
"""

from collections.abc import Sequence
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from neurove_core.refine.alignment import COLUMNS, ROWS, Grid, Rays, Tiles, image, tiles

Array = NDArray[np.float64]

LEVELS: Final = (4, 2, 1)
"""Coarse to fine: cells per cell of the finest image. A coarse image gets every fourth or second event."""

_STEPS: Final = 5  # of one level
_MAX_STEP_CELLS: Final = 3.0  # of motion over the window
_TOLERANCE_CELLS: Final = 0.04
_KEPT: Final = 2  # guesses that are followed after the coarsest level
_MAX_APART_CELLS: Final = 4.0  # of one block, so that one moving thing does not decide
_APART_CELLS: Final = 1.0  # guesses that end nearer to each other are one


class Gaussian(NamedTuple):
    """A normal distribution of a motion over the window."""

    mean: Array  # (6,)
    information: Array  # (6, 6), the inverse of the covariance


class Found(NamedTuple):
    """A local maximum."""

    motion: Array  # (6,) over the window
    score: float  # log of the probability, up to a constant
    information: Array  # (6, 6) of the events alone: minus the Hessian of the scaled alignment
    tiles: Tiles
    grid: Grid


def search(rays: Rays, grid: Grid, prior: Gaussian, guesses: Sequence[Array], levels: Sequence[int] = LEVELS) -> Found:
    """The most probable motion near some guesses.

    Args:
        rays: the events; at least one.
        grid: the finest image.
        prior: what is known of the motion before.
        guesses: motions (6,) over the window.
        levels: coarse to fine, see LEVELS.
    """
    motions, found = list(guesses), list[Found]()
    for level in levels:
        some = Rays(*(np.ascontiguousarray(column[::level]) for column in rays)) if level > 1 else rays
        view = coarser(grid, level)
        scale = scale_of(measure(some, view, motions[0]))
        found = [_ascend(some, view, prior, motion, scale) for motion in motions]
        found.sort(key=lambda one: -one.score)
        motions = [found[0].motion]
        for one in found[1:]:
            apart = min(float(np.linalg.norm(one.motion[:3] - motion[:3])) for motion in motions)
            if len(motions) < _KEPT and level == levels[0] and apart * view.focal > _APART_CELLS:
                motions.append(one.motion)
    return found[0]


def coarser(grid: Grid, level: int) -> Grid:
    """The same view with cells that are `level` times as wide."""
    return Grid(grid.focal / level, grid.left, grid.top, -(-grid.width // level), -(-grid.height // level))


def measure(rays: Rays, grid: Grid, motion: Array) -> Tiles:
    """The alignment at a motion."""
    return tiles(rays, motion, grid, image(rays, motion, grid))


def compile_kernels(grid: Grid) -> None:
    """Compile the kernels of the search, so that the first window does not wait for it."""
    some = np.linspace(-0.5, 0.5, 16).astype(np.float32)
    search(Rays(some, some, some, np.ones_like(some)), grid, Gaussian(np.zeros(6), np.eye(6)), [np.zeros(6)])


def jacobian(x: Array, y: Array) -> Array:
    """Motion of the image (..., 2) of points at x/z, y/z (K,), by the six numbers of a motion: (K, 2, 6)."""
    zero, one = np.zeros_like(x), np.ones_like(x)
    across = np.stack([-x * y, 1 + x * x, -y, one, zero, -x], -1)
    along = np.stack([-(1 + y * y), x * y, x, zero, one, -y], -1)
    return np.stack([across, along], -2)


def scale_of(found: Tiles) -> float:
    """The factor that makes the alignment a quasi-likelihood: the variance of its gradient is then its curvature."""
    curvature = -np.trace(found.hessian.sum(0))
    return float(max(curvature, 0.0) / max(np.trace(found.square.sum(0)), 1e-9))


def _ascend(rays: Rays, grid: Grid, prior: Gaussian, motion: Array, scale: float) -> Found:
    here = _at(rays, grid, prior, motion, scale)
    for _ in range(_STEPS):
        step = _newton(here, prior, scale)
        while np.linalg.norm(step) * grid.focal > _TOLERANCE_CELLS:
            there = _at(rays, grid, prior, here.motion + step, scale)
            if there.score > here.score:
                break
            step = step / 3
        else:
            break
        here = there
    return here


def _at(rays: Rays, grid: Grid, prior: Gaussian, motion: Array, scale: float) -> Found:
    found = measure(rays, grid, motion)
    off = motion - prior.mean
    score = scale * float(found.value.sum()) / 2 - float(off @ prior.information @ off) / 2
    by = jacobian(found.x, found.y) * grid.focal
    information = -scale * np.einsum("kia,kij,kjb->ab", by, found.hessian, by)
    return Found(motion, score, information, found, grid)


def _newton(here: Found, prior: Gaussian, scale: float) -> Array:
    """The step to the maximum of the quadratic model, bounded; uphill where the model has no maximum."""
    by = jacobian(here.tiles.x, here.tiles.y) * here.grid.focal
    gradient = scale * np.einsum("kia,ki->a", by, here.tiles.gradient)
    gradient = gradient - prior.information @ (here.motion - prior.mean)
    values, vectors = np.linalg.eigh(here.information + prior.information)
    floor = 1e-3 * float(np.abs(values).max()) + 1e-12
    step: Array = vectors @ ((vectors.T @ gradient) / np.maximum(np.abs(values), floor))
    size = float(np.linalg.norm(step)) * here.grid.focal
    return step * min(1.0, _MAX_STEP_CELLS / size) if size > 0 else step


class Agreement(NamedTuple):
    """How well the parts of the image agree with one motion."""

    apart: float  # root mean square motion of blocks of tiles against the motion, over the window [rad]
    noise: float  # what it is by noise alone
    sharp: float  # share of the events in blocks whose alignment is at a maximum


def agreement(found: Found) -> Agreement:
    """Compare the motion of blocks of 3 x 3 tiles, weighted by the information of each."""
    tiles = found.tiles
    events, gradient, hessian, square = map(_blocks, (tiles.events, tiles.gradient, tiles.hessian, tiles.square))
    weights, vectors = np.linalg.eigh(-hessian)
    large = weights[:, 1] > 0.02 * max(float(weights.max()), 1e-9)
    weights = np.maximum(weights, 0.1 * weights[:, 1:])[large]
    along = np.einsum("kij,ki->kj", vectors, gradient)[large]
    noise = np.einsum("kij,kil,klj->kj", vectors, square, vectors)[large]
    total = max(float(weights.sum()), 1e-9)
    moved = np.minimum((along / weights) ** 2, _MAX_APART_CELLS**2) * weights
    apart, by_noise = (float(np.sqrt(one.sum() / total)) / found.grid.focal for one in (moved, noise / weights))
    return Agreement(apart, by_noise, float(events[large].sum() / max(events.sum(), 1)))


def _blocks(values: Array) -> Array:
    """Sums (K / 9, ...) over blocks of 3 x 3 tiles."""
    shape = (ROWS // 3, 3, COLUMNS // 3, 3, *values.shape[1:])
    return np.asarray(values.reshape(shape).sum(axis=(1, 3)).reshape(-1, *values.shape[1:]))
