"""Decoders of EVT2 and EVT3 words: the compiled ones, their reference implementations, and the camera's clock."""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numba
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from neurove_core import compiled
from neurove_core.io.formats.prophesee import evt, triggers
from neurove_core.io.formats.prophesee.evt import VECTOR_EVENTS, Evt2State, Evt3State
from neurove_protocol import Events, Sensor
from tests.builders import make_events
from tests.builders_evt import (
    ADDR_X,
    ADDR_Y,
    BASE_X,
    OTHERS,
    TIME_HIGH,
    TIME_LOW,
    TRIGGER,
    VECT_8,
    VECT_12,
    Written,
    cd,
    evt2,
    evt3,
    write_evt2,
    write_evt3,
)
from tests.recordings import assert_same

SENSOR = Sensor(1280, 720)


class Format(NamedTuple):
    decode: Callable[..., tuple[Any, int, int]]
    reference: Callable[..., tuple[Any, Events, list[int]]]
    start: Any
    write: Callable[[Events], Written]
    dtype: type[np.unsignedinteger]
    wrap_us: int


EVT2 = Format(evt.evt2_decode, evt.evt2_reference, Evt2State(), write_evt2, np.uint32, 1 << 34)
EVT3 = Format(evt.evt3_decode, evt.evt3_reference, Evt3State(), write_evt3, np.uint16, 1 << 24)
both = pytest.mark.parametrize("format_", [EVT2, EVT3], ids=["evt2", "evt3"])


def zero_events(n: int) -> Events:
    return Events(np.zeros(n, np.int64), np.zeros(n, np.uint16), np.zeros(n, np.uint16), np.zeros(n, np.uint8))


def decode(
    format_: Format, words: NDArray[Any], *, state: Any = None, n_max: int = 4096
) -> tuple[Any, Events, list[int]]:
    """Decode all words, with an `out` of n_max events for each call: state, events, reserved words (count, first)."""
    state, parts, done, found = state or format_.start, [Events.empty()], 0, [0, 0]
    while done < words.size:
        out, reserved = zero_events(n_max), np.zeros(2, np.int64)
        state, read, n = format_.decode(words[done:], state, out, reserved)
        parts.append(out.span(0, n))
        count, first = reserved.tolist()
        found = [found[0] + count, found[1] if found[0] or not count else done + first]
        done += read
    return state, Events.join(parts), found


def rows(events: Events) -> list[tuple[int, ...]]:
    return list(zip(*(column.tolist() for column in events), strict=True))


def in_rows(n: int, seed: int, start_us: int, duration_us: int, sensor: Sensor = SENSOR) -> Events:
    """Events as a camera sends rows: many neighbours with the same time and row."""
    rng = np.random.default_rng(seed)
    t = np.sort(rng.integers(start_us, start_us + duration_us, max(n // 8, 1)))[rng.integers(0, max(n // 8, 1), n)]
    y, p = t * 7919 % sensor.height, t * 31 % 2
    x = (t * 104_729 + rng.integers(0, 40, n)) % sensor.width
    order = np.lexsort((x, t))
    return Events.from_columns(*(column[order] for column in (t, x, y, p)))


# Words of every type, with the important types more often; TIME_HIGH is mostly near its previous value, as in a clock.
def evt3_streams() -> st.SearchStrategy[NDArray[np.uint16]]:
    word = st.tuples(st.sampled_from([0, 2, 2, 2, 3, 4, 4, 5, 5, 6, 7, 0xA, 0xE, 0xF]), st.integers(0, 0xFFF))
    high = st.tuples(st.just(TIME_HIGH), st.one_of(st.integers(0, 15), st.integers(4085, 4095), st.integers(0, 4095)))
    return st.lists(st.one_of(word, word, high), max_size=200).map(lambda words: evt3(*words))


def evt2_streams() -> st.SearchStrategy[NDArray[np.uint32]]:
    value = st.integers(0, (1 << 28) - 1)
    word = st.tuples(st.sampled_from([0, 1, 0, 1, 0xA, 0xE, 0xF]), value)
    top = (1 << 28) - 1
    high = st.tuples(st.just(TIME_HIGH), st.one_of(st.integers(0, 15), st.integers(top - 15, top), value))
    return st.lists(st.one_of(word, word, high), max_size=200).map(lambda words: evt2(*words))


@both
@pytest.mark.parametrize("seed", range(5))
def test_written_words_decode_to_their_events_across_a_wrap_of_the_clock(format_, seed):
    start_us = format_.wrap_us - 50_000
    for events in (
        make_events(500, seed=seed, start_us=start_us, sensor=SENSOR),
        in_rows(2000, seed, start_us, 100_000),
    ):
        words, ends = format_.write(events)
        assert events.t[-1] > format_.wrap_us
        _, got, reserved = decode(format_, words)
        assert reserved == [0, 0]
        assert_same(got, events)
        for stop in np.random.default_rng(seed).integers(0, words.size, 20):
            assert decode(format_, words[:stop])[1].n == np.searchsorted(ends, stop, "right")


@pytest.mark.parametrize(("format_", "days"), [(EVT3, 0.01), (EVT2, 0.5)], ids=["evt3", "evt2"])
def test_the_clock_is_unwrapped_over_many_wraps(format_, days):
    t = np.arange(0, int(days * 86_400e6), format_.wrap_us // 3)
    events = Events.from_columns(t, t % 640, t % 480, t % 2)
    assert events.t[-1] > 2 * format_.wrap_us
    assert_same(decode(format_, format_.write(events).words)[1], events)


@given(words=evt3_streams())
def test_compiled_evt3_decoder_equals_its_reference(words):
    assert_equals_reference(EVT3, words)


@given(words=evt2_streams())
def test_compiled_evt2_decoder_equals_its_reference(words):
    assert_equals_reference(EVT2, words)


@both
@pytest.mark.parametrize("seed", range(10))
def test_compiled_decoder_equals_its_reference_on_noise(format_, seed):
    """Random words, also of unknown types: both decoders skip the same words."""
    rng = np.random.default_rng(seed)
    top = np.iinfo(format_.dtype).max
    kinds = np.array([0, 1, 2, 3, 4, 5, 6, 8, 8, 0xA, 0xE, 0xF] if format_ is EVT3 else [0, 1, 8, 0xE, 9])
    words = rng.integers(0, top, 3000, format_.dtype, endpoint=True)
    shift = np.iinfo(format_.dtype).bits - 4
    words = (words & (top >> 4)) | (rng.choice(kinds[kinds != seed % 10], 3000).astype(format_.dtype) << shift)
    assert_equals_reference(format_, words)


def assert_equals_reference(format_: Format, words: NDArray[Any]) -> None:
    state, events, reserved = decode(format_, words)
    want_state, want_events, want_reserved = format_.reference(words, format_.start)
    assert_same(events, want_events)
    assert reserved == [len(want_reserved), want_reserved[0] if want_reserved else 0]
    assert state == want_state


@given(words=evt3_streams(), splits=st.lists(st.integers(0, 200), max_size=6), n_max=st.integers(VECTOR_EVENTS, 40))
def test_events_do_not_depend_on_how_evt3_words_are_split(words, splits, n_max):
    assert_splits_do_not_matter(EVT3, words, splits, n_max)


@given(words=evt2_streams(), splits=st.lists(st.integers(0, 200), max_size=6), n_max=st.integers(1, 40))
def test_events_do_not_depend_on_how_evt2_words_are_split(words, splits, n_max):
    assert_splits_do_not_matter(EVT2, words, splits, n_max)


def assert_splits_do_not_matter(format_: Format, words: NDArray[Any], splits: Sequence[int], n_max: int) -> None:
    want_state, want, _ = decode(format_, words)
    for step in (decode, reference):
        state, parts = format_.start, []
        for piece in np.split(words, sorted(splits)):
            state, events, _ = step(format_, piece, state=state, n_max=n_max)
            parts.append(events)
        assert_same(Events.join(parts), want)
        assert state == want_state


def reference(format_: Format, words: NDArray[Any], *, state: Any, n_max: int) -> Any:
    return format_.reference(words, state)


@pytest.mark.parametrize("n_max", range(VECTOR_EVENTS, 2 * VECTOR_EVENTS))
def test_a_vector_that_does_not_fit_is_left_for_the_next_call(n_max):
    words = evt3((TIME_HIGH, 0), (ADDR_Y, 1), (BASE_X, 0), HIT, *[(VECT_12, 0xFFF)] * 50)
    out = zero_events(n_max + 50)  # the decoder must not write beyond `out`
    _, _, n = evt.evt3_decode(words, Evt3State(), out.span(0, n_max), np.zeros(2, np.int64))
    assert n <= n_max
    assert not out.x[n_max:].any()
    assert_same(decode(EVT3, words, n_max=n_max)[1], decode(EVT3, words)[1])


def test_without_space_for_a_vector_nothing_is_read_or_written():
    out = zero_events(VECTOR_EVENTS)
    words = evt3((TIME_HIGH, 0), (ADDR_Y, 1), HIT)
    _, read, n = evt.evt3_decode(words, Evt3State(), out.span(0, VECTOR_EVENTS - 1), np.zeros(2, np.int64))
    assert (read, n) == (0, 0)
    assert not out.x.any()


HIT = (ADDR_X, 7)


def evt3_times(*words: tuple[int, int]) -> list[int]:
    """Times of the events of these words, after a word for the row."""
    return list(map(int, decode(EVT3, evt3((ADDR_Y, 5), *words))[1].t))


def test_a_small_decrease_of_time_high_is_not_a_wrap_and_times_do_not_decrease():
    times = evt3_times(
        (TIME_HIGH, 100), (TIME_LOW, 50), HIT, (TIME_HIGH, 98), (TIME_LOW, 60), HIT, (TIME_HIGH, 101), HIT
    )
    assert times == [100 * 4096 + 50, 100 * 4096 + 50, 101 * 4096]


@pytest.mark.parametrize(
    ("before", "after", "then"),
    [
        (4095, 4094, "stays"),
        (4095, 4085, "stays"),
        (4095, 4084, "changes"),
        (2000, 100, "changes"),
        (3072, 1024, "changes"),
        (3071, 1023, "changes"),
        (3072, 1023, "wraps"),
        (4095, 0, "wraps"),
    ],
)
def test_only_a_step_from_near_the_top_of_time_high_to_near_zero_is_a_wrap(before, after, then):
    first, second = evt3_times((TIME_HIGH, before), HIT, (TIME_HIGH, after), HIT)
    assert first == before * 4096
    assert second == {"stays": first, "changes": after * 4096, "wraps": (4096 + after) * 4096}[then]


def test_the_clock_of_evt2_gains_no_hours_by_a_restart():
    words = evt2((8, 1 << 27), (1, cd(3, 1, 1)), (8, 5), (1, cd(2, 1, 1)))
    assert decode(EVT2, words)[1].t.tolist() == [(1 << 33) + 3, 5 * 64 + 2]


def test_a_decrease_across_a_wrap_is_undone_by_the_next_increase():
    times = evt3_times((TIME_HIGH, 4095), HIT, (TIME_HIGH, 0), HIT, (TIME_HIGH, 4094), HIT, (TIME_HIGH, 1), HIT)
    assert [t >> 12 for t in times] == [4095, 4096, 4096, 4097]


def test_evt2_accepts_a_small_decrease_of_time_high_too():
    top = (1 << 28) - 1
    words = [
        (8, top),
        (1, cd(3, 1, 1)),
        (8, top - 5),
        (1, cd(0, 1, 1)),
        (8, 0),
        (1, cd(2, 1, 1)),
        (8, top),
        (0, cd(9, 1, 1)),
    ]
    times = decode(EVT2, evt2(*words))[1].t.tolist()
    wrap = 1 << 34
    assert times == [wrap - 64 + 3, wrap - 64 + 3, wrap + 2, wrap + 2]


def test_a_new_time_high_resets_time_low_and_a_repeated_one_changes_nothing():
    times = evt3_times((TIME_HIGH, 1), (TIME_LOW, 4000), HIT, (TIME_HIGH, 1), HIT, (TIME_HIGH, 2), HIT)
    assert times == [4096 + 4000, 4096 + 4000, 2 * 4096]


def test_events_before_the_first_time_or_row_are_ignored():
    early = [(TIME_LOW, 9), (ADDR_Y, 3), HIT, (BASE_X, 20), (VECT_8, 0xFF)]
    got = decode(EVT3, evt3(*early, (TIME_HIGH, 2), HIT, (VECT_8, 1)))[1]
    assert rows(got) == [(2 * 4096, 7, 3, 0), (2 * 4096, 28, 3, 0)]  # the earlier vector advanced the base by 8
    no_base = evt3((TIME_HIGH, 2), HIT, (VECT_12, 1), (ADDR_Y, 3), (VECT_12, 1))
    assert decode(EVT3, no_base)[1].n == 0
    assert decode(EVT2, evt2((1, cd(1, 2, 3)), (8, 0), (1, cd(1, 2, 3))))[1].n == 1


def test_vectors_advance_the_base_and_single_events_do_not():
    words = [(BASE_X, 1 << 11 | 100), (VECT_12, 0b1000_0000_0001), (ADDR_X, 5), (VECT_8, 0b1000_0001), (VECT_12, 1)]
    got = decode(EVT3, evt3((TIME_HIGH, 0), (ADDR_Y, 9), *words))[1]
    assert [(x, p) for _, x, _, p in rows(got)] == [(100, 1), (111, 1), (5, 0), (112, 1), (119, 1), (120, 1)]


def test_triggers_and_monitoring_words_give_no_events():
    words = evt3((TIME_HIGH, 0), (ADDR_Y, 1), (TRIGGER, 1), (OTHERS, 5), (7, 3), (0xF, 4), HIT)
    assert decode(EVT3, words)[1].n == 1
    assert decode(EVT2, evt2((8, 0), (TRIGGER, 1), (OTHERS, 5), (0xF, 4), (1, cd(0, 1, 1))))[1].n == 1


def test_triggers_are_found_with_their_time_channel_and_level():
    early = [(TRIGGER, 1), (TIME_LOW, 9)]
    words = evt3(*early, (TIME_HIGH, 2), (TIME_LOW, 7), HIT, (TRIGGER, 1 << 8 | 1), (TIME_HIGH, 3), (TRIGGER, 1 << 8))
    _, (t, channel, level) = triggers.evt3_triggers(words, triggers.TriggerState())
    assert (t.tolist(), channel.tolist(), level.tolist()) == ([2 * 4096 + 7, 3 * 4096], [1, 1], [1, 0])
    words = evt2((TRIGGER, 1), (8, 5), (TRIGGER, 63 << 22 | 17 << 8 | 1), (1, cd(63, 1, 1)))
    _, (t, channel, level) = triggers.evt2_triggers(words, triggers.TriggerState())
    assert (t.tolist(), channel.tolist(), level.tolist()) == ([5 * 64 + 63], [17], [1])


@given(words=evt3_streams(), splits=st.lists(st.integers(0, 200), max_size=6))
def test_compiled_evt3_triggers_equal_their_reference_for_every_split_of_the_words(words, splits):
    assert_same_triggers(
        triggers.evt3_triggers, triggers.evt3_triggers_reference, np.split(words, sorted(splits)), words
    )


@given(words=evt2_streams(), splits=st.lists(st.integers(0, 200), max_size=6))
def test_compiled_evt2_triggers_equal_their_reference_for_every_split_of_the_words(words, splits):
    assert_same_triggers(
        triggers.evt2_triggers, triggers.evt2_triggers_reference, np.split(words, sorted(splits)), words
    )


def assert_same_triggers(
    decode: Callable[..., Any], reference: Callable[..., Any], pieces: Sequence[NDArray[Any]], words: NDArray[Any]
) -> None:
    state, parts = triggers.TriggerState(), []
    for piece in pieces:
        state, columns = decode(piece, state)
        parts.append(columns)
    want_state, want = reference(words, triggers.TriggerState())
    assert state == want_state
    for got, column in zip(zip(*parts, strict=True), want, strict=True):
        np.testing.assert_array_equal(np.concatenate(got), column)


@pytest.mark.parametrize("kind", [1, 9, 0xB, 0xC, 0xD])
def test_the_evt3_decoder_skips_and_counts_words_of_a_reserved_type(kind):
    _, events, reserved = decode(EVT3, evt3((TIME_HIGH, 0), (ADDR_Y, 1), HIT, (kind, 9), (kind, 0), HIT))
    assert (events.n, reserved) == (2, [2, 3])


@pytest.mark.parametrize("kind", [2, 3, 4, 5, 6, 7, 9, 0xB, 0xC, 0xD])
def test_the_evt2_decoder_skips_and_counts_words_of_a_reserved_type(kind):
    _, events, reserved = decode(EVT2, evt2((8, 0), (1, cd(0, 1, 1)), (kind, 0), (1, cd(0, 1, 1))))
    assert (events.n, reserved) == (2, [1, 2])


def test_an_event_outside_any_sensor_keeps_its_coordinates():
    words = evt3((TIME_HIGH, 1), (ADDR_Y, 2000), (BASE_X, 2040), (VECT_12, 1 << 11))
    assert rows(decode(EVT3, words)[1]) == [(4096, 2051, 2000, 0)]
    assert rows(decode(EVT2, evt2((8, 1), (1, cd(0, 2047, 2046))))[1]) == [(64, 2047, 2046, 1)]


def test_a_kernel_runs_if_no_cache_can_be_written(monkeypatch):
    njit = numba.njit

    def without_writable_cache(*, nogil: bool, cache: bool = False) -> Any:
        if cache:
            raise RuntimeError("cannot cache function: no locator available")
        return njit(nogil=nogil)

    monkeypatch.setattr(numba, "njit", without_writable_cache)

    def double(x: int) -> int:
        return 2 * x

    assert compiled.compiled(double)(21) == 42
