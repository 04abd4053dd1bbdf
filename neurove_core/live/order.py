"""Valid events of a live source: ordered by time and on the sensor, without waiting for what follows."""

from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from neurove_core.io.faults import Reason, Tally
from neurove_protocol.events import Events, Sensor
from neurove_protocol.imu import MAX_ACCEL_M_S2, MAX_GYRO_RAD_S, Imu

RESTART_US: Final = 1_000_000
"""Events that are earlier than the newest one by more than this belong to a new clock."""


_MAX_US: Final = 1 << 62
"""Times from here on are invalid: the wire has no larger ones."""


class Taken(NamedTuple):
    """The valid part of what arrived."""

    events: Events
    restarted: bool  # the clock began again with these events


class LiveOrder:
    """Keeps the valid events of a source and counts the others.

    `io.order` decides on a jump of the clock when it has seen what follows; a live source cannot wait.

    Args:
        sensor: the pixel array.
        tally: counts what is discarded.
    """

    def __init__(self, sensor: Sensor, tally: Tally) -> None:
        self._sensor, self._tally = sensor, tally
        self._last_us: int | None = None

    @property
    def last_us(self) -> int | None:
        """Time of the newest event, or of the newest tick [us]; None before the first one."""
        return self._last_us

    def tick(self, now_us: int | None) -> int | None:
        """A time before which every event has arrived, if it is news; later events before it are discarded."""
        if now_us is None or (self._last_us is not None and now_us <= self._last_us):
            return None
        self._last_us = now_us
        return now_us

    def take(self, events: Events) -> Taken:
        """The events on the sensor that are ordered by time.

        Args:
            events: what arrived, with columns of any integer type.
        """
        events = self._on_sensor(events)
        if not events.n:
            return Taken(Events.empty(), False)
        first_us, last_us = int(events.t[0]), self._last_us
        restarted = last_us is not None and first_us < last_us - RESTART_US
        if restarted:
            self._tally.add(Reason.NEW_CLOCK, "the connection", f"t={first_us} us comes after t={last_us} us")
            last_us = None
        events = self._ordered(events, last_us)
        if events.n:
            self._last_us = int(events.t[-1])
        return Taken(Events.from_columns(*events), restarted)

    def _ordered(self, events: Events, last_us: int | None) -> Events:
        t = events.t
        if (last_us is None or t[0] >= last_us) and bool((t[1:] >= t[:-1]).all()):
            return events
        newest = np.maximum.accumulate(t if last_us is None else np.maximum(t, last_us))
        late = t < newest
        first = int(late.argmax())
        why = f"it is earlier than t={int(newest[first])} us, which came before it"
        self._tally.add(Reason.LATE, f"t={int(t[first])} us", why, int(late.sum()))
        return _kept(events, ~late)

    def _on_sensor(self, events: Events) -> Events:
        if not events.n:
            return events
        x, y, t = events.x, events.y, events.t
        inside = (x < self._sensor.width) & (y < self._sensor.height) & (t >= 0) & (t < _MAX_US)
        for column in (x, y):
            if column.dtype.kind != "u":
                inside &= column >= 0
        if inside.all():
            return events
        first = int(inside.argmin())
        why = f"x={x[first]} y={y[first]} t={t[first]} us is outside the sensor {self._sensor}, or no valid time"
        self._tally.add(Reason.OUTSIDE, f"t={int(t[first])} us", why, int((~inside).sum()))
        return _kept(events, inside)


class ImuOrder:
    """Keeps the inertial samples that a packet may hold and counts the others.

    Args:
        tally: counts what is discarded.
    """

    def __init__(self, tally: Tally) -> None:
        self._tally = tally
        self._last_us = -(1 << 62)

    def take(self, samples: Imu) -> Imu:
        """The samples in their bounds that are ordered by time; a clock that begins again is followed."""
        if not samples.n:
            return samples
        if int(samples.t[0]) < self._last_us - RESTART_US:
            self._last_us = -(1 << 62)
        with np.errstate(invalid="ignore"):
            valid = (np.abs(samples.accel_m_s2) <= MAX_ACCEL_M_S2).all(axis=1)
            valid &= (np.abs(samples.gyro_rad_s) <= MAX_GYRO_RAD_S).all(axis=1)
        valid &= (samples.t >= 0) & (samples.t < _MAX_US)
        valid &= samples.t >= np.maximum.accumulate(np.maximum(samples.t, self._last_us))
        if not valid.all():
            first = int(valid.argmin())
            why = "it is late, not finite, or out of bounds"
            self._tally.add(Reason.INVALID, f"t={int(samples.t[first])} us", why, int((~valid).sum()))
            samples = Imu(samples.t[valid], samples.accel_m_s2[valid], samples.gyro_rad_s[valid])
        if samples.n:
            self._last_us = int(samples.t[-1])
        return samples


def _kept(events: Events, which: NDArray[np.bool_]) -> Events:
    return Events(events.t[which], events.x[which], events.y[which], events.p[which])
