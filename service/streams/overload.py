"""Overload: a worker that cannot keep up leaves out whole windows and goes on with the newest data."""

from neurove_core.ingest.wire import read_packet
from neurove_protocol.errors import NeuroVEError
from neurove_protocol.events import PacketLimits
from neurove_service.streams.age import newest_us

BEHIND_NS, FAR_BEHIND_NS = 100_000_000, 200_000_000
"""A packet that waits longer is behind; far behind is needed to begin."""

PATIENCE_NS = 1_000_000_000
"""A worker that is behind for a shorter time catches up: a stall loses nothing."""

RELIEF_NS = 2_000_000_000
"""The overload has ended when the worker was not behind for this time."""


class Overload:
    """Decides when a worker leaves out windows."""

    def __init__(self) -> None:
        self._behind_since_ns: int | None = None
        self._until_ns = 0

    def must_shed(self, waited_ns: int, now_ns: int) -> bool:
        """Whether to leave out windows now.

        Args:
            waited_ns: since the oldest packet in the queue arrived [ns].
            now_ns: monotonic clock of this node [ns].
        """
        if waited_ns < BEHIND_NS:
            self._behind_since_ns = None
            return False
        if self._behind_since_ns is None:
            self._behind_since_ns = now_ns
        if waited_ns > FAR_BEHIND_NS and now_ns - self._behind_since_ns > PATIENCE_NS:
            self._until_ns = now_ns + RELIEF_NS
        if now_ns > self._until_ns:
            return False
        self._until_ns = now_ns + RELIEF_NS
        return True


class Reached:
    """The sensor times that packets in a queue have reached.

    Args:
        payloads: of the packets, oldest first; None for a message that is no packet.
        limits: limits of packets.
    """

    def __init__(self, payloads: list[bytes | None], limits: PacketLimits) -> None:
        self._payloads, self._limits = payloads, limits

    @property
    def newest_us(self) -> int | None:
        """Sensor time that the newest valid packet has reached [us]; None without one."""
        times = (self._at(index) for index in reversed(range(len(self._payloads))))
        return next((time_us for time_us in times if time_us is not None), None)

    def first_index(self, start_us: int) -> int:
        """Index of the first packet of the run at the end of the queue that has reached `start_us`."""
        for index in reversed(range(len(self._payloads))):
            time_us = self._at(index)
            if time_us is not None and time_us < start_us:
                return index + 1
        return 0

    def _at(self, index: int) -> int | None:
        payload = self._payloads[index]
        if payload is None:
            return None
        try:
            return newest_us(read_packet(payload, self._limits))
        except NeuroVEError:
            return None
