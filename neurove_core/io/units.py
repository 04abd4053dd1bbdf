"""The unit of recorded times: doubt it where it is implausible, and let the caller decide.

A data set in a well-known layout may have times in another unit than the layout: seconds, milliseconds, microseconds or
nanoseconds. A reader that has this problem is `Timed`.
"""

from pathlib import Path
from typing import Any, Final, NamedTuple, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from neurove_core.io.errors import RecordingError
from neurove_core.io.recording import Recording
from neurove_protocol.errors import InvalidField

UNITS: Final = {"s": 1e6, "ms": 1e3, "us": 1.0, "ns": 1e-3}
"""Microseconds of each unit."""

SAMPLE: Final = 4096
"""Events of which a reader gives the times."""

_FEWEST = 16  # a smaller sample is not judged by its rate
_MAX_T, _MAX_T_US = 1e30, 1e17
_MAX_SPAN_S = 86_400.0
_MIN_RATE_HZ, _GUESS_RATE_HZ = 1.0, 10.0
_EPOCH_S = (946_684_800.0, 4_102_444_800.0)  # unix times of the years 2000 to 2100


class TimeSample(NamedTuple):
    """Times at the beginning of a recording."""

    path: Path
    times: NDArray[Any]  # (N,) of consecutive events, as they are in the file
    unit: str  # that the layout has
    events: int  # in the whole recording; 0 if the reader does not know


@runtime_checkable
class Timed(Protocol):
    """A recording whose times may have another unit."""

    def time_sample(self) -> TimeSample | None:
        """Times at the beginning, or None if they cannot be read."""

    def in_unit(self, unit: str) -> Recording:
        """The same recording with its times read in another unit."""


class DoubtfulUnit(RecordingError):
    """The times of a recording are implausible in the unit of its layout."""

    code = "doubtful_time_unit"

    def __init__(self, path: Path, unit: str, why: str, guess: str | None) -> None:
        cure = (
            f"probably they are in {guess}: give --time-unit {guess}" if guess else "give --time-unit s, ms, us or ns"
        )
        super().__init__(
            f"{path}: its times are implausible in {unit}, the unit of its layout: {why}; {cure} "
            f"(--time-unit {unit} accepts them as they are)",
            value=str(path),
            unit=unit,
            why=why,
            guess=guess,
        )


def with_unit(recording: Recording, unit: str | None) -> Recording:
    """The recording with its times in this unit; without one, its own times are judged.

    Raises:
        DoubtfulUnit: no unit is given, and the times are implausible in that of the layout.
        InvalidField: a unit is given that is unknown, or the format allows no other.
    """
    if unit is None:
        sample = recording.time_sample() if isinstance(recording, Timed) else None
        why = doubt(sample, sample.unit) if sample is not None else ""
        if sample is not None and why:
            raise DoubtfulUnit(sample.path, sample.unit, why, guess(sample))
        return recording
    if unit not in UNITS:
        raise InvalidField("recording", "time_unit", unit, f"one of {', '.join(UNITS)}")
    if not isinstance(recording, Timed):
        raise InvalidField(
            "recording", "time_unit", unit, f"the format of {recording.name} fixes the unit of its times"
        )
    return recording.in_unit(unit)


def doubt(sample: TimeSample, unit: str) -> str:
    """What is implausible about times in a unit; empty if nothing is.

    >>> doubt(TimeSample(Path("a"), np.arange(100) * 1000, "s", 3000), "s")
    'less than 1 event per second'
    """
    t = sample.times.astype(np.float64)
    t = t[np.abs(t) < _MAX_T]  # in this form nan is left out
    if not t.size:
        return ""
    to_s = UNITS[unit] / 1e6
    if float(np.abs(t).max()) * UNITS[unit] > _MAX_T_US:
        return f"t={t[np.abs(t).argmax()]:.4g} {unit} is more than {_MAX_T_US:.0e} us"
    if t.size < _FEWEST:
        return ""
    step_s = _usual_step(t) * to_s
    if step_s * _MIN_RATE_HZ >= 1:
        return f"less than {_MIN_RATE_HZ:.0f} event per second"
    span_s = step_s * max(sample.events, t.size)
    if span_s > _MAX_SPAN_S:
        return f"its events take about {span_s / _MAX_SPAN_S:.1f} days"
    if unit in ("us", "ns") and sample.times.dtype.kind == "f" and (t != np.rint(t)).mean() > 0.5:
        return f"t={t[t != np.rint(t)][0]:.9g} {unit} is not a whole number"
    return ""


def guess(sample: TimeSample) -> str | None:
    """The unit in which the times are the most plausible, or None."""
    t = sample.times.astype(np.float64)
    t = t[np.abs(t) < _MAX_T]
    if not t.size:
        return None
    fractions = bool((t != np.rint(t)).any())
    plausible = [
        unit
        for unit in (("s", "ms") if fractions else ("us", "ns", "ms", "s"))
        if not doubt(sample, unit) and _usual_step(t) * UNITS[unit] / 1e6 * _GUESS_RATE_HZ <= 1
    ]
    dated = [unit for unit in plausible if _EPOCH_S[0] < t[0] * UNITS[unit] / 1e6 < _EPOCH_S[1]]
    return next(iter(dated or plausible), None)


def scaled(t: NDArray[Any], unit: str, layout_unit: str = "us") -> NDArray[Any]:
    """Times in us, of times that a reader has converted to us as if they had the unit of the layout.

    Whole numbers stay whole numbers, because a float has too few digits for a Unix time in ns.
    """
    factor = UNITS[unit] / UNITS[layout_unit]
    if factor == 1:
        return t
    if t.dtype.kind in "iu":
        return t // round(1 / factor) if factor < 1 else t * round(factor)
    return np.asarray(t * factor)


def _usual_step(t: NDArray[np.float64]) -> float:
    """Mean of the steps between consecutive times, without the largest tenth, which may be gaps."""
    steps = np.sort(np.abs(np.diff(t)))
    kept = steps[: max(1, steps.size * 9 // 10)]
    return float(kept.mean()) if kept.size else 0.0
