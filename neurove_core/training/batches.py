"""Batches of random segments of sequences, with augmentation: mirrored, flipped, sped up, and with disturbances."""

import math
from typing import Final, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from neurove_core.config import ModelConfig
from neurove_core.ingest.channels import network_input
from neurove_core.training.config import RecipeConfig
from neurove_core.training.data import Sequences

_MIRRORED = np.array([-1, 1, 1, 1, -1, -1], np.float32)
"""Factors of a twist in a mirror across x; see `mirrored`."""

_SEEN_FIRST: Final = 4  # least number of complete windows before a disturbance; they give the network a speed to hold


class Segment(NamedTuple):
    """S consecutive windows of B streams; each stream starts from the zero state."""

    counts: Tensor  # (S, B, C, H, W) uint8, the network's input before its encoding
    twists: Tensor  # (S, B, n, 6): vx vy vz per metre of camera height [1/s], wx wy wz [rad/s]
    height_m: Tensor  # (B)


def draw(
    rng: np.random.Generator, sequences: Sequences, recipe: RecipeConfig, model: ModelConfig | None = None
) -> Segment:
    """Draw a segment for each stream of a batch, from a random sequence and a random position in it.

    Args:
        rng: of the run.
        sequences: to draw from.
        recipe: of the run.
        model: its subcells and its history; by default the stored counts are the input.
    """
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
        counts.append(seen if model is None else network_input(seen, model))
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
    """Apply random augmentations to the segment of one stream.

    Args:
        rng: of the run.
        counts: (S, 2n, H, W).
        twists: (S, n, 6).
        recipe: probability and size of each change.
    """
    if _happens(rng, recipe.still):
        seen = stationary(rng, counts.shape, math.exp(rng.uniform(*np.log(recipe.still_noise))))
        return with_hot_pixels(rng, seen, recipe) if _happens(rng, recipe.hot) else seen, np.zeros_like(twists)
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
    """Return True with this probability.

    With probability 0 no number is drawn, so that a recipe without this augmentation keeps its random sequence.
    """
    return share > 0 and bool(rng.uniform() < share)


def lopsided(rng: np.random.Generator, counts: NDArray[np.uint8], ratio: float) -> NDArray[np.uint8]:
    """Multiply the ratio of ON to OFF events in counts (S, 2n, H, W) by `ratio`, as unequal thresholds do."""
    seen = counts.copy(order="C")
    for polarity, gain in ((0, ratio**-0.5), (1, ratio**0.5)):
        seen[:, polarity::2] = with_gain(rng, seen[:, polarity::2], gain)
    return seen


def with_hot_pixels(rng: np.random.Generator, counts: NDArray[np.uint8], recipe: RecipeConfig) -> NDArray[np.uint8]:
    """Add hot cells to counts (S, 2n, H, W): three on average, each with its own rate and share of ON events."""
    seen = counts.copy(order="C")
    segment, channels, rows, columns = seen.shape
    for _ in range(1 + rng.poisson(2.0)):
        rate, on = math.exp(rng.uniform(*np.log(recipe.hot_rate))), rng.uniform()
        row, column = rng.integers(rows), rng.integers(columns)
        fired = rng.poisson(rate * np.tile([1 - on, on], channels // 2), (segment, channels))
        seen[:, :, row, column] = np.minimum(seen[:, :, row, column] + fired, 255)
    return seen


def thinned(rng: np.random.Generator, counts: NDArray[np.uint8], recipe: RecipeConfig) -> NDArray[np.uint8]:
    """Remove most events of a segment (S, 2n, H, W) from a random window on; the motion of the camera is unchanged."""
    first, seen = int(rng.integers(_SEEN_FIRST, max(_SEEN_FIRST + 1, len(counts) // 2))), counts.copy(order="C")
    seen[first:] = with_gain(rng, seen[first:], math.exp(rng.uniform(*np.log(recipe.thinned_to))))
    return seen


def with_gaps(rng: np.random.Generator, counts: NDArray[np.uint8], recipe: RecipeConfig) -> NDArray[np.uint8]:
    """Put gaps into a segment (S, 2n, H, W): windows without events while the camera keeps moving.

    Complete windows come before each gap.
    """
    seen, at = counts.copy(order="C"), 0
    while at < len(seen):
        at += int(rng.integers(_SEEN_FIRST, 4 * _SEEN_FIRST))
        length = int(math.exp(rng.uniform(*np.log(recipe.hole_windows))))
        seen[at : at + length] = 0
        at += length
    return seen


def mirrored(counts: NDArray[np.uint8], twists: NDArray[np.float32]) -> tuple[NDArray[np.uint8], NDArray[np.float32]]:
    """Mirror counts and twists across x, as a camera in a mirrored world: vx, wy and wz change their sign.

    The angular velocity is an axial vector. A mirror across x keeps its x component and inverts the other two.
    """
    return counts[..., ::-1], twists * _MIRRORED


def doubled(counts: NDArray[np.uint8], twists: NDArray[np.float32]) -> tuple[NDArray[np.uint8], NDArray[np.float32]]:
    """Double the speed of the motion: two bins become one, and half of the windows remain.

    Changes of brightness cause events, independently of the time they take. Except for noise and refractory times, the
    result is therefore what a camera at twice the speed sees. The network sees one scene at several speeds, so that it
    does not derive the speed from the scene.

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
    """Reverse time: ON events become OFF events, and every velocity changes its sign.

    >>> counts = np.arange(8, dtype=np.uint8).reshape(2, 4, 1, 1)
    >>> backwards(counts, np.ones((2, 2, 6), np.float32))[0].ravel().tolist()
    [7, 6, 5, 4, 3, 2, 1, 0]
    """
    return counts[::-1, ::-1], -twists[::-1, ::-1]


def polarity_flipped(counts: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Swap ON and OFF, as in a world of inverted brightness with the same motion."""
    bins = counts.shape[1] // 2
    return counts[:, np.arange(2 * bins) ^ 1]


def with_gain(rng: np.random.Generator, counts: NDArray[np.uint8], gain: float) -> NDArray[np.uint8]:
    """Multiply each count by a gain; random rounding keeps the mean, and counts saturate at 255."""
    scaled = counts.copy(order="C").reshape(-1)
    seen = np.flatnonzero(scaled)
    scaled[seen] = np.minimum(scaled[seen] * gain + rng.uniform(size=seen.size), 255).astype(np.uint8)
    return scaled.reshape(counts.shape)


def stationary(rng: np.random.Generator, shape: tuple[int, ...], mean: float) -> NDArray[np.uint8]:
    """Draw the counts of a stationary camera in a static scene: noise only, with a different rate for each cell.

    Args:
        rng: of the run.
        shape: (S, 2n, H, W) of the counts.
        mean: events per cell and bin; the rates of the cells and polarities are exponentially distributed.
    """
    segment, channels, rows, columns = shape
    rates = mean * rng.standard_exponential((2, rows, columns), np.float32)
    drawn = rng.poisson(np.tile(rates, (channels // 2, 1, 1)), (segment, channels, rows, columns))
    return np.minimum(drawn, 255).astype(np.uint8)


def with_noise(rng: np.random.Generator, counts: NDArray[np.uint8], mean: float) -> NDArray[np.uint8]:
    """Add random events, `mean` per cell and bin."""
    added = counts.copy(order="C").reshape(-1)
    where = rng.integers(added.size, size=rng.poisson(mean * added.size))
    where = where[added[where] < 200]  # so that no count wraps around
    np.add.at(added, where, np.uint8(1))
    return added.reshape(counts.shape)
