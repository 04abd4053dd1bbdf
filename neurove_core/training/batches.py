"""Segments of sequences side by side, as the loop learns from them: drawn at random, mirrored, flipped, disturbed."""

import math
from typing import Final, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from neurove_core.training.config import RecipeConfig
from neurove_core.training.data import Sequences

_MIRRORED = np.array([-1, 1, 1, 1, -1, -1], np.float32)
"""What a mirror across x makes of a twist; see `mirrored`."""

_SEEN_FIRST: Final = 4  # so many windows at least before the feed thins or ends, else there is no speed to go on with


class Segment(NamedTuple):
    """S consecutive windows of B streams, each from a state at rest."""

    counts: Tensor  # (S, B, 2n, H, W) uint8
    twists: Tensor  # (S, B, n, 6): vx vy vz per metre of camera height [1/s], wx wy wz [rad/s]
    height_m: Tensor  # (B)


def draw(rng: np.random.Generator, sequences: Sequences, recipe: RecipeConfig) -> Segment:
    """A segment for each stream of a batch, from any sequence and any place in it."""
    counts, twists, heights = [], [], []
    for _ in range(recipe.batch):
        index = int(rng.integers(len(sequences)))
        twice = bool(rng.uniform() < recipe.doubled)
        windows = recipe.segment_windows * (1 + twice)
        start = int(rng.integers(len(sequences.twists[index]) - windows + 1))
        seen, truth = sequences.counts(index, start, start + windows), sequences.twists[index][start : start + windows]
        if twice:
            seen, truth = doubled(seen, truth)
        seen, truth = augment(rng, seen, truth, recipe)
        counts.append(seen)
        twists.append(truth)
        heights.append(sequences.height_m[index])
    return Segment(
        torch.from_numpy(np.stack(counts, 1)),
        torch.from_numpy(np.stack(twists, 1)),
        torch.tensor(heights, dtype=torch.float32),
    )


def augment(
    rng: np.random.Generator, counts: NDArray[np.uint8], twists: NDArray[np.float32], recipe: RecipeConfig
) -> tuple[NDArray[np.uint8], NDArray[np.float32]]:
    """One stream's segment as another camera could have seen it.

    Args:
        rng: of the run.
        counts: (S, 2n, H, W).
        twists: (S, n, 6).
        recipe: how often each change is made.
    """
    if _happens(rng, recipe.still):
        rest = stationary(rng, counts.shape, math.exp(rng.uniform(*np.log(recipe.still_noise))))
        return with_hot_pixels(rng, rest, recipe) if _happens(rng, recipe.hot) else rest, np.zeros_like(twists)
    chance = rng.uniform(size=5)
    gain, noise = math.exp(rng.uniform(*np.log(recipe.gain))), rng.uniform(0, recipe.noise_max)
    if chance[0] < recipe.mirror:
        counts, twists = mirrored(counts, twists)
    if chance[4] < recipe.reversed:
        counts, twists = backwards(counts, twists)
    if chance[1] < recipe.polarity_flip:
        counts = polarity_flipped(counts)
    if chance[2] < recipe.regained:
        counts = with_gain(rng, counts, gain)
    if chance[3] < recipe.noisy:
        counts = with_noise(rng, counts, noise)
    if _happens(rng, recipe.lopsided):
        counts = lopsided(rng, counts, math.exp(rng.uniform(*np.log(recipe.lopsided_by))))
    if _happens(rng, recipe.hot):
        counts = with_hot_pixels(rng, counts, recipe)
    if _happens(rng, recipe.thinned):
        counts = thinned(rng, counts, recipe)
    if _happens(rng, recipe.holes):
        counts = with_gaps(rng, counts, recipe)
    return counts, twists


def _happens(rng: np.random.Generator, share: float) -> bool:
    """Whether it happens this time; what never does draws no number, so a recipe without it draws as it always did."""
    return share > 0 and bool(rng.uniform() < share)


def lopsided(rng: np.random.Generator, counts: NDArray[np.uint8], ratio: float) -> NDArray[np.uint8]:
    """Counts (S, 2n, H, W) of pixels whose thresholds differ: ON over OFF becomes so many times what it was."""
    seen = counts.copy(order="C")
    for polarity, gain in ((0, ratio**-0.5), (1, ratio**0.5)):
        seen[:, polarity::2] = with_gain(rng, seen[:, polarity::2], gain)
    return seen


def with_hot_pixels(rng: np.random.Generator, counts: NDArray[np.uint8], recipe: RecipeConfig) -> NDArray[np.uint8]:
    """Counts (S, 2n, H, W) with cells that fire all the time, three in the mean, each with a rate and a share of ON."""
    seen = counts.copy(order="C")
    segment, channels, rows, columns = seen.shape
    for _ in range(1 + rng.poisson(2.0)):
        rate, on = math.exp(rng.uniform(*np.log(recipe.hot_rate))), rng.uniform()
        row, column = rng.integers(rows), rng.integers(columns)
        fired = rng.poisson(rate * np.tile([1 - on, on], channels // 2), (segment, channels))
        seen[:, :, row, column] = np.minimum(seen[:, :, row, column] + fired, 255)
    return seen


def thinned(rng: np.random.Generator, counts: NDArray[np.uint8], recipe: RecipeConfig) -> NDArray[np.uint8]:
    """A segment (S, 2n, H, W) that has few events from some window on, while the camera moves as before."""
    first, seen = int(rng.integers(_SEEN_FIRST, max(_SEEN_FIRST + 1, len(counts) // 2))), counts.copy(order="C")
    seen[first:] = with_gain(rng, seen[first:], math.exp(rng.uniform(*np.log(recipe.thinned_to))))
    return seen


def with_gaps(rng: np.random.Generator, counts: NDArray[np.uint8], recipe: RecipeConfig) -> NDArray[np.uint8]:
    """A segment (S, 2n, H, W) with holes in its feed, while the camera moves on: something was seen before each."""
    seen, at = counts.copy(order="C"), 0
    while at < len(seen):
        at += int(rng.integers(_SEEN_FIRST, 4 * _SEEN_FIRST))
        length = int(math.exp(rng.uniform(*np.log(recipe.hole_windows))))
        seen[at : at + length] = 0
        at += length
    return seen


def mirrored(counts: NDArray[np.uint8], twists: NDArray[np.float32]) -> tuple[NDArray[np.uint8], NDArray[np.float32]]:
    """What a camera in a mirrored world would see: x runs the other way; vx, wy and wz change their sign.

    The angular velocity is an axial vector: in a mirror across x its x component stays and the others turn around.
    """
    return counts[..., ::-1], twists * _MIRRORED


def doubled(counts: NDArray[np.uint8], twists: NDArray[np.float32]) -> tuple[NDArray[np.uint8], NDArray[np.float32]]:
    """The same motion at twice the speed: two bins become one, and half as many windows are left.

    Events come from changes of brightness, not from time, so but for noise and dead times this is what would be seen.
    So speed is not told by the scene: a street has been gone through at several.

    >>> counts = np.arange(8, dtype=np.uint8).reshape(2, 4, 1, 1)  # 2 windows of 2 bins, OFF and ON of each
    >>> doubled(counts, np.ones((2, 2, 6), np.float32))[0].ravel().tolist()
    [2, 4, 10, 12]
    """
    windows, channels, rows, columns = counts.shape
    bins = channels // 2
    pairs = counts[: windows // 2 * 2].reshape(windows // 2 * bins, 2, 2, rows, columns)
    summed = np.minimum(pairs[:, 0], 255 - pairs[:, 1]) + pairs[:, 1]
    faster = twists[: windows // 2 * 2].reshape(windows // 2 * bins, 2, 6).mean(axis=1) * np.float32(2)
    return summed.reshape(-1, channels, rows, columns), faster.reshape(-1, bins, 6)


def backwards(counts: NDArray[np.uint8], twists: NDArray[np.float32]) -> tuple[NDArray[np.uint8], NDArray[np.float32]]:
    """The film run backwards: what got brighter gets darker, and every velocity turns around.

    >>> counts = np.arange(8, dtype=np.uint8).reshape(2, 4, 1, 1)
    >>> backwards(counts, np.ones((2, 2, 6), np.float32))[0].ravel().tolist()
    [7, 6, 5, 4, 3, 2, 1, 0]
    """
    return counts[::-1, ::-1], -twists[::-1, ::-1]


def polarity_flipped(counts: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """ON as OFF: a world whose dark is bright, moving as before."""
    bins = counts.shape[1] // 2
    return counts[:, np.arange(2 * bins) ^ 1]


def with_gain(rng: np.random.Generator, counts: NDArray[np.uint8], gain: float) -> NDArray[np.uint8]:
    """Each count times a gain, rounded at random so that the mean is exact; saturating as a window does."""
    scaled = counts.copy(order="C").reshape(-1)
    seen = np.flatnonzero(scaled)
    scaled[seen] = np.minimum(scaled[seen] * gain + rng.uniform(size=seen.size), 255).astype(np.uint8)
    return scaled.reshape(counts.shape)


def stationary(rng: np.random.Generator, shape: tuple[int, ...], mean: float) -> NDArray[np.uint8]:
    """What a camera sees that stands still in a world that does: the noise of its pixels, some louder than others.

    Args:
        rng: of the run.
        shape: (S, 2n, H, W) of the counts.
        mean: events per cell and bin; each cell and polarity has a rate of its own, exponentially distributed.
    """
    segment, channels, rows, columns = shape
    rates = mean * rng.standard_exponential((2, rows, columns), np.float32)
    drawn = rng.poisson(np.tile(rates, (channels // 2, 1, 1)), (segment, channels, rows, columns))
    return np.minimum(drawn, 255).astype(np.uint8)


def with_noise(rng: np.random.Generator, counts: NDArray[np.uint8], mean: float) -> NDArray[np.uint8]:
    """Random events added, `mean` of them per cell and bin."""
    added = counts.copy(order="C").reshape(-1)
    where = rng.integers(added.size, size=rng.poisson(mean * added.size))
    where = where[added[where] < 200]  # so that no count wraps around
    np.add.at(added, where, np.uint8(1))
    return added.reshape(counts.shape)
