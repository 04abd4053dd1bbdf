"""Age: how old the events of a packet are on the clock of this node, learned from the packets that arrive quickest."""

import statistics
from collections import deque

from neurove_protocol.events import Packet
from neurove_service.clock_offset import ClockOffset

_DELAYS = 64


class Ages:
    """Learns the offset between the clock of a stream and the monotonic clock of this node.

    The offset is that of the quickest packet, see `ClockOffset`.
    The clock of a stream is that of the sensor, or the driver's time of sending where it is given.

    A source that pauses together with its clock, as a player does, or a sensor whose clock is too slow, looks like a
    link that delays everything: nothing here can tell them apart, so a player gives its time of sending.
    """

    def __init__(self) -> None:
        self._offset = ClockOffset()
        self._delays_ns: deque[int] = deque(maxlen=_DELAYS)

    @property
    def uncertainty_ns(self) -> int:
        """Median delay of the recent packets beyond the quickest one [ns]."""
        return int(statistics.median(self._delays_ns)) if self._delays_ns else 0

    def forget(self) -> None:
        """Begin anew: the clock of the stream has changed."""
        self._offset.forget()
        self._delays_ns.clear()

    def learn(self, clock_us: int, received_ns: int) -> int:
        """The delay of a packet beyond the quickest one [ns].

        Args:
            clock_us: clock of the stream at the newest event of the packet, or when it was sent [us].
            received_ns: when it arrived [ns].
        """
        delay_ns = self._offset.learn(clock_us * 1000, received_ns)
        self._delays_ns.append(delay_ns)
        return delay_ns


def newest_us(packet: Packet) -> int:
    """Sensor time that a packet has reached [us]."""
    return packet.events.last_us if packet.events.n else packet.t0_us
