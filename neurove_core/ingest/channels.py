"""Channels of the network's input: the parts of a cell, and the history.

A window has 2n * parts channels: channel (2 * bin + polarity) * parts + part, polarity 0 is OFF. With
`canonical.subcells` = 2 a cell has four parts: 0 is its upper left quarter, 1 the upper right, 2 the lower left, 3 the
lower right. With 1 it has one part.

`network.history` = (a, b, ...) appends 2 * parts channels for each number: the counts of the `a` windows before this
one, then of the `b` windows before those, and so on, in the order polarity * parts + part. A longer bin thus covers
earlier windows only, and no two bins overlap. All counts saturate at 255. A stream without earlier windows has zeros.
"""

import numpy as np
from numpy.typing import NDArray

from neurove_core.compiled import compiled
from neurove_core.config import CanonicalConfig, ModelConfig

Counts = NDArray[np.uint8]

Recent = tuple[Counts, ...]
"""Sums (2 * parts, H, W) of the earlier windows of a stream, the newest first; see `remembered`."""


def to_parts(counts: Counts, subcells: int) -> Counts:
    """Arrange a fine grid as the parts of coarser cells (space-to-depth).

    >>> to_parts(np.array([[[1, 2], [3, 4]]], np.uint8), 2).ravel().tolist()
    [1, 2, 3, 4]

    Args:
        counts: (..., C, subcells * H, subcells * W).
        subcells: see CanonicalConfig.

    Returns:
        (..., C * subcells**2, H, W); the part of a cell is the last of the channel's indices.
    """
    if subcells == 1:
        return counts
    *before, channels, rows, columns = counts.shape
    found = np.empty((*before, channels, subcells**2, rows // subcells, columns // subcells), np.uint8)
    for part in range(subcells**2):
        found[..., part, :, :] = counts[..., part // subcells :: subcells, part % subcells :: subcells]
    parts: Counts = found.reshape(*before, -1, *found.shape[-2:])
    return parts


def to_cells(counts: Counts, factor: int) -> Counts:
    """Sum a fine grid to cells of `factor` times its size in each direction, saturating at 255.

    Args:
        counts: (..., C, factor * H, factor * W).
        factor: cells of the fine grid per cell and axis.

    Returns:
        (..., C, H, W).
    """
    if factor == 1:
        return counts
    total = np.zeros((*counts.shape[:-2], counts.shape[-2] // factor, counts.shape[-1] // factor), np.uint16)
    for part in range(factor**2):
        total += counts[..., part // factor :: factor, part % factor :: factor]
    return np.minimum(total, 255).astype(np.uint8)


def window_counts(stored: Counts, canonical: CanonicalConfig) -> Counts:
    """The channels of windows from their counts on the canonical grid or on one that is finer.

    Args:
        stored: (..., 2n, k * H, k * W), k a multiple of `canonical.subcells`.
        canonical: of the model.

    Returns:
        (..., 2n * parts, H, W).
    """
    factor = stored.shape[-1] // (canonical.width * canonical.subcells)
    return to_parts(to_cells(stored, factor), canonical.subcells)


def network_input(stored: Counts, config: ModelConfig) -> Counts:
    """The network's input for consecutive windows of one stream that begins with them.

    Args:
        stored: (S, 2n, k * H, k * W), as in `window_counts`.
        config: of the model.

    Returns:
        (S, C, H, W) with the C of `ModelConfig.input_shape`.
    """
    counts = window_counts(stored, config.canonical)
    if not config.network.history:
        return counts
    found, recent = np.empty((len(counts), *config.input_shape), np.uint8), Recent()
    for at, window in enumerate(counts):
        found[at] = with_history(window, recent, config)
        recent = remembered(window, recent, config)
    return found


def with_history(window: Counts, recent: Recent, config: ModelConfig) -> Counts:
    """Append the channels of the history to those of a window.

    Args:
        window: (2n * parts, H, W).
        recent: of the earlier windows of the stream.
        config: of the model.

    Returns:
        (C, H, W) with the C of `ModelConfig.input_shape`; the window itself where the model has no history.
    """
    if not config.network.history:
        return window
    found, first, into = np.zeros(config.input_shape, np.uint8), 0, len(window)
    found[:into] = window
    for windows in config.network.history:
        channels = found[into : into + 2 * config.canonical.parts].reshape(-1)
        for one in recent[first : first + windows]:
            add_saturating(channels, one.reshape(-1))
        first, into = first + windows, into + 2 * config.canonical.parts
    return found


def remembered(window: Counts, recent: Recent, config: ModelConfig) -> Recent:
    """The sums of the newest windows, the newest first, as many as the history needs.

    Args:
        window: (2n * parts, H, W), the newest.
        recent: result of the previous window; empty for the first one.
        config: of the model.
    """
    if not config.network.history:
        return ()
    bins = window.reshape(config.window.bins, -1)
    total = bins[0].copy()
    for one in bins[1:]:
        add_saturating(total, one)
    own = total.reshape(2 * config.canonical.parts, *window.shape[1:])
    return (own, *recent)[: sum(config.network.history)]


def add_saturating_reference(into: Counts, values: Counts) -> None:
    """The reference implementation of add_saturating, in numpy."""
    into += np.minimum(values, 255 - into)


@compiled
def add_saturating(into: Counts, values: Counts) -> None:  # pragma: no cover (machine code)
    """Add counts (N,) in place; sums saturate at 255."""
    for i in range(into.size):
        into[i] = np.uint8(min(np.uint16(into[i]) + np.uint16(values[i]), np.uint16(255)))
