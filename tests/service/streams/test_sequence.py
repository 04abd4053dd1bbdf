import pytest

from neurove_service.streams.sequence import REWIND_PACKETS, Order, Sequence
from tests.builders import make_packet


def places(sequence, *numbers, t0_us=0):
    """Order and loss of each packet; `NEXT` for the expected one."""
    packets = [make_packet(1, seq=number, t0_us=t0_us) for number in numbers]
    return [NEXT if sequence.advance(packet) else sequence.place(packet) for packet in packets]


def orders(sequence, *numbers, t0_us=0):
    return [order for order, _ in places(sequence, *numbers, t0_us=t0_us)]


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


def test_an_old_number_is_a_duplicate_or_out_of_order(sequence):
    assert orders(sequence, 0, 1, 2, 2, 1, 3) == [
        Order.FIRST,
        "next",
        "next",
        Order.DUPLICATE,
        Order.OUT_OF_ORDER,
        "next",
    ]


def test_number_0_with_another_time_is_a_restart_and_with_the_same_time_a_repeat(sequence):
    places(sequence, 0, 1, 2)
    assert orders(sequence, 0) == [Order.OUT_OF_ORDER]
    assert orders(sequence, 0, 1, t0_us=5) == [Order.AFTER_RESTART, "next"]


def test_consecutive_old_numbers_are_a_restart_and_scattered_ones_are_not(sequence):
    places(sequence, *range(100))
    assert set(orders(sequence, 1, 5, 6, 9, 10)) == {Order.OUT_OF_ORDER}
    assert orders(sequence, 20, 21, 22, 23) == [Order.OUT_OF_ORDER] * (REWIND_PACKETS - 1) + [
        Order.AFTER_RESTART,
        "next",
    ]
