"""A process knows for how long it was suspended."""

from neurove_service.streams.pulse import Pulse


class Clock:
    now_ns = 0

    def __call__(self):
        return self.now_ns


def test_a_suspension_counts_while_it_lasts_and_after_it_until_it_is_older_than_asked_for():
    clock = Clock()
    pulse = Pulse(clock)
    for _ in range(10):
        clock.now_ns += 10_000_000
        pulse.beat()
    assert pulse.longest_ns(0) == 0
    clock.now_ns += 400_000_000  # a thread that wakes before the pulse asks first
    assert pulse.longest_ns(0) == 400_000_000
    pulse.beat()
    assert pulse.longest_ns(100_000_000) == 400_000_000
    assert pulse.longest_ns(500_000_000) == 0
