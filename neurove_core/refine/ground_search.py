"""Search for the motion over the ground: the objective, its derivatives, and its local maximum."""

from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from neurove_core.refine import ground_kernels as kernels
from neurove_core.refine.ground_kernels import Image, Rays

Array = NDArray[np.float64]

UNKNOWNS: Final = 7
"""Velocity over the height along the axes of the plane (right, into the ground, ahead) [1/s], angular velocity (3)
[rad/s] in the optical frame, and a correction of the pitch [rad]."""

_SUFFICIENT: Final = 1e-4  # share of the expected gain that a step of the search must reach
_LONGEST: Final = 1.5  # greatest change of an unknown in one step [prior sigma]
_TRIES: Final = 5  # shorter steps that are tried before the search ends
_FLAT: Final = 1e-12


class Prior(NamedTuple):
    """What is known before the events; see UNKNOWNS for the order."""

    mean: Array  # (7,)
    sigma: Array  # (7,)
    weight: float  # of half the squared distance in sigma, against the logarithm of the sharpness
    pitch: float  # of the plane [rad] that `Rays.depth` belongs to


def motion_of(unknowns: Array, pitch: float) -> Array:
    """The motion (7,) of `sharpness` for some unknowns (7,), see UNKNOWNS."""
    c, s = np.cos(pitch + unknowns[6]), np.sin(pitch + unknowns[6])
    out = unknowns.copy()
    out[1], out[2] = c * unknowns[1] - s * unknowns[2], s * unknowns[1] + c * unknowns[2]
    return out


def objective(z: Array, rays: Rays, image: Image, prior: Prior) -> tuple[float, Array]:
    """The objective and its gradient by z (7,), the distance from the prior's mean [sigma]."""
    unknowns = prior.mean + prior.sigma * z
    motion = motion_of(unknowns, prior.pitch)
    value, by_motion = kernels.sharpness(rays, motion, image)
    c, s = np.cos(prior.pitch + unknowns[6]), np.sin(prior.pitch + unknowns[6])
    by = by_motion.copy()
    by[1], by[2] = c * by_motion[1] + s * by_motion[2], c * by_motion[2] - s * by_motion[1]
    by[6] += by_motion[2] * motion[1] - by_motion[1] * motion[2]
    return value - 0.5 * prior.weight * np.dot(z, z), prior.sigma * by - prior.weight * z


def curvature(z: Array, gradient: Array, rays: Rays, image: Image, prior: Prior, step: float) -> Array:
    """The Hessian (7, 7) of the objective at z, by differences of its gradient."""
    out = np.empty((UNKNOWNS, UNKNOWNS))
    for i in range(UNKNOWNS):
        there = z.copy()
        there[i] += step
        out[i] = (objective(there, rays, image, prior)[1] - gradient) / step
    return (out + out.T) / 2


def climb(
    start: Array,
    rays: Rays,
    image: Image,
    prior: Prior,
    most: int,
    tolerance: float,
) -> tuple[Array, float, Array, int]:
    """The local maximum of the objective near z (7,); BFGS with a backtracking line search.

    Returns:
        z, the value there, its gradient, and the number of evaluations.
    """
    z = start.copy()
    value, gradient = objective(z, rays, image, prior)
    inverse, count, identity = np.zeros((UNKNOWNS, UNKNOWNS)), 1, np.eye(UNKNOWNS)
    fresh = True
    while count < most:
        if fresh:
            inverse = identity / max(4 * prior.weight, 2 * np.sqrt(np.dot(gradient, gradient)))
        step = inverse @ gradient
        expected = np.dot(step, gradient)
        if expected <= 0:
            if fresh:
                break
            fresh = True
            continue
        longest = np.abs(step).max()
        if longest > _LONGEST:
            step *= _LONGEST / longest
            expected *= _LONGEST / longest
        found = False
        here, there = value, gradient
        for _ in range(_TRIES):
            here, there = objective(z + step, rays, image, prior)
            count += 1
            if here > value + _SUFFICIENT * expected:
                found = True
                break
            step /= 3
            expected /= 3
        if not found:
            break
        change = gradient - there
        along = np.dot(step, change)
        if along > _FLAT:
            left = identity - np.outer(step, change) / along
            inverse = left @ inverse @ left.T + np.outer(step, step) / along
            fresh = False
        z, gain = z + step, here - value
        value, gradient = here, there
        if np.abs(step).max() < tolerance or gain < tolerance * tolerance:
            break
    return z, value, gradient, count
