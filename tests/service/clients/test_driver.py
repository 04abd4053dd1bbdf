import itertools

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from neurove_core.io import BrokenRecording
from neurove_core.io.formats.packet_log.reader import RecordedPacket
from neurove_core.io.packets import PACKET_EVENTS, PACKET_US, slices
from neurove_protocol import Events
from neurove_service.clients.driver import repeated
from neurove_service.clients.replay import Pace
from tests.builders import make_events, make_packet


def split(events, cuts):
    edges = [0, *sorted(cuts), events.n]
    return [events.span(a, b) for a, b in itertools.pairwise(edges) if b > a]


def same(a, b):
    return all(np.array_equal(x, y) for x, y in zip(a, b, strict=True))


@given(st.integers(1, 3000), st.integers(0, 99), st.lists(st.integers(0, 3000), max_size=5))
def test_slices_hold_every_event_once_for_any_chunks_of_the_reader(n, seed, cuts):
    events = make_events(n, seed=seed, start_us=123_457)
    pieces = list(slices(iter(split(events, [one % n for one in cuts]))))
    assert same(Events.join([piece.events for piece in pieces]), events)
    for piece in pieces:
        assert piece.end_us - piece.t0_us <= PACKET_US
        assert piece.events.n <= PACKET_EVENTS
        assert all(piece.t0_us <= t < piece.end_us for t in piece.events.t)
    starts = [piece.t0_us for piece in pieces]
    assert starts == sorted(starts)
    assert pieces[-1].t0_us == int(events.t[-1]) + 1  # the clock tick at the end
    again = list(slices(iter([events])))
    assert [piece.t0_us for piece in again] == starts


def test_a_silent_span_ticks_at_packet_rate():
    quiet = Events.from_columns([0, 40_000], [1, 1], [1, 1], [1, 1])
    assert [piece.t0_us for piece in slices(iter([quiet]))] == [*range(0, 44_000, PACKET_US), 40_001]


def test_a_gap_of_years_is_skipped_with_one_tick():
    years_us = 50 * 365 * 86_400_000_000
    events = Events.from_columns([0, 5_000, years_us, years_us + 9_000], [1] * 4, [1] * 4, [1] * 4)
    pieces = list(slices(iter([events])))
    assert [piece.t0_us for piece in pieces] == [
        0,
        4_000,
        years_us,
        years_us + 4_000,
        years_us + 8_000,
        years_us + 9_001,
    ]
    assert [piece.skipped_us for piece in pieces] == [0, 0] + [years_us - 8_000] * 4
    assert [piece.events.n for piece in pieces] == [1, 1, 1, 0, 1, 0]
    cut = [piece.t0_us for piece in slices(iter(split(events, [1, 2, 3])))]
    assert cut == [piece.t0_us for piece in pieces]


def test_a_replay_skips_a_gap_and_says_so(caplog):
    pace = Pace(speed=1.0)
    recorded = RecordedPacket("cam0", b"", 0)
    times = (0, 4_000, 60_000_000, 60_004_000)
    elapsed = [pace.due(recorded, make_packet(0, t0_us=t_us))[1] for t_us in times]
    assert elapsed == [0, 0.004, 0.004, 0.008]
    assert "gap skipped: stream=cam0 seconds=60.0" in caplog.text


def test_a_burst_is_split_by_count():
    burst = make_events(2 * PACKET_EVENTS + 1, duration_us=1000)
    sizes = [piece.events.n for piece in slices(iter([burst]))]
    assert sizes == [PACKET_EVENTS, PACKET_EVENTS, 1, 0]


def test_a_broken_recording_plays_its_valid_part_and_then_raises():
    events = make_events(500)

    def breaking():
        yield events
        raise BrokenRecording("x.raw", "byte 77", "truncated")

    pieces = slices(breaking())
    played = [next(pieces).events]
    while int(played[-1].t[-1] if played[-1].n else 0) < int(events.t[-1]):
        played.append(next(pieces).events)
    assert same(Events.join(played), events)
    assert next(pieces).t0_us == int(events.t[-1]) + 1
    with pytest.raises(BrokenRecording, match="byte 77"):
        next(pieces)


class Twice:
    endless = False

    def chunks(self):
        yield make_events(100, start_us=5000)
        yield make_events(100, start_us=205_000)


def test_the_times_of_a_looped_recording_continue():
    times = np.concatenate([chunk.t for chunk in itertools.islice(repeated(Twice()), 6)])
    assert (np.diff(times) >= 0).all()
    assert times[200] == times[199] + 1


class Nothing:
    endless = False

    def chunks(self):
        yield from ()


def test_an_empty_recording_looped_ends():
    assert list(repeated(Nothing())) == []
    assert list(slices(iter(()))) == []
