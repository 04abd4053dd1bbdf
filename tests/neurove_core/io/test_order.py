"""Order: what passes when the clock of a recording misbehaves, and how it is counted."""

from collections.abc import Iterable, Sequence
from itertools import pairwise

import numpy as np
import pytest

from neurove_core.io.checked import cleaned, ordered
from neurove_core.io.errors import BrokenRecording
from neurove_core.io.faults import Reason, Tally
from neurove_core.io.order import MAX_GAP_US, RESTART_US
from neurove_core.io.recording import Triggers
from neurove_protocol import Events, Sensor

SENSOR = Sensor(64, 48)
SECOND = 1_000_000


def events_at(*spans: Sequence[int] | np.ndarray) -> Events:
    """Events at these times; x numbers them modulo the width."""
    t = np.concatenate([np.asarray(span, np.int64) for span in spans])
    i = np.arange(t.size)
    return Events.from_columns(t, i % 64, i % 48, i % 2)


def passed(events: Events, cuts: Iterable[int] = (), sensor: Sensor = SENSOR) -> tuple[Events, Tally]:
    """What passes of events in pieces that end at these cuts."""
    tally, edges = Tally("events"), [0, *cuts, events.n]
    pieces = ((lambda i, a=a: f"event {a + i}", events.span(a, b)) for a, b in pairwise(edges))
    return Events.join(list(cleaned(pieces, sensor, tally))), tally


def counts(tally: Tally) -> dict[Reason, int]:
    return {fault.reason: fault.count for fault in tally.faults}


STEADY = np.arange(2_000) * 1000  # two seconds
CASES = {
    "in order": (events_at(STEADY), 2_000, {}),
    "one late": (events_at(STEADY[:1000], [STEADY[1000] - 99_000], STEADY[1001:]), 1_999, {Reason.LATE: 1}),
    "one very late": (events_at(STEADY + 9 * SECOND, [0], STEADY + 12 * SECOND), 4_000, {Reason.LATE: 1}),
    "stale start": (events_at(STEADY[:10] + 500 * SECOND, STEADY), 2_000, {Reason.STALE_START: 10}),
    "one very late among the first": (
        events_at(STEADY[:7] + 9 * SECOND, [0], STEADY + 10 * SECOND),
        2_007,
        {Reason.LATE: 1},
    ),
    "restart": (events_at(STEADY + 500 * SECOND, STEADY), 4_000, {Reason.NEW_CLOCK: 1}),
    "two restarts": (events_at(STEADY, STEADY, STEADY), 6_000, {Reason.NEW_CLOCK: 2}),
    "one far ahead": (events_at(STEADY, [10**15], STEADY + 3 * SECOND), 4_000, {Reason.TIME_JUMP: 1}),
    "gap": (events_at([0], STEADY + 10**15), 2_001, {Reason.GAP: 1}),
    "gap at the end": (events_at(STEADY, [10**15]), 2_001, {Reason.GAP: 1}),
    "packets in another order": (
        events_at(STEADY[:500], STEADY[900:1300], STEADY[500:900], STEADY[1300:]),
        1_600,
        {Reason.LATE: 400},
    ),
    "short restart at the end": (events_at(STEADY, [0, 1, 2]), 2_000, {Reason.LATE: 3}),
}
each_case = pytest.mark.parametrize("case", CASES)


@each_case
def test_the_valid_events_pass_and_the_others_are_counted_by_reason(case):
    events, n, want = CASES[case]
    got, tally = passed(events)
    assert got.n == n
    assert counts(tally) == want
    assert (np.diff(got.t) >= 0).all()


@each_case
@pytest.mark.parametrize("seed", range(3))
def test_the_result_does_not_depend_on_the_pieces_of_the_recording(case, seed):
    events, _, want = CASES[case]
    rng = np.random.default_rng(seed)
    got, tally = passed(events, np.sort(rng.integers(0, events.n, 40)).tolist())
    whole, _ = passed(events)
    for name, one, other in zip("txyp", got, whole, strict=True):
        np.testing.assert_array_equal(one, other, err_msg=name)
    assert counts(tally) == want


def test_the_times_of_a_new_clock_continue_one_second_after_the_old_ones():
    got, tally = passed(events_at(STEADY + 500 * SECOND, STEADY))
    assert got.t[2_000] - got.t[1_999] == RESTART_US
    np.testing.assert_array_equal(np.diff(got.t[2_000:]), 1000)
    (fault,) = tally.faults
    assert fault.where == "event 2000"
    assert "t=0 us comes after t=501999000 us" in fault.why


def test_a_stale_start_does_not_move_the_times_of_the_recording():
    got, tally = passed(events_at(STEADY[:10] + 500 * SECOND, STEADY))
    np.testing.assert_array_equal(got.t, STEADY)
    assert tally.faults[0].where == "event 0"


def test_a_gap_names_its_length_and_its_place():
    _, tally = passed(events_at(STEADY, STEADY + 60 * SECOND))
    (fault,) = tally.faults
    assert fault.where == "event 2000"
    assert "nothing for 58.0 s" in fault.why
    assert not passed(events_at([0], [MAX_GAP_US]))[1].faults


def test_an_event_outside_the_sensor_is_skipped_and_named_with_its_real_numbers():
    x, y = np.arange(1000) % 64, np.arange(1000) % 48
    y[500], x[700] = -47, 99
    events = Events(np.arange(1000), x, y, np.zeros(1000, np.int64))  # type: ignore[arg-type]  # signed on purpose
    got, tally = passed(events, [300, 600])
    assert got.n == 998
    assert [column.dtype for column in got] == [np.int64, np.uint16, np.uint16, np.uint8]
    (fault,) = tally.faults
    assert (fault.reason, fault.count, fault.where) == (Reason.OUTSIDE, 2, "event 500")
    assert fault.why == f"x={500 % 64} y=-47 lies outside the sensor 64x48"


def test_the_place_of_a_late_event_after_skipped_ones_is_that_of_the_recording():
    events = events_at(STEADY[:1000], [0], STEADY[1001:])
    events.x[:200] = 99
    _, tally = passed(events)
    assert {fault.reason: fault.where for fault in tally.faults} == {
        Reason.OUTSIDE: "event 0",
        Reason.LATE: "event 1000",
    }


def test_an_error_that_ends_the_pieces_is_counted_and_all_events_before_it_are_given():
    def pieces():
        yield "piece 0", events_at(STEADY)
        raise BrokenRecording("a.bin", "byte 99", "the file ends within a record")

    tally = Tally("events")
    assert Events.join(list(cleaned(pieces(), SENSOR, tally))).n == 2_000
    (fault,) = tally.faults
    assert (fault.reason, fault.where, fault.why) == (Reason.UNREAD, "byte 99", "the file ends within a record")


def test_samples_after_a_restart_of_the_clock_are_discarded_because_events_no_longer_match_them():
    def triggers(t):
        return Triggers(t, np.zeros(t.size, np.uint8), np.ones(t.size, np.uint8))

    tally = Tally("triggers")
    pieces = iter([("a", triggers(STEADY + 5 * SECOND)), ("b", triggers(STEADY))])
    got = list(ordered(pieces, tally))
    assert sum(part.t.size for part in got) == 2_000
    assert counts(tally) == {Reason.LATE: 2_000}


@pytest.mark.parametrize("seed", range(20))
def test_any_times_give_an_ordered_stream_and_every_event_is_passed_or_counted(seed):
    rng = np.random.default_rng(seed)
    scale = [1, 10, 10**4, 10**7, 10**8][seed % 5]
    steps = rng.integers(-scale, 2 * scale, 5_000) * (rng.random(5_000) < [0.01, 0.5, 1][seed % 3])
    events = events_at(np.cumsum(steps) + np.arange(5_000))
    got, tally = passed(events, np.sort(rng.integers(0, events.n, 9)).tolist())
    assert (np.diff(got.t) >= 0).all()
    lost = {Reason.LATE, Reason.STALE_START, Reason.TIME_JUMP}
    assert got.n + sum(fault.count for fault in tally.faults if fault.reason in lost) == events.n
