"""Rotations and rigid motions: unit quaternions x y z w, rotation vectors, and the exp and log maps of SO(3) and SE(3).

All functions take arrays of any leading shape (...). A rotation vector [rad] points along the axis, and its length is
the angle. A screw (v, w) has six numbers in the order of a twist: the motion of a constant twist during one second.

Source: standard formulas of SO(3) and SE(3), as in Barfoot 2017, chapter 7.
"""

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

_SMALL_RAD = 1e-3  # below this angle the series replace the quotients; they are exact to the last digits there


def product(a: Array, b: Array) -> Array:
    """Quaternion (..., 4) of the rotation by b followed by the rotation by a."""
    av, aw, bv, bw = a[..., :3], a[..., 3:], b[..., :3], b[..., 3:]
    vector = aw * bv + bw * av + _cross(av, bv)
    return np.concatenate([vector, aw * bw - (av * bv).sum(-1, keepdims=True)], axis=-1)


def inverse(q: Array) -> Array:
    """Quaternion (..., 4) of the inverse rotation."""
    return np.asarray(q * np.array([-1.0, -1.0, -1.0, 1.0]))


def turn(q: Array, v: Array) -> Array:
    """The vectors v (..., 3), rotated by q (..., 4).

    >>> turn(np.array([0.0, 0.0, 0.6, 0.8]), np.array([1.0, 0.0, 0.0])).round(9).tolist()
    [0.28, 0.96, 0.0]
    """
    t = 2 * _cross(q[..., :3], v)
    return np.asarray(v + q[..., 3:] * t + _cross(q[..., :3], t))


def matrix_of(q: Array) -> Array:
    """Rotation matrices (..., 3, 3) of quaternions (..., 4)."""
    x, y, z, w = np.moveaxis(q, -1, 0)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.stack([np.stack(row, -1) for row in rows], -2)


def quaternion_of(matrix: Array) -> Array:
    """Quaternions (..., 4), w >= 0, of rotation matrices (..., 3, 3).

    It divides by the largest of the four components, which is exact for rotations by 180 degrees too.
    """
    m = matrix
    xx, yy, zz = m[..., 0, 0], m[..., 1, 1], m[..., 2, 2]
    x = np.stack([1 + xx - yy - zz, m[..., 0, 1] + m[..., 1, 0], m[..., 0, 2] + m[..., 2, 0]], -1)
    y = np.stack([x[..., 1], 1 - xx + yy - zz, m[..., 1, 2] + m[..., 2, 1]], -1)
    z = np.stack([x[..., 2], y[..., 2], 1 - xx - yy + zz], -1)
    w = np.stack([m[..., 2, 1] - m[..., 1, 2], m[..., 0, 2] - m[..., 2, 0], m[..., 1, 0] - m[..., 0, 1]], -1)
    # row k is the quaternion times four times its component k; the longest row has the smallest rounding error
    rows = np.stack([np.concatenate([r, w[..., k : k + 1]], -1) for k, r in enumerate((x, y, z))], -2)
    last = np.concatenate([w, (1 + xx + yy + zz)[..., None]], -1)
    rows = np.concatenate([rows, last[..., None, :]], -2)
    best = np.linalg.norm(rows, axis=-1).argmax(-1)
    q = np.take_along_axis(rows, best[..., None, None], -2)[..., 0, :]
    q = q / np.linalg.norm(q, axis=-1, keepdims=True)
    return np.asarray(np.where(q[..., 3:] < 0, -q, q))


def exp(phi: Array) -> Array:
    """Quaternions (..., 4) of rotation vectors (..., 3) [rad]."""
    half = np.linalg.norm(phi, axis=-1, keepdims=True) / 2
    return np.concatenate([phi / 2 * np.sinc(half / np.pi), np.cos(half)], axis=-1)


def log(q: Array) -> Array:
    """Rotation vectors (..., 3) [rad] of quaternions (..., 4), at most pi long."""
    q = np.where(q[..., 3:] < 0, -q, q)  # q and -q are the same rotation; w >= 0 gives the shorter angle
    sine = np.linalg.norm(q[..., :3], axis=-1, keepdims=True)
    angle = 2 * np.arctan2(sine, q[..., 3:])
    return np.asarray(q[..., :3] * np.divide(angle, sine, out=np.full_like(sine, 2.0), where=sine > 1e-150))


def slerp(a: Array, b: Array, fraction: Array) -> Array:
    """Spherical linear interpolation (..., 4) from a to b (..., 4), by a fraction (...), along the shorter arc."""
    return product(a, exp(fraction[..., None] * log(product(inverse(a), b))))


def screw_of(q: Array, position: Array) -> Array:
    """Log map of SE(3): screws (..., 6) of the poses with quaternions (..., 4) and positions (..., 3)."""
    phi = log(q)
    angle = np.linalg.norm(phi, axis=-1, keepdims=True)
    safe = np.where(angle < _SMALL_RAD, 1.0, angle)
    series = 1 / 12 + angle**2 / 720
    factor = np.where(angle < _SMALL_RAD, series, (1 - safe / 2 / np.tan(safe / 2)) / safe**2)
    turned = _cross(phi, position)
    v = position - turned / 2 + factor * _cross(phi, turned)
    return np.concatenate([v, phi], axis=-1)


def pose_of(screw: Array) -> tuple[Array, Array]:
    """Exp map of SE(3): quaternions (..., 4) and positions (..., 3) of the poses of screws (..., 6)."""
    v, phi = screw[..., :3], screw[..., 3:]
    angle = np.linalg.norm(phi, axis=-1, keepdims=True)
    safe = np.where(angle < _SMALL_RAD, 1.0, angle)
    first = np.where(angle < _SMALL_RAD, 0.5 - angle**2 / 24, (1 - np.cos(safe)) / safe**2)
    second = np.where(angle < _SMALL_RAD, 1 / 6 - angle**2 / 120, (safe - np.sin(safe)) / safe**3)
    turned = _cross(phi, v)
    return exp(phi), v + first * turned + second * _cross(phi, turned)


def body_twist(screw: Array, rate: Array, terms: int = 8) -> Array:
    """The twist (..., 6) in the body frame while its screw (..., 6) changes at this rate (..., 6) [1/s].

    It is the series of the right Jacobian of SE(3) times the rate; eight terms are exact to 1e-7 below 0.5 rad.
    """
    total = term = rate
    for k in range(1, terms):
        term = -_bracket(screw, term) / (k + 1)
        total = total + term
    return total


def _bracket(a: Array, b: Array) -> Array:
    """Lie bracket of screws (..., 6)."""
    va, wa, vb, wb = a[..., :3], a[..., 3:], b[..., :3], b[..., 3:]
    return np.concatenate([_cross(wa, vb) + _cross(va, wb), _cross(wa, wb)], axis=-1)


def _cross(a: Array, b: Array) -> Array:
    """Cross products (..., 3); numpy.cross takes five times as long on small arrays."""
    a0, a1, a2, b0, b1, b2 = (v[..., k] for v in (a, b) for k in range(3))
    return np.stack([a1 * b2 - a2 * b1, a2 * b0 - a0 * b2, a0 * b1 - a1 * b0], -1)
