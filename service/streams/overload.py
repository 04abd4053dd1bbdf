"""Overload: a worker that cannot keep up leaves out whole windows and goes on with the newest data."""

from typing import NamedTuple

from neurove_core.ingest.wire import read_packet
from neurove_protocol.errors import NeuroVEError
from neurove_protocol.events import PacketLimits
from neurove_service.streams.age import newest_us
from neurove_service.streams.lane import OpenWindow

BEHIND_NS, FAR_BEHIND_NS = 100_000_000, 200_000_000
"""A packet that waits longer is behind; far behind is needed to begin."""

RELIEF_NS = 2_000_000_000
"""The overload has ended when the worker was not behind for this time."""


MAX_SHED_US = 60_000_000
"""A larger jump is one of the sensor clock [us]."""


class Overload:
    """Decides when a worker leaves out windows.

    Args:
        patience_s: a worker that is behind for a shorter time catches up, so a stall loses nothing [s].
    """

    def __init__(self, patience_s: float) -> None:
        self._patience_ns = patience_s * 1e9
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
        if waited_ns > FAR_BEHIND_NS and now_ns - self._behind_since_ns > self._patience_ns:
            self._until_ns = now_ns + RELIEF_NS
        if now_ns > self._until_ns:
            return False
        self._until_ns = now_ns + RELIEF_NS
        return True


class WholeWindow(NamedTuple):
    """The newest window whose events have all arrived."""

    start_us: int
    packets: int  # messages at the begin of the queue that belong to earlier windows


def newest_whole_window(payloads: list[bytes | None], limits: PacketLimits, window: OpenWindow) -> WholeWindow | None:
    """Where to go on after leaving out windows; None if the open window must not be left out.

    Args:
        payloads: of the packets in the queue, oldest first; None for a message that is no packet.
        limits: limits of packets.
        window: the open one.
    """
    times = (_reached_us(payload, limits) for payload in reversed(payloads))
    newest_us = next((time_us for time_us in times if time_us is not None), None)
    if newest_us is None:
        return None
    start_us = (newest_us // window.duration_us - 1) * window.duration_us
    if not window.start_us < start_us < window.start_us + MAX_SHED_US:
        return None
    for index in reversed(range(len(payloads))):
        time_us = _reached_us(payloads[index], limits)
        if time_us is not None and time_us < start_us:
            return WholeWindow(start_us, index + 1)
    return WholeWindow(start_us, 0)


def _reached_us(payload: bytes | None, limits: PacketLimits) -> int | None:
    """Sensor time that a packet has reached [us]; None if it is not valid."""
    if payload is None:
        return None
    try:
        return newest_us(read_packet(payload, limits))
    except NeuroVEError:
        return None
