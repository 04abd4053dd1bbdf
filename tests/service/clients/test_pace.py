"""How far a driver is behind real time."""

import math

from neurove_service.clients.pace import Lag


class Clock:
    def __init__(self):
        self.now = 10.0

    def __call__(self):
        return self.now


def test_a_driver_that_cannot_keep_up_is_reported_once_with_its_place():
    clock, said = Clock(), []
    lag = Lag(1.0, lambda *one: said.append(one), clock)
    for elapsed_s in (1.0, 2.0, 3.0):
        clock.now = 10.0 + 1.75 * elapsed_s  # the source takes 1.75 s for a second
        lag.sent(10.0 + elapsed_s, elapsed_s)
    assert said == [(1.5, 2.0)]
    assert lag.most_s == 2.25


def test_a_short_pause_of_the_machine_is_no_report_and_the_longest_is_kept():
    clock, said = Clock(), []
    lag = Lag(1.0, lambda *one: said.append(one), clock)
    clock.now = 11.5
    lag.sent(11.0, 1.0)
    clock.now = 12.0
    lag.sent(12.0, 2.0)
    assert (said, lag.most_s) == ([], 0.5)


def test_at_full_speed_nothing_is_due():
    lag = Lag(math.inf, lambda *_: 1 / 0, Clock())
    lag.sent(0.0, 5.0)
    assert lag.most_s == 0
