"""How a recording is divided: pieces to learn from, pieces to stop by, and held-out pieces, with gaps between them."""

from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from neurove_core.geometry.motion import Twists
from neurove_protocol.errors import InvalidField

GAP_US: Final = 1_000_000
"""Between pieces of different use; neighbouring windows are too alike to be called unseen."""

_TWO_FROM_S: Final = 30.0  # a longer recording has two held-out pieces, so that they differ
_VALIDATION: Final = 0.12  # share of the recording

Span = tuple[int, int]


class Pieces(NamedTuple):
    """Spans of time [us] of one recording; no two of different use are closer than GAP_US."""

    training: tuple[Span, ...]
    validation: tuple[Span, ...]  # decides which weights are kept, and the width of the intervals
    held: tuple[Span, ...]  # never seen before the comparison


def divide(name: str, start_us: int, end_us: int, share: float, least_us: int, validation_us: int) -> Pieces:
    """Divide a recording into one or two equal blocks: a piece to learn from, one to validate, one that is held out.

    Args:
        name: of the recording.
        start_us: first time with events and truth.
        end_us: last time with both.
        share: of the recording that is held out.
        least_us: shortest piece that can be learned from.
        validation_us: shortest piece that can validate, or be held out.

    Raises:
        InvalidField: the recording is too short.
    """
    length = end_us - start_us
    count = 2 if length >= _TWO_FROM_S * 1e6 else 1
    block = length // count
    held_us, checked_us = round(block * share), max(validation_us, round(block * _VALIDATION))
    parts: list[tuple[Span, Span, Span]] = []
    for first in (start_us + i * block for i in range(count)):
        held = (first + block - held_us, first + block)
        checked = (held[0] - GAP_US - checked_us, held[0] - GAP_US)
        learned = (first + (GAP_US if first > start_us else 0), checked[0] - GAP_US)
        parts.append((learned, checked, held))
    if held_us < validation_us or any(last - first < least_us for (first, last), _, _ in parts):
        least_s = max(
            (least_us + 2 * GAP_US) / max(0.05, 1 - share - _VALIDATION),
            (least_us + 2 * GAP_US + validation_us) / (1 - share),
            validation_us / share,
        )
        bound = f"at least {least_s / 1e6:.0f} s with events and truth are needed, with {share:.0%} held out"
        raise InvalidField("adapt", name, f"{length / 1e6:.1f} s", bound)
    training, validation, held_out = zip(*parts, strict=True)
    return Pieces(tuple(training), tuple(validation), tuple(held_out))


def within(truth: Twists, spans: tuple[Span, ...]) -> Twists:
    """The truth inside some spans; elsewhere it is unknown (nan)."""
    inside = inside_any(truth.t, truth.t, spans)
    return Twists(truth.t, np.where(inside[:, None], truth.twist, np.nan))


def inside_any(start_us: NDArray[np.int64], end_us: NDArray[np.int64], spans: tuple[Span, ...]) -> NDArray[np.bool_]:
    """Which intervals (N,) lie completely within one of the spans."""
    found = np.zeros(len(start_us), np.bool_)
    for first, last in spans:
        found |= (start_us >= first) & (end_us <= last)
    return found


def in_seconds(spans: tuple[Span, ...], zero_us: int) -> str:
    """Spans as people read them, in seconds since a time.

    >>> in_seconds(((2_000_000, 3_500_000), (9_000_000, 10_000_000)), 1_000_000)
    '1.0 to 2.5 s, 8.0 to 9.0 s'
    """
    return ", ".join(f"{(first - zero_us) / 1e6:.1f} to {(last - zero_us) / 1e6:.1f} s" for first, last in spans)
