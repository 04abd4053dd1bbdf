"""Search for the motion over the ground: the objective, its derivatives, and its local maximum."""

from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from neurove_core.refine import ground_kernels as kernels
from neurove_core.refine.ground_kernels import Image, Rays

Array = NDArray[np.float64]

UNKNOWNS: Final = 9
"""Velocity over the height along the axes of the plane (right, into the ground, ahead) [1/s], angular velocity (3)
[rad/s] in the optical frame, and corrections of the pitch [rad] and of the height over the distance of the walls to the
right and to the left."""

_LONGEST: Final = 1.5  # greatest change of an unknown in one step [prior sigma]
_TRIES: Final = 3  # shorter steps that are tried before the search ends
_FLAT: Final = 1e-12


class Prior(NamedTuple):
    """What is known before the events; see UNKNOWNS for the order."""

    mean: Array  # (9,)
    sigma: Array  # (9,)
    weight: float  # of half the squared distance in sigma, against the logarithm of the sharpness
    pitch: float  # of the plane [rad] that `Rays.depth` belongs to


def motion_of(unknowns: Array, pitch: float) -> Array:
    """The motion (9,) of `sharpness` for some unknowns (9,), see UNKNOWNS."""
    c, s = np.cos(pitch + unknowns[6]), np.sin(pitch + unknowns[6])
    out = unknowns.copy()
    out[1], out[2] = c * unknowns[1] - s * unknowns[2], s * unknowns[1] + c * unknowns[2]
    return out


def objective(z: Array, rays: Rays, image: Image, prior: Prior) -> tuple[float, Array]:
    """The objective and its gradient by z (9,), the distance from the prior's mean [sigma]."""
    unknowns = prior.mean + prior.sigma * z
    motion = motion_of(unknowns, prior.pitch)
    value, by_motion = kernels.sharpness(rays, motion, image)
    c, s = np.cos(prior.pitch + unknowns[6]), np.sin(prior.pitch + unknowns[6])
    by = by_motion.copy()
    by[1], by[2] = c * by_motion[1] + s * by_motion[2], c * by_motion[2] - s * by_motion[1]
    by[6] += by_motion[2] * motion[1] - by_motion[1] * motion[2]
    return value - 0.5 * prior.weight * np.dot(z, z), prior.sigma * by - prior.weight * z


def bent(z: Array, rays: Rays, image: Image, prior: Prior) -> tuple[float, Array, Array]:
    """The objective, its gradient by z (9,), and the information (9, 9) of the events about z.

    The information is minus the Hessian of the logarithm of the sharpness, see `ground_kernels.bend`, without its
    negative eigenvalues.
    """
    unknowns = prior.mean + prior.sigma * z
    motion = motion_of(unknowns, prior.pitch)
    value, by_motion, second = kernels.sharpness_and_bend(rays, motion, image)
    c, s = np.cos(prior.pitch + unknowns[6]), np.sin(prior.pitch + unknowns[6])
    chain = np.eye(UNKNOWNS)
    chain[1:3, 1:3] = [[c, -s], [s, c]]
    chain[1, 6], chain[2, 6] = -motion[2], motion[1]
    chain = chain * prior.sigma
    values, vectors = np.linalg.eigh(-chain.T @ second @ chain)
    information = vectors @ (np.maximum(values, 0)[:, None] * vectors.T)
    return value - 0.5 * prior.weight * np.dot(z, z), chain.T @ by_motion - prior.weight * z, information


class Climbed(NamedTuple):
    """A local maximum of the objective."""

    z: Array  # (9,)
    value: float
    information: Array  # (9, 9) see `bent`
    evaluations: int


def climb(start: Array, rays: Rays, image: Image, prior: Prior, most: int, tolerance: float) -> Climbed:
    """The local maximum of the objective near z (9,); Newton steps, shortened where they do not help.

    Args:
        start: where it begins.
        rays: the events.
        image: into which they are moved.
        prior: what is known before.
        most: evaluations.
        tolerance: least step [prior sigma].
    """
    z = start.copy()
    value, gradient, information = bent(z, rays, image, prior)
    count, identity = 1, np.eye(UNKNOWNS)
    while count < most:
        step = np.linalg.solve(information + prior.weight * identity, gradient)
        step = step * min(1.0, _LONGEST / max(float(np.abs(step).max()), _FLAT))
        there = value, gradient, information
        for _ in range(_TRIES):
            there = bent(z + step, rays, image, prior)
            count += 1
            if there[0] > value:
                break
            step = step / 4
        else:
            break
        z, gain = z + step, there[0] - value
        value, gradient, information = there
        if np.abs(step).max() < tolerance or gain < tolerance * tolerance:
            break
    return Climbed(z, value, information, count)
