"""Sequence check: does a packet follow the previous one, were packets lost, did the driver restart.

A jump is believed only with evidence. A number far ahead, an old number and a repeated packet may come from a damaged
packet, a second driver or the network, so one of them changes nothing.
"""

import enum
from collections import OrderedDict
from dataclasses import dataclass

from neurove_protocol.events import Packet

REWIND_PACKETS = 3
"""After this many consecutive packets that count up from an unexpected number, the driver has restarted."""

REPEATED_PACKETS = 32
"""The same for packets that arrived before: the driver plays the same recording again."""

MAX_PACKETS_PER_S = 50_000
"""A driver cannot send more, so a larger jump of the number is not a loss."""

MIN_JUMP = 256
"""A jump up to this is a loss, however little time has passed."""

SECOND_DRIVER_NS = 1_000_000_000
"""Where two drivers send at the same time, the second one is followed after this silence of the first."""

_REMEMBERED = 1024  # packets, and missing numbers
_SLACK = 8  # packets that may be missing in the run of a second driver


class Order(enum.Enum):
    """Why a packet is not the expected one."""

    FIRST = enum.auto()  # the first packet of the stream
    AFTER_GAP = enum.auto()  # numbers are missing before it
    AFTER_RESTART = enum.auto()  # the driver restarted
    RECOVERED = enum.auto()  # a number that was missing
    UNCOUNTED = enum.auto()  # the driver sends the number 0 in every packet
    DUPLICATE = enum.auto()  # a packet that arrived before
    OUT_OF_ORDER = enum.auto()  # an unexpected number
    FOREIGN = enum.auto()  # of a second driver


@dataclass
class _Run:
    """Consecutive packets that do not continue the sequence."""

    first: int
    expected: int
    length: int = 1
    consecutive: int = 1  # since the newest packet of the sequence
    interleaved: bool = False  # packets of the sequence arrived in between


class Sequence:
    """Checks the sequence numbers of one stream."""

    def __init__(self) -> None:
        self._expected: int | None = None
        self._first_t0_us = self._t0_us = self._newest_ns = 0
        self._recent: list[tuple[int, int] | None] = [None] * _REMEMBERED  # number and t0_us, at number % _REMEMBERED
        self._length = 0  # packets since the begin of the sequence
        self._missing: OrderedDict[int, None] = OrderedDict()
        self._newest_gap: set[int] = set()  # numbers that are still missing in it
        self._unread = 0
        self._other: _Run | None = None  # a restart, or a second driver
        self._repeats: _Run | None = None

    @property
    def gap_is_closed(self) -> bool:
        """Whether all packets of the newest gap have arrived after all."""
        return not self._newest_gap

    def skip(self, packets: int) -> None:
        """Expect that many missing numbers: these packets arrived, but this node refused or dropped them."""
        self._unread += packets

    def advance(self, packet: Packet, received_ns: int = 0) -> bool:
        """Accept a packet if it is the expected one; otherwise return False and change nothing."""
        if packet.seq != self._expected:
            return False
        self._expect_after(packet, received_ns)
        return True

    @property
    def expected(self) -> int | None:
        """Number of the next packet; None before the first one."""
        return self._expected

    def advance_run(self, marks: list[tuple[int, int]], received_ns: int) -> None:
        """Accept packets that are all the expected ones.

        Args:
            marks: number and t0_us of each.
            received_ns: when the last one arrived [ns].
        """
        for seq, t0_us in marks:
            self._recent[seq % _REMEMBERED] = (seq, t0_us)
        self._length += len(marks) - 1
        self._accept(*marks[-1], received_ns)

    def place(self, packet: Packet, received_ns: int = 0) -> tuple[Order, int]:
        """The order of a packet that is not the expected one.

        Args:
            packet: what arrived.
            received_ns: when it arrived, on the monotonic clock [ns].

        Returns:
            the order, and for AFTER_GAP the number of packets lost before this node.
        """
        seq, expected = packet.seq, self._expected
        if expected is None:
            return self._begin(packet, received_ns, Order.FIRST), 0
        if self._recent[seq % _REMEMBERED] == (seq, packet.t0_us):
            return self._place_repeat(packet, received_ns), 0
        if seq in self._missing and packet.t0_us <= self._t0_us:
            del self._missing[seq]
            self._newest_gap.discard(seq)
            self._remember(packet)
            return Order.RECOVERED, 0
        if seq == 0 and self._is_uncounted(packet):
            self._expect_after(packet, received_ns)
            return Order.UNCOUNTED, 0
        if seq == 0 and packet.t0_us != self._first_t0_us:
            other = _Run(expected, expected, length=0, consecutive=0)  # the former sequence may go on: a second driver
            self._begin(packet, received_ns, Order.AFTER_RESTART)
            self._other = other
            return Order.AFTER_RESTART, 0
        if seq < expected or self._continues_other(seq) or not self._is_plausible(packet, expected, received_ns):
            return self._place_other(packet, received_ns), 0
        lost = max(0, seq - expected - self._unread)
        self._miss(expected, seq)
        self._expect_after(packet, received_ns)
        return Order.AFTER_GAP, lost

    def _is_uncounted(self, packet: Packet) -> bool:
        """Whether the packet goes on in time after a packet with the number 0, as if nobody counted."""
        return self._expected == 1 and 0 < packet.t0_us - self._t0_us <= 1_000_000

    def _is_plausible(self, packet: Packet, expected: int, received_ns: int) -> bool:
        """Whether so many packets can have been sent since the newest one."""
        elapsed_s = max(received_ns - self._newest_ns, (packet.t0_us - self._t0_us) * 1000) / 1e9
        return packet.seq - expected <= max(MIN_JUMP, MAX_PACKETS_PER_S * elapsed_s)

    def _continues_other(self, seq: int) -> bool:
        other = self._other
        return other is not None and other.expected <= seq <= other.expected + _SLACK

    def _place_repeat(self, packet: Packet, received_ns: int) -> Order:
        repeats = self._repeats
        if repeats is not None and packet.seq == repeats.expected:
            repeats.expected, repeats.length = packet.seq + 1, repeats.length + 1
        else:
            repeats = self._repeats = _Run(packet.seq, packet.seq + 1)
        from_start = repeats.first == 0 and self._length > REPEATED_PACKETS
        if repeats.length >= (REWIND_PACKETS if from_start else REPEATED_PACKETS):
            return self._begin(packet, received_ns, Order.AFTER_RESTART)
        return Order.DUPLICATE

    def _place_other(self, packet: Packet, received_ns: int) -> Order:
        other = self._other
        if other is not None and self._continues_other(packet.seq):
            other.expected = packet.seq + 1
            other.length, other.consecutive = other.length + 1, other.consecutive + 1
        else:
            other = self._other = _Run(packet.seq, packet.seq + 1)
        silent = received_ns - self._newest_ns > SECOND_DRIVER_NS
        if other.consecutive >= REWIND_PACKETS and (silent or not other.interleaved):
            return self._begin(packet, received_ns, Order.AFTER_RESTART)
        return Order.FOREIGN if other.interleaved and other.length > 1 else Order.OUT_OF_ORDER

    def _begin(self, packet: Packet, received_ns: int, order: Order) -> Order:
        self._first_t0_us = packet.t0_us
        self._recent = [None] * _REMEMBERED
        self._length = 0
        self._missing.clear()
        self._newest_gap = set()
        self._other = None
        self._expect_after(packet, received_ns)
        return order

    def _expect_after(self, packet: Packet, received_ns: int) -> None:
        self._accept(packet.seq, packet.t0_us, received_ns)

    def _accept(self, seq: int, t0_us: int, received_ns: int) -> None:
        self._expected, self._unread = seq + 1, 0
        self._t0_us, self._newest_ns = t0_us, received_ns
        self._recent[seq % _REMEMBERED] = (seq, t0_us)
        self._length += 1
        self._repeats = None
        if self._other is not None:
            self._other.interleaved, self._other.consecutive = True, 0

    def _remember(self, packet: Packet) -> None:
        self._recent[packet.seq % _REMEMBERED] = (packet.seq, packet.t0_us)
        self._length += 1

    def _miss(self, first: int, stop: int) -> None:
        self._newest_gap = set(range(max(first, stop - _REMEMBERED), stop))
        self._missing.update(dict.fromkeys(sorted(self._newest_gap)))
        while len(self._missing) > _REMEMBERED:
            self._missing.popitem(last=False)
