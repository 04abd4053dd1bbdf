"""ImuFeed: the inertial samples of a recording, in step with its events."""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from neurove_core.io.recording import Recording
from neurove_protocol.imu import MAX_ACCEL_M_S2, MAX_GYRO_RAD_S, MAX_SAMPLES, Imu


class Turn(NamedTuple):
    """One playback of a recording that is played in a loop."""

    start_us: int  # time of its first event, shifted
    shift_us: int  # added to the times of the recording


class ImuFeed:
    """The samples of a recording up to a time that only grows, as a driver or a converter sends them with the events.

    Memory holds one batch of the reader and at most MAX_SAMPLES samples.

    Args:
        recording: the source; its events are not read.
        turns: playbacks of the recording; the caller appends each new one. None: it is played once.
    """

    def __init__(self, recording: Recording, turns: list[Turn] | None = None) -> None:
        self._recording = recording
        self._turns = [Turn(-(1 << 62), 0)] if turns is None else turns
        self._turn = -1
        self._batches: Iterator[Imu] = iter(())
        self._rest = Imu.empty()
        self._last_us = -(1 << 62)

    def until(self, t_us: int) -> Imu:
        """The samples before this time [us] that were not returned before; the newest MAX_SAMPLES if there are more."""
        found = []
        while self._turn + 1 < len(self._turns) and self._turns[self._turn + 1].start_us <= t_us:
            found += self._take(self._turns[self._turn + 1].start_us)
            self._turn += 1
            self._batches, self._rest = self._recording.imu(), Imu.empty()
        found += self._take(t_us)
        return _joined(found)

    def _take(self, t_us: int) -> list[Imu]:
        """The samples of the present playback before this time [us], at least the newest MAX_SAMPLES."""
        found: list[Imu] = []
        while True:
            before = int(self._rest.t.searchsorted(t_us))
            if before:
                part = _valid(self._rest.span(0, before), self._last_us)
                self._last_us = int(part.t[-1]) if part.n else self._last_us
                found = [*_newest(found), part]
            self._rest = self._rest.span(before, self._rest.n)
            if self._rest.n:
                return found
            batch = next(self._batches, None)
            if batch is None:
                return found
            self._rest = batch._replace(t=batch.t + self._turns[self._turn].shift_us)


def _valid(samples: Imu, last_us: int) -> Imu:
    """The samples that a packet may hold."""
    kept = (np.abs(samples.accel_m_s2) <= MAX_ACCEL_M_S2).all(axis=1)
    kept &= (np.abs(samples.gyro_rad_s) <= MAX_GYRO_RAD_S).all(axis=1) & (samples.t >= last_us)
    return samples if kept.all() else Imu(samples.t[kept], samples.accel_m_s2[kept], samples.gyro_rad_s[kept])


def _newest(parts: list[Imu]) -> list[Imu]:
    """The last parts, enough for the newest MAX_SAMPLES samples."""
    total, first = 0, len(parts)
    while first and total < MAX_SAMPLES:
        first -= 1
        total += parts[first].n
    return parts[first:]


def _joined(parts: list[Imu]) -> Imu:
    """The newest MAX_SAMPLES samples of all parts."""
    if not parts:
        return Imu.empty()
    t, accel, gyro = (np.concatenate(columns) for columns in zip(*parts, strict=True))
    return Imu(t[-MAX_SAMPLES:], accel[-MAX_SAMPLES:], gyro[-MAX_SAMPLES:])
