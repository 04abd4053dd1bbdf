"""Procedural textures: periodic, with many octaves and a mip chain each; the seed draws their contrast."""

from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

SIZE: Final = 512
"""Side of a texture [texels]; textures are periodic."""

LEVELS: Final = 8
"""Number of mip levels; each has half the side of the previous one."""

NAMES: Final = ("asphalt", "facade", "brick", "posters", "foliage", "paint", "metal", "plaster")
"""Names of the textures; a panel has the index of its texture."""

_CHAIN = [(SIZE >> level) ** 2 for level in range(LEVELS)]
LEVEL_START: Final = np.cumsum([0, *_CHAIN[:-1]])
"""Start of each level in the chain of a texture [texels]."""

CHAIN: Final = sum(_CHAIN)
"""Number of texels of a texture with all levels."""


class Textures(NamedTuple):
    """All textures of a scene, linear intensity from about 0.02 to 1."""

    texels: NDArray[np.float32]  # (len(NAMES) * CHAIN,) texture after texture, level after level, row after row

    def level(self, name: str, level: int = 0) -> NDArray[np.float32]:
        """One level of a texture as an image; a view, not a copy."""
        start = NAMES.index(name) * CHAIN + int(LEVEL_START[level])
        side = SIZE >> level
        return self.texels[start : start + side * side].reshape(side, side)


def make_textures(seed: int) -> Textures:
    """Create the textures of a seed; other seeds give other textures with other contrasts.

    >>> make_textures(1).level("brick").shape
    (512, 512)
    """
    rng = np.random.default_rng((seed, 101))
    images = {
        "asphalt": _lognormal(0.20, 0.20 * _noise(rng, 1.2) + 0.15 * _noise(rng, 0.3)),
        "facade": _windows(rng, _lognormal(0.45, 0.25 * _noise(rng, 1.3)), 4, 3),
        "brick": _bricks(rng, _lognormal(0.30, 0.30 * _noise(rng, 1.0))),
        "posters": _rectangles(rng, _lognormal(0.40, 0.30 * _noise(rng, 1.2)), 90),
        "foliage": _lognormal(0.16, 0.40 * _noise(rng, 1.0)),
        "paint": _lognormal(0.80, 0.08 * _noise(rng, 0.8)),
        "metal": _rectangles(rng, _lognormal(0.35, 0.15 * _noise(rng, 1.4)), 25),
        "plaster": _lognormal(0.55, 0.18 * _noise(rng, 1.2) + 0.06 * _noise(rng, 0.2)),
    }
    return Textures(np.concatenate([_chain(_contrasted(rng, images[name])) for name in NAMES]))


def _noise(rng: np.random.Generator, fall: float) -> NDArray[np.float64]:
    """Periodic noise (SIZE, SIZE) of variance 1 whose amplitude falls as 1 / frequency^fall."""
    frequency = np.hypot(np.fft.fftfreq(SIZE)[:, None], np.fft.rfftfreq(SIZE))
    frequency[0, 0] = 1
    spectrum = np.fft.rfft2(rng.standard_normal((SIZE, SIZE))) / frequency**fall
    spectrum[0, 0] = 0
    noise: NDArray[np.float64] = np.fft.irfft2(spectrum, (SIZE, SIZE))
    noise /= noise.std()
    return noise


def _lognormal(middle: float, log_noise: NDArray[np.float64]) -> NDArray[np.float64]:
    return middle * np.exp(log_noise)


def _windows(rng: np.random.Generator, wall: NDArray[np.float64], columns: int, rows: int) -> NDArray[np.float64]:
    """Draw a grid of windows on a wall, each with its own brightness and a bright frame."""
    across, down = SIZE // columns, SIZE // rows
    for row in range(rows):
        for column in range(columns):
            top, left = row * down + down // 4, column * across + across // 4
            wide, high = int(across * rng.uniform(0.4, 0.55)), int(down * rng.uniform(0.45, 0.6))
            frame = max(2, across // 24)
            wall[top - frame : top + high + frame, left - frame : left + wide + frame] *= 1.5
            glass = rng.uniform(0.04, 0.35) * (1 + 0.6 * np.linspace(-0.5, 0.5, high))[:, None]
            wall[top : top + high, left : left + wide] = glass
            wall[top : top + high, left + wide // 2 : left + wide // 2 + frame] = 0.6
    return wall


def _bricks(rng: np.random.Generator, wall: NDArray[np.float64]) -> NDArray[np.float64]:
    """Draw bricks with light joints; every second course is shifted, and each brick has its own brightness."""
    high, wide = 16, 32
    for course in range(SIZE // high):
        tone = np.repeat(rng.uniform(0.6, 1.5, SIZE // wide), wide)
        tone[::wide] = tone[1::wide] = 1.9
        rows = slice(course * high, (course + 1) * high)
        wall[rows] *= np.roll(tone, wide // 2 * (course % 2))
        wall[course * high : course * high + 2] *= 1.4
    return wall


def _rectangles(rng: np.random.Generator, image: NDArray[np.float64], count: int) -> NDArray[np.float64]:
    """Draw rectangles of all sizes over an image, also across its borders, each lighter or darker than the image."""
    for _ in range(count):
        wide, high = (8 * 16 ** rng.uniform(0, 1, 2)).astype(int)
        rows = (rng.integers(SIZE) + np.arange(high)) % SIZE
        columns = (rng.integers(SIZE) + np.arange(wide)) % SIZE
        patch = np.ix_(rows, columns)
        image[patch] = 0.3 * image[patch] + 0.7 * rng.uniform(0.05, 0.95)
    return image


def _contrasted(rng: np.random.Generator, image: NDArray[np.float64]) -> NDArray[np.float64]:
    """Scale the log contrast of an image about its mean by a random factor, within the range of real surfaces."""
    level = np.log(image)
    mean = level.mean()
    stretched: NDArray[np.float64] = np.exp(mean + rng.uniform(0.7, 1.4) * (level - mean))
    return stretched.clip(0.015, 1.0)


def _chain(image: NDArray[np.float64]) -> NDArray[np.float32]:
    """The mip chain of an image: each texel is the mean of four of the previous level."""
    levels = []
    for _ in range(LEVELS):
        levels.append(image.astype(np.float32).ravel())
        image = image.reshape(image.shape[0] // 2, 2, image.shape[1] // 2, 2).mean((1, 3))
    return np.concatenate(levels)
