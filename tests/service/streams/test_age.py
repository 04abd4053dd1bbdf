import pytest

from neurove_service.streams.age import Ages

MS = 1_000_000
S = 1000 * MS


def delays(ages, times_ms):
    """The delay of each packet [ms], from (clock of the stream, arrival) [ms]."""
    return [round(ages.learn(1000 * sensor, int(arrival * MS)) / MS) for sensor, arrival in times_ms]


def test_the_quickest_packet_has_no_delay_and_a_slower_one_has_the_difference():
    assert delays(Ages(), [(0, 1005), (20, 1030), (40, 1041), (60, 1081)]) == [0, 5, 0, 20]


def test_a_delay_that_grows_is_age():
    found = delays(Ages(), [(t, 1000 + 1.5 * t) for t in range(0, 4000, 20)])
    assert found[-1] > 1900


def test_the_drift_of_two_crystals_is_no_age():
    found = delays(Ages(), [(t, 1.0001 * t) for t in range(0, 3_600_000, 1000)])
    assert max(found) == 0


def test_packets_of_a_stall_are_old_although_nothing_arrived_in_between():
    times = [(t, t) for t in range(0, 1000, 20)] + [(1000 + t, 6000 + t / 50) for t in range(0, 5000, 20)]
    found = delays(Ages(), times)
    assert found[:50] == [0] * 50
    assert found[50] == pytest.approx(5000, abs=2)  # less what may be drift
    assert found == [0] * 50 + sorted(found[50:], reverse=True)  # the backlog is old until it is delivered


def test_the_uncertainty_is_the_usual_delay():
    ages = Ages()
    assert ages.uncertainty_ns == 0
    delays(ages, [(t, t + 3 * (t % 40 > 0)) for t in range(0, 400, 10)])
    assert ages.uncertainty_ns == pytest.approx(3 * MS, rel=0.01)
