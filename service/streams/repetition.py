"""Repetition: a camera whose firmware hangs sends the same events again and again."""

import zlib
from collections import deque

from neurove_protocol.events import Packet, WireEvents

FROZEN_PACKETS = 4
"""After this many packets in a row whose events were all sent before, the camera is frozen."""

MIN_EVENTS = 16
"""Packets with fewer events may be equal by chance."""

_REMEMBERED = 8  # packets: the longest cycle that is noticed
_SAMPLE = 64  # events that are compared first


class Repetition:
    """Notices packets that repeat the events of one of the newest packets."""

    def __init__(self) -> None:
        self._samples: deque[int] = deque(maxlen=_REMEMBERED)
        self._whole: deque[int] = deque(maxlen=_REMEMBERED)  # of packets whose sample was seen before
        self._repeated = 0

    @property
    def frozen(self) -> bool:
        """Whether the newest packets all repeat earlier ones."""
        return self._repeated >= FROZEN_PACKETS

    def add(self, packet: Packet) -> None:
        """Compare a packet with the newest ones; a packet with few events says nothing."""
        if packet.events.n < MIN_EVENTS:
            return
        sample = _hash(packet, _SAMPLE)
        if sample not in self._samples:
            self._samples.append(sample)
            self._repeated = 0
            return
        whole = _hash(packet, packet.events.n)
        self._repeated = self._repeated + 1 if whole in self._whole else 0
        if whole not in self._whole:
            self._whole.append(whole)


def _hash(packet: Packet, events: int) -> int:
    """Hash of the first events of a packet, with times relative to its begin, and of their number in all."""
    part = packet.events.span(0, events)
    columns = part.columns() if isinstance(part, WireEvents) else part
    found = packet.events.n
    for column in (columns.t - packet.t0_us, columns.x, columns.y, columns.p):
        found = zlib.crc32(column.tobytes(), found)
    return found
