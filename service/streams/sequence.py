"""Sequence check: does a packet follow the previous one, were packets lost, did the driver restart."""

import enum
from collections import deque

from neurove_protocol.events import Packet

REWIND_PACKETS = 3
"""After this many consecutive packets that count up from an old number, the driver has restarted."""


class Order(enum.Enum):
    """Why a packet is not the expected one."""

    FIRST = enum.auto()  # the first packet of the stream
    AFTER_GAP = enum.auto()  # numbers are missing before it
    AFTER_RESTART = enum.auto()  # the driver restarted
    DUPLICATE = enum.auto()  # the newest number again
    OUT_OF_ORDER = enum.auto()  # an older number


class Sequence:
    """Checks the sequence numbers of one stream."""

    def __init__(self) -> None:
        self._expected: int | None = None
        self._first_t0_us = 0
        self._rewind: deque[int] = deque(maxlen=REWIND_PACKETS)
        self._unread = 0

    def skip(self, packets: int) -> None:
        """Expect that many missing numbers: these packets arrived, but this node refused or dropped them."""
        self._unread += packets

    def advance(self, packet: Packet) -> bool:
        """Accept a packet if it is the expected one; otherwise return False and change nothing."""
        if packet.seq != self._expected:
            return False
        self._expect_after(packet)
        return True

    def place(self, packet: Packet) -> tuple[Order, int]:
        """The order of a packet that is not the expected one.

        Returns:
            the order, and for AFTER_GAP the number of packets lost before this node.
        """
        expected = self._expected
        if expected is None:
            self._begin(packet)
            return Order.FIRST, 0
        if packet.seq < expected:
            return self._place_old(packet, expected), 0
        lost = max(0, packet.seq - expected - self._unread)
        self._expect_after(packet)
        return Order.AFTER_GAP, lost

    def _begin(self, packet: Packet) -> None:
        self._first_t0_us = packet.t0_us
        self._expect_after(packet)

    def _expect_after(self, packet: Packet) -> None:
        self._expected, self._unread = packet.seq + 1, 0
        if self._rewind:
            self._rewind.clear()

    def _place_old(self, packet: Packet, expected: int) -> Order:
        if packet.seq == 0 and packet.t0_us != self._first_t0_us:
            self._begin(packet)
            return Order.AFTER_RESTART
        if self._rewind and packet.seq != self._rewind[-1] + 1:
            self._rewind.clear()
        self._rewind.append(packet.seq)
        if len(self._rewind) == REWIND_PACKETS:
            self._begin(packet)
            return Order.AFTER_RESTART
        return Order.DUPLICATE if packet.seq == expected - 1 else Order.OUT_OF_ORDER
