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
    """Divide a recording: validation first, held-out pieces in the middle and at the end, the rest to learn from.

    Args:
        name: of the recording.
        start_us: first time with events and truth.
        end_us: last time with both.
        share: of the recording that is held out.
        least_us: shortest piece that can be learned from.
        validation_us: shortest piece that can validate.

    Raises:
        InvalidField: the recording is too short.
    """
    length = end_us - start_us
    count = 2 if length >= _TWO_FROM_S * 1e6 else 1
    held = [
        (round(end_us - length * ((count - 1 - i) / count) - length * share / count), round(end_us - length * (count - 1 - i) / count))
        for i in range(count)
    ]
    validation = (start_us, start_us + max(validation_us, round(length * _VALIDATION)))
    training, at = [], validation[1] + GAP_US
    for first, last in held:
        if first - GAP_US - at >= least_us:
            training.append((at, first - GAP_US))
        at = last + GAP_US
    if not training or min(last - first for first, last in held) < validation_us:
        needed = (least_us + 2 * GAP_US + validation_us) / max(1e-6, 1 - share - _VALIDATION) / 1e6
        bound = f"at least {max(needed, validation_us / share / 1e6):.0f} s with events and truth are needed, with {share:.0%} held out"
        raise InvalidField("adapt", name, f"{length / 1e6:.1f} s", bound)
    return Pieces(tuple(training), (validation,), tuple(held))


def within(truth: Twists, spans: tuple[Span, ...]) -> Twists:
    """The truth inside some spans; elsewhere it is unknown (nan)."""
    inside = inside_any(truth.t, truth.t, spans)
    return Twists(truth.t, np.where(inside[:, None], truth.twist, np.nan))


def inside_any(
    start_us: NDArray[np.int64], end_us: NDArray[np.int64], spans: tuple[Span, ...]
) -> NDArray[np.bool_]:
    """Which intervals (N,) lie completely within one of the spans."""
    found = np.zeros(len(start_us), np.bool_)
    for first, last in spans:
        found |= (start_us >= first) & (end_us <= last)
    return found


def told(spans: tuple[Span, ...], zero_us: int) -> str:
    """Spans as people read them, in seconds since a time.

    >>> told(((2_000_000, 3_500_000), (9_000_000, 10_000_000)), 1_000_000)
    '1.0 to 2.5 s, 8.0 to 9.0 s'
    """
    return ", ".join(f"{(first - zero_us) / 1e6:.1f} to {(last - zero_us) / 1e6:.1f} s" for first, last in spans)
