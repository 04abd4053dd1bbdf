"""Statistics of a recording. Each stream is read once, with bounded memory."""

import math
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from typing import Any, Final, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from neurove_core.geometry.motion import Twists
from neurove_core.io.errors import BrokenRecording
from neurove_core.io.faults import Fault
from neurove_core.io.recording import Recording
from neurove_protocol.camera import CameraInfo
from neurove_protocol.errors import InvalidField
from neurove_protocol.events import Events, Sensor
from neurove_protocol.imu import Imu

PEAK_US: Final = 10_000
"""Length of the intervals for the peak rate [us]. The first interval starts at the first event."""

SLICE_US: Final = 50_000
"""Length of the event image [us]. In a longer image the edges overlap."""

T = TypeVar("T")

_BARS: Final = 1024  # of the rate over time; their width grows with the length of the recording


@dataclass(frozen=True, slots=True)
class ImuSummary:
    """Statistics of the inertial unit in SI units, each (x, y, z), in the frame of the recording's samples."""

    samples: int
    rate_hz: float | None  # None for fewer than two samples
    gyro_mean_rad_s: tuple[float, ...]
    gyro_std_rad_s: tuple[float, ...]
    accel_mean_m_s2: tuple[float, ...]
    accel_std_m_s2: tuple[float, ...]
    gyro_peak_rad_s: float  # greatest length
    accel_peak_m_s2: float


@dataclass(frozen=True, slots=True)
class TruthSummary:
    """Ground truth of the camera's motion.

    The speeds are of the samples whose twist is known. They are None if no twist is known.
    """

    source: str  # the recorded stream, `poses` or `twists`; key `from` in JSON
    samples: int
    first_us: int
    last_us: int
    mean_linear_m_s: float | None
    peak_linear_m_s: float | None
    mean_angular_rad_s: float | None
    peak_angular_rad_s: float | None


@dataclass(frozen=True, slots=True)
class Summary:
    """Statistics of a recording. An unknown value is None."""

    name: str
    sensor: Sensor
    streams: tuple[str, ...]
    events: int
    on_fraction: float | None
    first_us: int | None  # of the events, sensor clock
    last_us: int | None
    duration_s: float
    mean_rate_hz: float | None  # events per second
    peak_rate_hz: float | None  # of the busiest 10 ms
    frames: int
    triggers: int
    imu: ImuSummary | None
    truth: TruthSummary | None
    broken: str | None  # the error that ended the reading, if any
    lens: CameraInfo | None = None
    faults: tuple[Fault, ...] = ()  # what was skipped, discarded or not read, by reason

    def as_json(self) -> dict[str, Any]:
        """The summary as a dict for `json.dumps`."""
        fields = asdict(self)
        fields["lens"] = None if self.lens is None else self.lens.model_dump(mode="json", exclude={"stream"})
        fields["faults"] = [fault.as_json() for fault in self.faults]
        if self.truth is not None:
            truth = fields["truth"]
            fields["truth"] = {"from": truth.pop("source"), **truth}
        return fields


class Survey(NamedTuple):
    """A summary, and the additional data for a plot of the recording."""

    summary: Summary
    counts: NDArray[np.int64]  # (2, H, W) OFF and ON events of each pixel in SLICE_US of its second half
    counts_start_us: int  # start of the counts
    rate_t_us: NDArray[np.int64]  # (bars + 1,) edges of the bars
    rate_hz: NDArray[np.float64]  # (bars,) events per second
    twists: Twists | None


def survey(recording: Recording, seconds: float | None = None) -> Survey:
    """Read each stream of a recording once and summarise it.

    For a damaged recording the summary covers what can be read; `faults` says what could not. The ground truth is
    `Recording.twists`; see geometry.twists.

    Args:
        recording: the recording to read.
        seconds: maximum duration of the events [s], from the first event; None or infinity: all. An endless recording
            needs it.

    Raises:
        InvalidField: the recording is endless and `seconds` is not given, or `seconds` is not above 0.
    """
    if seconds == math.inf:
        seconds = None
    if seconds is None and recording.endless:
        raise InvalidField("info", "seconds", None, f"{recording.name} never ends: give the number of seconds")
    if seconds is not None and not seconds > 0:  # this form also refuses nan
        raise InvalidField("info", "seconds", seconds, "must be above 0")
    tally = _Tally(recording.sensor)
    broken = _drain(_until(recording.chunks(), seconds), tally.add)
    imu, frames, edges = _ImuTally(), _Count(), _Count()
    broken = _drain(recording.imu(), imu.add) or broken
    broken = _drain(recording.frames(), lambda _: frames.add(1)) or broken
    broken = _drain(recording.triggers(), lambda some: edges.add(some.t.size)) or broken
    truths: list[Twists | None] = []
    broken = _drain((recording.twists() for _ in range(1)), truths.append) or broken
    truth = next(iter(truths), None)
    n, on, span_s = tally.n, tally.on, tally.span_s
    summary = Summary(
        name=recording.name,
        sensor=recording.sensor,
        streams=recording.streams,
        events=n,
        on_fraction=on / n if n else None,
        first_us=tally.first_us,
        last_us=tally.last_us,
        duration_s=span_s,
        mean_rate_hz=n / span_s if span_s > 0 else None,
        peak_rate_hz=tally.peak * 1e6 / PEAK_US if n else None,
        frames=frames.n,
        triggers=edges.n,
        imu=imu.summary(),
        truth=None if truth is None else _truth(truth, "poses" if "poses" in recording.streams else "twists"),
        broken=broken or next(map(str, recording.faults.unread), None),
        lens=recording.camera("recording"),
        faults=recording.faults.found,
    )
    return Survey(summary, *tally.picture(), *tally.rate(), truth)


def _drain(parts: Iterator[T], add: Callable[[T], None]) -> str | None:
    """Add all parts. Return the message of the error that ended them, if any."""
    try:
        for part in parts:
            add(part)
    except (BrokenRecording, InvalidField) as error:  # such as a truth that is not valid
        return error.message
    return None


def _until(chunks: Iterator[Events], seconds: float | None) -> Iterator[Events]:
    """The chunks of the first `seconds`, or all chunks if it is None."""
    last_us = None
    for chunk in chunks:
        if seconds is None:
            yield chunk
            continue
        last_us = int(chunk.t[0]) + round(seconds * 1e6) if last_us is None else last_us
        stop = int(chunk.t.searchsorted(last_us))
        if stop:
            yield chunk.span(0, stop)
        if stop < chunk.n:
            return


class _Count:
    def __init__(self) -> None:
        self.n = 0

    def add(self, more: int) -> None:
        self.n += more


class _Tally:
    """Counts of events: per pixel and polarity, and over time."""

    def __init__(self, sensor: Sensor) -> None:
        self._slice = np.zeros((2, sensor.height, sensor.width), np.int64)
        self._last_slice = np.zeros_like(self._slice)
        self._slice_us, self._last_slice_us = 0, 0  # their starts, relative to the first event
        self.n, self.on, self.peak = 0, 0, 0
        self.first_us: int | None = None
        self.last_us: int | None = None
        self._newest, self._newest_n = 0, 0  # the newest 10 ms interval, which the next chunk may continue
        self._bars = np.zeros(_BARS, np.int64)
        self._bar_us = PEAK_US

    @property
    def span_s(self) -> float:
        """Time from the first event to the last [s]."""
        return 0.0 if self.first_us is None or self.last_us is None else (self.last_us - self.first_us) / 1e6

    def add(self, events: Events) -> None:
        """Count a chunk."""
        if self.first_us is None:
            self.first_us = int(events.t[0])
        self.n, self.last_us = self.n + events.n, int(events.t[-1])
        self.on += int(np.count_nonzero(events.p))
        since_us = events.t - self.first_us
        self._add_slices(events, since_us)
        self._add_peak(since_us // PEAK_US)
        while int(since_us[-1]) >= self._bar_us * _BARS:  # double the width, which halves the number of bars
            self._bars = np.concatenate([self._bars.reshape(-1, 2).sum(axis=1), np.zeros(_BARS // 2, np.int64)])
            self._bar_us *= 2
        self._bars += np.bincount(since_us // self._bar_us, minlength=_BARS)

    def _add_slices(self, events: Events, since_us: NDArray[np.int64]) -> None:
        """Add events to the image.

        Each image starts at twice the time of the image before it, so one image is in the second half.
        """
        while int(since_us[-1]) >= self._slice_us:
            first, stop = since_us.searchsorted([self._slice_us, self._slice_us + SLICE_US])
            part = events.span(int(first), int(stop))
            np.add.at(self._slice, ((part.p > 0).astype(np.intp), part.y, part.x), 1)
            if stop == events.n:
                return
            if self._slice.any():
                self._last_slice, self._last_slice_us = self._slice, self._slice_us
            self._slice = np.zeros_like(self._slice)
            self._slice_us = max(2 * self._slice_us, SLICE_US)

    def picture(self) -> tuple[NDArray[np.int64], int]:
        """Counts (2, H, W) of one slice and its start [us]: the last complete slice, or the only one."""
        counts, at_us = self._last_slice, self._last_slice_us
        if not counts.any():
            counts, at_us = self._slice, self._slice_us
        return counts, at_us + (self.first_us or 0)

    def _add_peak(self, span: NDArray[np.int64]) -> None:
        spans, counts = np.unique(span, return_counts=True)
        if spans[0] == self._newest:
            counts[0] += self._newest_n
        self.peak = max(self.peak, int(counts.max()))
        self._newest, self._newest_n = int(spans[-1]), int(counts[-1])

    def rate(self) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
        """Edges (bars + 1,) of the bars up to the last event [us], and their event rates (bars,) [1/s]."""
        if self.first_us is None or self.last_us is None:
            return np.zeros(1, np.int64), np.zeros(0)
        n = (self.last_us - self.first_us) // self._bar_us + 1
        edges = self.first_us + self._bar_us * np.arange(n + 1, dtype=np.int64)
        return edges, np.asarray(self._bars[:n] * (1e6 / self._bar_us))


class _ImuTally:
    """Running mean and standard deviation of the inertial samples.

    Source: Chan 1983: the statistics of two parts give those of both together.
    """

    def __init__(self) -> None:
        self._n, self._first_us, self._last_us = 0, 0, 0
        self._mean, self._squares = np.zeros(6), np.zeros(6)
        self._peak = np.zeros(2)  # largest length of the angular velocity and of the specific force

    def add(self, imu: Imu) -> None:
        """Add samples."""
        values = np.concatenate([imu.gyro_rad_s, imu.accel_m_s2], axis=1)
        n, mean = len(values), values.mean(axis=0)
        self._first_us = self._first_us if self._n else int(imu.t[0])
        self._last_us = int(imu.t[-1])
        difference, total = mean - self._mean, self._n + n
        lengths = [float(np.linalg.norm(part, axis=1).max()) for part in (imu.gyro_rad_s, imu.accel_m_s2)]
        self._peak = np.maximum(self._peak, lengths)
        self._squares += ((values - mean) ** 2).sum(axis=0) + difference**2 * (self._n * n / total)
        self._mean, self._n = self._mean + difference * (n / total), total

    def summary(self) -> ImuSummary | None:
        """Statistics of the added samples, or None without samples."""
        if not self._n:
            return None
        span_us = self._last_us - self._first_us
        mean, std = self._mean.tolist(), np.sqrt(self._squares / self._n).tolist()
        return ImuSummary(
            samples=self._n,
            rate_hz=(self._n - 1) * 1e6 / span_us if span_us > 0 else None,
            gyro_mean_rad_s=tuple(mean[:3]),
            gyro_std_rad_s=tuple(std[:3]),
            accel_mean_m_s2=tuple(mean[3:]),
            accel_std_m_s2=tuple(std[3:]),
            gyro_peak_rad_s=float(self._peak[0]),
            accel_peak_m_s2=float(self._peak[1]),
        )


def _truth(truth: Twists, source: str) -> TruthSummary | None:
    if not truth.t.size:
        return None
    known = truth.twist[np.isfinite(truth.twist).all(axis=1)]
    speeds = [np.linalg.norm(part, axis=1) for part in np.split(known, 2, axis=1)]
    linear, angular = ((float(s.mean()), float(s.max())) if s.size else (None, None) for s in speeds)
    return TruthSummary(source, truth.t.size, int(truth.t[0]), int(truth.t[-1]), *linear, *angular)
