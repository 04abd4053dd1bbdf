"""Repetition: a camera whose firmware hangs sends the same events again and again."""

import zlib
from collections import deque

from neurove_protocol.events import Packet, WireEvents

FROZEN_PACKETS = 4
"""After this many packets in a row whose events were all sent before, the camera is frozen."""

MIN_EVENTS = 16
"""Packets with fewer events may be equal by chance."""

PERIOD_US = 2_000
"""Of packets that follow each other faster, only some are compared [us]."""

_REMEMBERED = 8  # packets: the longest cycle that is noticed
_SAMPLE = 64  # events that are compared first


class Repetition:
    """Notices packets that repeat the events of one of the newest packets."""

    def __init__(self) -> None:
        self._samples: deque[int] = deque(maxlen=_REMEMBERED)
        self._whole: deque[int] = deque(maxlen=_REMEMBERED)  # of packets whose sample was seen before
        self._repeated = 0
        self._newest_us: int | None = None

    @property
    def frozen(self) -> bool:
        """Whether the newest packets all repeat earlier ones."""
        return self._repeated >= FROZEN_PACKETS

    def add(self, packet: Packet) -> None:
        """Compare a packet with the newest ones; a packet with few events says nothing."""
        if packet.events.n < MIN_EVENTS or self._is_soon(packet.t0_us):
            return
        self._newest_us = packet.t0_us
        sample = hash(_bytes(packet, _SAMPLE))
        if sample not in self._samples:
            self._samples.append(sample)
            self._repeated = 0
            return
        whole = zlib.crc32(_bytes(packet, packet.events.n))
        self._repeated = self._repeated + 1 if whole in self._whole else 0
        if whole not in self._whole:
            self._whole.append(whole)

    def _is_soon(self, t0_us: int) -> bool:
        return self._newest_us is not None and 0 <= t0_us - self._newest_us < PERIOD_US


def _bytes(packet: Packet, events: int) -> bytes:
    """The first events of a packet, with times relative to its begin, and the number of all."""
    found = packet.events
    count = found.n.to_bytes(4, "little")
    if isinstance(found, WireEvents):
        if events < found.n:
            return count + found.blob[: events * (4 if found.wide else 2)].tobytes()  # times are enough
        return count + found.blob.tobytes()
    part = found.span(0, events)
    return count + b"".join(column.tobytes() for column in (part.t - packet.t0_us, part.x, part.y, part.p))
