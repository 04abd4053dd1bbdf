"""Intake: which packets of a stream are processed; every other one is counted by its cause and flags its windows."""

from dataclasses import replace
from typing import NamedTuple, cast

from neurove_protocol import Events, Flag
from neurove_protocol.events import Packet, WireEvents, WirePacket
from neurove_service import logs
from neurove_service.streams.activity import Activity
from neurove_service.streams.age import Ages, newest_us
from neurove_service.streams.clock_unit import ClockUnit
from neurove_service.streams.flags import Flags
from neurove_service.streams.repetition import Repetition
from neurove_service.streams.sequence import Order, Sequence

log = logs.get(__name__)

_LOSS_BY_ORDER = {
    Order.DUPLICATE: "duplicate_packets",
    Order.OUT_OF_ORDER: "out_of_order_packets",
    Order.FOREIGN: "foreign_packets",
}


class Arrival(NamedTuple):
    """When a packet arrived, on the monotonic clock of this node [ns]."""

    received_ns: int
    queued_ns: int  # when it was taken out of the queue
    sent_us: int | None = None  # when the driver sent it, on a clock of its host; None if the driver does not say


class Intake:
    """Checks the order and the age of the packets of one stream.

    Args:
        stream: its name, for the log.
        activity: counts what is not processed.
        flags: of the next estimates.
        max_age_s: older packets are dropped [s].
    """

    def __init__(self, stream: str, activity: Activity, flags: Flags, max_age_s: float) -> None:
        self.ages = Ages()
        self._stream, self._activity, self._flags = stream, activity, flags
        self._max_age_ns = max_age_s * 1e9
        self._sequence = Sequence()
        self._repetition = Repetition()
        self._unit = ClockUnit()
        self._delay_ns = 0  # of the newest packet, see Ages.learn
        self._shed = False  # windows were left out before the next packet

    @property
    def delay_ns(self) -> int:
        """Delay of the newest packet beyond the quickest one, until it arrived [ns]."""
        return self._delay_ns

    @property
    def frozen(self) -> bool:
        """Whether the camera repeats the same events."""
        return self._repetition.frozen

    def order(self, packet: Packet, received_ns: int) -> Order | None:
        """The order of a packet; None for the expected one. Losses are counted."""
        if self._sequence.advance(packet, received_ns):
            return None
        order, lost = self._sequence.place(packet, received_ns)
        if order in _LOSS_BY_ORDER:
            self._activity.lost(_LOSS_BY_ORDER[order], 1)
        elif order is Order.AFTER_GAP:
            if lost or not self._shed:
                self._flags.missing(recoverable=True)
            if lost:
                self._activity.lost("gap_packets", lost)
                log.warning("packets lost", stream=self._stream, gap=lost, total=self._activity.counters.gap_packets)
        elif order is Order.RECOVERED:
            self._activity.add("recovered_packets", 1)
            if self._sequence.gap_is_closed:
                self._flags.recovered()
        elif order is Order.UNCOUNTED:
            self._activity.add("uncounted_packets", 1)
        elif order is Order.AFTER_RESTART:
            log.info("driver restarted", stream=self._stream, seq=packet.seq)
        return order

    @property
    def expected(self) -> int | None:
        """Number of the next packet; None before the first one."""
        return self._sequence.expected

    def advance_run(self, marks: list[tuple[int, int]], received_ns: int) -> None:
        """Accept packets that are all the expected ones, see Sequence.advance_run."""
        self._sequence.advance_run(marks, received_ns)

    def is_stale(self, packet: Packet, arrival: Arrival, packets: int = 1) -> bool:
        """Learn from the times of a packet, or a run of packets, in order; whether it is too old to be processed."""
        if arrival.sent_us is None and self._unit.learn(newest_us(packet), arrival.received_ns):
            self._activity.tell_unit(self._unit.hint)
        self._delay_ns = self.ages.learn(
            newest_us(packet) if arrival.sent_us is None else arrival.sent_us, arrival.received_ns
        )
        if self._delay_ns + arrival.queued_ns - arrival.received_ns <= self._max_age_ns:
            return False
        self._activity.lost("stale_packets", packets)
        self._flags.missing()
        return True

    def compare(self, packet: Packet) -> None:
        """Notice whether the camera repeats the same events."""
        self._repetition.add(packet)

    def shed(self, packets: int) -> None:
        """Expect that many missing numbers, of windows that this node left out whole: the next window is complete."""
        self._sequence.skip(packets)
        self._flags.set_next(Flag.OVERLOAD)
        self._shed = True

    def without_shed_events(self, packet: Packet, open_us: int | None) -> Packet:
        """The first packet after shed windows without their events."""
        if not self._shed:
            return packet
        self._shed = False
        if open_us is None or packet.t0_us >= open_us:
            return packet
        events = packet.events.span(packet.events.before(open_us), packet.events.n)
        if isinstance(packet, WirePacket):
            return packet._replace(events=cast(WireEvents, events))
        return replace(packet, events=cast(Events, events))

    def skip(self, packets: int, flag: Flag | None = None) -> None:
        """Expect that many missing numbers: these packets arrived, but this node refused or dropped them."""
        self._sequence.skip(packets)
        self._flags.missing()
        if flag is not None:
            self._flags.set_next(flag)
