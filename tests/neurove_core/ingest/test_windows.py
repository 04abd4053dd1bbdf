"""Windows: independent of packet sizes, half-open on an absolute grid, and every event is accounted for."""

import itertools
import pickle
from typing import NamedTuple

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from neurove_core.config import CanonicalConfig, WindowConfig
from neurove_core.geometry.camera import OUTSIDE, lookup_table
from neurove_core.ingest.counting import count_events_reference
from neurove_core.ingest.windows import Window, WindowsState, push
from neurove_protocol import Events
from tests.builders import SENSOR, make_events

CONFIG = WindowConfig(duration_us=10_000, bins=5, max_hole_windows=3)
CANONICAL = CanonicalConfig(width=16, height=12)
LUT = lookup_table(CANONICAL, SENSOR, None)
HALF_BLIND = np.where(np.arange(SENSOR.width) < SENSOR.width // 2, OUTSIDE, LUT).astype(np.int32)


class Packet(NamedTuple):
    events: Events
    horizon_us: int


class Run(NamedTuple):
    windows: list[Window]
    state: WindowsState
    late: int
    skipped: int


def run(packets: list[Packet], lut: NDArray[np.int32] = LUT, state: WindowsState | None = None) -> Run:
    state, windows, late, skipped = state or WindowsState(), [], 0, 0
    for packet in packets:
        pushed = push(packet.events, packet.horizon_us, state, lut, CONFIG, CANONICAL)
        state = pushed.state
        windows += pushed.windows
        late += pushed.late_events
        skipped += pushed.skipped_windows
    return Run(windows, state, late, skipped)


def events_at(*times_us: int) -> Events:
    return Events.from_columns(times_us, [40] * len(times_us), [5] * len(times_us), [1] * len(times_us))


def at(*times_us: int) -> Packet:
    return Packet(events_at(*times_us), times_us[0])


def tick(horizon_us: int) -> Packet:
    return Packet(Events.empty(), horizon_us)


def whole(events: Events) -> Packet:
    return Packet(events, int(events.t[0]))


def cut_at_random(events: Events, seed: int) -> list[Packet]:
    """The events in packets of any length, some with a tick in between; packets may end between equal timestamps."""
    rng = np.random.default_rng(seed)
    cuts = [0, *np.sort(rng.integers(1, events.n, 40)).tolist(), events.n]
    packets = []
    for first, stop in itertools.pairwise(cuts):
        part = events.span(first, stop)
        before_us, after_us = int(events.t[max(first - 1, 0)]), int(events.t[min(first, events.n - 1)])
        horizon_us = int(rng.integers(before_us, after_us + 1))
        packets += [tick(horizon_us)] if part.n == 0 or rng.random() < 0.3 else []
        packets += [Packet(part, int(rng.integers(horizon_us, after_us + 1)))] if part.n else []
    return packets


def expected_windows(events: Events, lut: NDArray[np.int32]) -> list[Window]:
    """Every window before that of the last event, directly by the definition, without packets and state."""
    number = events.t // CONFIG.duration_us
    windows = []
    for k in range(int(number[0]), int(number[-1])):
        inside = Events(*(column[number == k] for column in events))
        counts = np.zeros((2 * CONFIG.bins, CANONICAL.height, CANONICAL.width), np.uint8)
        start_us = k * CONFIG.duration_us
        outside = count_events_reference(inside, start_us, CONFIG.bin_us, lut, counts)
        windows.append(Window(start_us, counts, inside.n, outside))
    return windows


def assert_same_windows(got: list[Window], want: list[Window]) -> None:
    assert [(w.start_us, w.events, w.outside) for w in got] == [(w.start_us, w.events, w.outside) for w in want]
    for one, other in zip(got, want, strict=True):
        np.testing.assert_array_equal(one.counts, other.counts)


@pytest.mark.parametrize("seed", range(20))
def test_windows_do_not_depend_on_packet_sizes(seed):
    events = make_events(2_000, seed=seed, start_us=-35_000, duration_us=120_000)
    events = events._replace(t=events.t // 500 * 500)  # about eight events share each timestamp
    cut = run(cut_at_random(events, seed), HALF_BLIND)
    assert_same_windows(cut.windows, expected_windows(events, HALF_BLIND))
    assert_same_windows(cut.windows, run([whole(events)], HALF_BLIND).windows)
    assert (cut.late, cut.skipped) == (0, 0)


def test_windows_are_the_same_with_one_packet_for_each_event():
    events = make_events(300, seed=1, duration_us=60_000)
    single = [Packet(events.span(i, i + 1), int(events.t[i])) for i in range(events.n)]
    assert_same_windows(run(single).windows, expected_windows(events, LUT))


@pytest.mark.parametrize("start_us", [-20_000, -10_000, 0, 10_000, 7_000_000_000])
def test_an_event_at_the_start_of_a_window_is_in_it_and_one_at_its_end_is_not(start_us):
    before, first, last, after = start_us - 1, start_us, start_us + 9_999, start_us + 10_000
    windows = run([at(before, first, last, after), tick(start_us + 20_000)]).windows
    assert [(w.start_us, w.events) for w in windows] == [(start_us - 10_000, 1), (start_us, 2), (start_us + 10_000, 1)]


@pytest.mark.parametrize("k", range(CONFIG.bins))
def test_an_event_at_the_start_of_a_bin_is_in_it_and_one_before_is_in_the_previous_bin(k):
    edge_us = 30_000 + k * CONFIG.bin_us
    (window,) = run([at(edge_us, edge_us + CONFIG.bin_us - 1), tick(40_000)]).windows
    assert window.counts.sum(axis=(1, 2)).tolist() == [2 if channel == 2 * k + 1 else 0 for channel in range(10)]


def test_off_events_are_in_even_channels_and_on_events_in_odd_ones():
    off, on = (Events.from_columns([4_000], [40], [5], [p]) for p in (0, 1))
    counts = [run([whole(events), tick(10_000)]).windows[0].counts for events in (off, on)]
    assert [np.flatnonzero(one.sum(axis=(1, 2))).tolist() for one in counts] == [[4], [5]]


@pytest.mark.parametrize("newest_us", [9_999, 10_000])
def test_a_window_is_complete_as_soon_as_its_end_is_reached_and_not_before(newest_us):
    complete = [0] if newest_us >= 10_000 else []
    for last in (at(newest_us), tick(newest_us)):
        assert [w.start_us for w in run([at(0), last]).windows] == complete


@given(k=st.integers(-(10**6), 10**6))
def test_the_grid_is_absolute_so_a_shift_by_whole_windows_only_shifts_the_windows(k):
    events = make_events(400, seed=3, start_us=1_234, duration_us=45_000)
    shift_us = k * CONFIG.duration_us
    shifted = run([whole(events._replace(t=events.t + shift_us))]).windows
    assert_same_windows(shifted, [w._replace(start_us=w.start_us + shift_us) for w in run([whole(events)]).windows])


@pytest.mark.parametrize("lost", [1, 100, 350])
def test_a_lost_first_packet_changes_no_later_window(lost):
    events = make_events(1_000, seed=4, start_us=-25_000, duration_us=60_000)
    full, cut = run([whole(events)]).windows, run([whole(events.span(lost, events.n))]).windows
    assert len(cut) > 2
    assert_same_windows(cut[1:], full[len(full) - len(cut) + 1 :])


@pytest.mark.parametrize("as_one_packet", [True, False])
@pytest.mark.parametrize("gap", range(6))
def test_a_gap_of_up_to_max_hole_windows_gives_empty_windows_and_a_longer_one_is_skipped_and_counted(
    gap, as_one_packet
):
    after_us = (gap + 1) * 10_000 + 17
    packets = [at(5, after_us)] if as_one_packet else [at(5), at(after_us)]
    result = run([*packets, tick(after_us + 10_000)])
    bridged = gap if gap <= CONFIG.max_hole_windows else 0
    assert [(w.start_us, w.events) for w in result.windows] == [
        (0, 1),
        *((10_000 * (k + 1), 0) for k in range(bridged)),
        (after_us - 17, 1),
    ]
    assert result.skipped == gap - bridged
    assert all(not w.counts.any() for w in result.windows if w.events == 0)


def test_a_gap_at_negative_times_is_measured_like_any_other():
    result = run([at(-95_000), at(-5_000), tick(0)])
    assert [w.start_us for w in result.windows] == [-100_000, -10_000]
    assert result.skipped == 8


def test_silence_is_no_gap_while_the_driver_sends_ticks():
    ticks = [tick(us) for us in range(20_000, 200_000, 20_000)]
    result = run([at(5), *ticks, at(200_000)])
    assert [w.start_us for w in result.windows] == list(range(0, 200_000, 10_000))
    assert result.skipped == 0


def test_a_tick_after_a_long_gap_skips_it_as_an_event_would():
    by_tick, by_event = run([at(5), tick(100_000)]), run([at(5), at(100_000)])
    assert_same_windows(by_tick.windows, by_event.windows)
    assert (by_tick.skipped, by_tick.state.start_us) == (by_event.skipped, by_event.state.start_us) == (9, 100_000)


def test_events_of_a_window_that_is_complete_are_late_and_the_rest_of_their_packet_is_not():
    result = run([at(5, 10_500), at(0, 9_998, 9_999, 10_000, 10_600), tick(20_000)])
    assert result.late == 3
    assert [(w.start_us, w.events) for w in result.windows] == [(0, 1), (10_000, 3)]


def test_events_of_a_skipped_window_are_late():
    assert run([at(5), at(100_000), at(50_000, 60_000, 100_001)]).late == 2


def test_an_older_event_of_the_open_window_is_not_late():
    result = run([at(9_000), at(1_000), tick(10_000)])
    assert (result.late, result.windows[0].events) == (0, 2)


def test_the_newest_time_is_kept_after_an_older_packet():
    result = run([tick(5_000), tick(19_999), at(12_000), tick(15_000)])
    assert (result.state.horizon_us, result.state.start_us) == (19_999, 10_000)


def test_before_the_first_packet_there_is_no_window_and_the_first_tick_opens_one():
    assert run([tick(-1)]).state.start_us == -10_000
    assert [w.start_us for w in run([tick(-1), tick(0)]).windows] == [-10_000]


@pytest.mark.parametrize("horizon_us", [5_000, 25_000, 31_000])
def test_the_first_window_contains_the_first_event_or_the_packet_time_whichever_is_earlier(horizon_us):
    result = run([Packet(events_at(25_000), horizon_us), tick(40_000)])
    assert result.windows[0].start_us == min(20_000, horizon_us // 10_000 * 10_000)
    assert (sum(window.events for window in result.windows), result.late) == (1, 0)


def test_memory_does_not_grow_with_the_events_of_an_open_window():
    few, many = (run([whole(make_events(n, seed=5, duration_us=9_000))] * 20).state for n in (100, 10_000))
    assert (few.events, many.events) == (2_000, 200_000)
    assert len(pickle.dumps(many)) <= len(pickle.dumps(few)) + 16  # only the numbers are longer


def test_a_closed_window_never_changes():
    events = make_events(3_000, seed=6, duration_us=80_000)
    state, closed = WindowsState(), []
    for packet in cut_at_random(events, 6):
        pushed = push(packet.events, packet.horizon_us, state, LUT, CONFIG, CANONICAL)
        state = pushed.state
        closed += [(window, window.counts.copy()) for window in pushed.windows]
    assert len(closed) == 7
    for window, counts in closed:
        np.testing.assert_array_equal(window.counts, counts)


@given(data=st.data())
def test_every_event_is_in_a_window_or_in_the_open_one_or_late_and_counts_are_consistent(data):
    packets = []
    for seed in range(data.draw(st.integers(1, 12), "packets")):
        start_us = data.draw(st.integers(-60_000, 60_000), "start")
        events = make_events(
            data.draw(st.integers(0, 60), "n"),
            seed=seed,
            start_us=start_us,
            duration_us=data.draw(st.integers(1, 70_000), "span"),
        )
        packets.append(Packet(events, data.draw(st.integers(-70_000, 90_000), "horizon")))
    result = run(packets, HALF_BLIND)
    in_windows = sum(window.events for window in result.windows)
    assert in_windows + result.state.events + result.late == sum(packet.events.n for packet in packets)
    assert all(int(window.counts.sum()) == window.events - window.outside for window in result.windows)
    starts = [window.start_us for window in result.windows]
    assert all(start % CONFIG.duration_us == 0 for start in starts)
    span = (int(result.state.start_us or 0) - starts[0]) // CONFIG.duration_us if starts else 0
    assert len(starts) + result.skipped == span


def test_events_at_pixels_without_a_cell_are_outside_and_in_no_count():
    events = Events.from_columns([1, 2, 3], [10, 50, 11], [5, 5, 5], [1, 1, 0])
    (window,) = run([whole(events), tick(10_000)], HALF_BLIND).windows
    assert (window.events, window.outside, int(window.counts.sum())) == (3, 2, 1)
