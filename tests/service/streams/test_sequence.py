import pytest

from neurove_service.streams.sequence import REPEATED_PACKETS, REWIND_PACKETS, Order, Sequence
from tests.builders import make_packet


def places(sequence, *numbers, shift_us=0, received_ns=0):
    """Order and loss of each packet, 4 ms each; `NEXT` for the expected one."""
    packets = [make_packet(1, seq=number, t0_us=shift_us + 4000 * number) for number in numbers]
    return [
        NEXT if sequence.advance(packet, received_ns) else sequence.place(packet, received_ns) for packet in packets
    ]


def orders(sequence, *numbers, shift_us=0, received_ns=0):
    return [order for order, _ in places(sequence, *numbers, shift_us=shift_us, received_ns=received_ns)]


NEXT = ("next", 0)


@pytest.fixture
def sequence():
    return Sequence()


def test_a_stream_may_begin_with_any_number(sequence):
    assert places(sequence, 7, 8, 9) == [(Order.FIRST, 0), NEXT, NEXT]


def test_missing_numbers_are_lost_unless_this_node_skipped_them(sequence):
    assert places(sequence, 0, 5) == [(Order.FIRST, 0), (Order.AFTER_GAP, 4)]
    sequence.skip(3)
    assert places(sequence, 10) == [(Order.AFTER_GAP, 1)]
    sequence.skip(9)
    assert places(sequence, 12) == [(Order.AFTER_GAP, 0)]
    assert places(sequence, 14) == [(Order.AFTER_GAP, 1)]  # skipped numbers count for the next packet only


def test_a_packet_that_arrived_before_is_a_duplicate_and_an_unknown_old_number_is_out_of_order(sequence):
    assert orders(sequence, 5, 6, 7, 7, 6, 8, 2) == [
        Order.FIRST,
        "next",
        "next",
        Order.DUPLICATE,
        Order.DUPLICATE,
        "next",
        Order.OUT_OF_ORDER,
    ]


def test_number_0_with_another_time_is_a_restart_and_with_the_same_time_a_repeat(sequence):
    places(sequence, 0, 1, 2)
    assert orders(sequence, 0) == [Order.DUPLICATE]
    assert orders(sequence, 0, 1, shift_us=5) == [Order.AFTER_RESTART, "next"]


def test_a_missing_packet_that_arrives_later_is_recovered_once(sequence):
    assert orders(sequence, 0, 2) == [Order.FIRST, Order.AFTER_GAP]
    assert not sequence.gap_is_closed
    assert orders(sequence, 1, 1, 3) == [Order.RECOVERED, Order.DUPLICATE, "next"]
    assert sequence.gap_is_closed


def test_consecutive_unknown_numbers_are_a_restart_and_scattered_ones_are_not(sequence):
    places(sequence, *range(100))
    assert set(orders(sequence, 1, 15, 60, 9, 30, shift_us=10_000_000)) == {Order.OUT_OF_ORDER}
    assert orders(sequence, 40, 41, 42, 43, shift_us=10_000_000) == [Order.OUT_OF_ORDER] * (REWIND_PACKETS - 1) + [
        Order.AFTER_RESTART,
        "next",
    ]


@pytest.mark.parametrize("burst", [3, 10, REPEATED_PACKETS - 1])
def test_a_burst_of_repeated_packets_is_no_restart(sequence, burst):
    places(sequence, *range(100))
    assert set(orders(sequence, *range(100 - burst, 100))) == {Order.DUPLICATE}
    assert orders(sequence, 100) == ["next"]


def test_a_driver_that_plays_the_same_recording_again_is_accepted(sequence):
    places(sequence, *range(100))
    assert orders(sequence, 0, 1, 2, 3) == [Order.DUPLICATE, Order.DUPLICATE, Order.AFTER_RESTART, "next"]
    places(sequence, *range(4, 100))
    again = orders(sequence, *range(50, 90))  # its first packets were lost
    assert again.count(Order.AFTER_RESTART) == 1
    assert again[-1] == "next"


def test_a_jump_that_no_driver_could_have_sent_is_no_loss(sequence):
    largest = (1 << 63) - 1
    packets = [make_packet(1, seq=seq, t0_us=4000 * i) for i, seq in enumerate((7, largest, 8, largest, 9))]
    found = [NEXT if sequence.advance(packet, 0) else sequence.place(packet, 0) for packet in packets]
    assert [lost for _, lost in found] == [0] * 5
    assert found[2] == found[4] == NEXT
    assert {found[1][0], found[3][0]} == {Order.OUT_OF_ORDER}


def test_a_long_silence_may_lose_many_packets(sequence):
    places(sequence, 0)
    assert places(sequence, 40_000) == [(Order.AFTER_GAP, 39_999)]  # 160 s later by the clock of the sensor


def test_a_driver_that_does_not_count_is_followed(sequence):
    packets = [make_packet(1, seq=0, t0_us=4000 * i) for i in range(50)]
    found = [sequence.place(packet, 0) for packet in packets]
    assert found == [(Order.FIRST, 0), *[(Order.UNCOUNTED, 0)] * 49]
    assert sequence.place(packets[-1], 0) == (Order.DUPLICATE, 0)


def test_of_two_drivers_one_is_followed_and_the_other_is_named(sequence):
    a = [make_packet(1, seq=5000 + i, t0_us=4000 * i) for i in range(40)]
    b = [make_packet(1, seq=i, t0_us=77 + 4000 * i) for i in range(40)]
    mixed = [packet for pair in zip(a, b, strict=True) for packet in pair]
    found = [NEXT if sequence.advance(packet, 0) else sequence.place(packet, 0) for packet in mixed]
    kinds = [order for order, _ in found]
    assert kinds.count(Order.AFTER_RESTART) == 1  # the second driver began at 0
    assert kinds[10:].count("next") == kinds[10:].count(Order.FOREIGN) == 35
    assert sum(lost for _, lost in found) == 0


def test_when_the_first_of_two_drivers_ends_the_second_one_is_followed(sequence):
    places(sequence, *range(100))
    mixed = [seq for pair in zip(range(100, 120), range(40, 60), strict=True) for seq in pair]
    for seq in mixed:
        orders(sequence, seq, shift_us=0 if seq >= 100 else 10_000_000)
    assert orders(sequence, 60, 61, 62, shift_us=10_000_000) == [Order.FOREIGN] * 3
    later = orders(sequence, 63, 64, shift_us=10_000_000, received_ns=2_000_000_000)
    assert later == [Order.AFTER_RESTART, "next"]
