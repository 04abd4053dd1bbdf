"""RosClock: from the sensor clock of a stream to the time of ROS, by the stamps of its messages."""

from typing import Final

from neurove_service.clock_offset import ClockOffset

MAX_AHEAD_US: Final = 1_000_000
"""A time that is so much newer than the newest event belongs to another clock of the sensor."""


class RosClock:
    """The offset `header.stamp - sensor time` of the messages that came quickest.

    The stamp of a message is when the driver received the first of its events, so it includes the latency of the
    camera's link. Like `ClockOffset`, the offset follows the drift of two crystals.

    >>> clock = RosClock()
    >>> clock.learn(t_ns=5_000, stamp_ns=1_000_000_005_000)
    >>> clock.ros_ns(7), clock.sensor_us(1_000_000_007_000)
    (1000000007000, 7)
    """

    def __init__(self) -> None:
        self._quickest = ClockOffset()
        self._offset_ns: int | None = None
        self._first_us = self._newest_us = 0

    def learn(self, t_ns: int, stamp_ns: int) -> None:
        """Learn from a message: the time of its first event [ns], and its stamp [ns]."""
        delay_ns = self._quickest.learn(t_ns, stamp_ns)
        if self._offset_ns is None:
            self._first_us = self._newest_us = t_ns // 1000
        self._offset_ns = stamp_ns - t_ns - delay_ns
        self._newest_us = max(self._newest_us, t_ns // 1000)

    def advance(self, t_us: int) -> None:
        """The newest event, or the time without events, has this sensor time [us]."""
        self._newest_us = max(self._newest_us, t_us)

    def forget(self) -> None:
        """The sensor has a new clock."""
        self._quickest.forget()
        self._offset_ns = None

    def ros_ns(self, t_us: int) -> int | None:
        """ROS time [ns] of a sensor time [us]; None if it is not of the present clock of the sensor."""
        known = self._offset_ns is not None and self._first_us <= t_us <= self._newest_us + MAX_AHEAD_US
        return t_us * 1000 + self._offset_ns if known and self._offset_ns is not None else None

    def sensor_us(self, stamp_ns: int) -> int | None:
        """Sensor time [us] of a stamp [ns]; None before the first event."""
        return None if self._offset_ns is None else (stamp_ns - self._offset_ns) // 1000
