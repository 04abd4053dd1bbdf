import pytest
from structlog.testing import capture_logs

from neurove_service.guard import RECENT_S, Guard


@pytest.fixture
def clock():
    return [100.0]


@pytest.fixture
def guard(clock):
    return Guard(lambda: clock[0])


def fail(guard, place, times=1):
    for _ in range(times):
        with guard.at(place, stream="cam0"):
            raise ValueError("wrong")


def test_an_exception_ends_at_the_guard_and_is_counted_by_place(guard):
    fail(guard, "status", times=3)
    fail(guard, "packet")
    assert guard.counts == {"packet": 1, "status": 3}
    assert guard.recent == ["packet", "status"]


def test_what_ends_the_process_passes_the_guard(guard):
    with pytest.raises(SystemExit), guard.at("status"):
        raise SystemExit
    assert guard.counts == {}


def test_an_error_is_part_of_the_verdict_for_a_minute(guard, clock):
    fail(guard, "status")
    clock[0] += RECENT_S + 1
    assert guard.recent == []
    assert guard.counts == {"status": 1}


def test_a_place_logs_one_line_a_minute(guard, clock):
    with capture_logs() as lines:
        fail(guard, "status", times=100)
        fail(guard, "packet")
        clock[0] += RECENT_S + 1
        fail(guard, "status", times=100)
    assert [(line["place"], line["total"]) for line in lines] == [("status", 1), ("packet", 1), ("status", 101)]
