"""EVT2.1 and EVT4: the compiled decoders, references of them, RAW files in every order of bytes, and bags."""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from neurove_core.io.formats.prophesee.evt import EVT2_BACK_US, step_of
from neurove_core.io.formats.prophesee.vectors import is_legacy, swapped
from neurove_core.io.formats.prophesee.words import FORMATS, Words
from neurove_core.sources import open_source
from neurove_protocol import Events, Sensor
from tests import ros_bags
from tests.builders import SENSOR, make_events
from tests.builders_evt import (
    HEADER_EVT4,
    HEADER_EVT21,
    TIME_HIGH,
    TRIGGER,
    Written,
    cd,
    legacy,
    write_evt2,
    write_evt3,
    write_evt4,
    write_evt21,
)
from tests.neurove_core.io.test_evt import in_rows, zero_events
from tests.recordings import all_triggers, assert_same, put, read, read_broken

LARGE = Sensor(1280, 720)
HEADERS = {"EVT21": HEADER_EVT21, "EVT4": HEADER_EVT4}
WRITE: dict[str, Callable[[Events], Written]] = {
    "EVT2": write_evt2,
    "EVT21": write_evt21,
    "EVT3": write_evt3,
    "EVT4": write_evt4,
}
both = pytest.mark.parametrize("name", HEADERS)


class Found(NamedTuple):
    events: Events
    reserved: list[int]  # count, index of the first
    state: Any


def decode(words: NDArray[Any], format_: Words, *, state: Any = None, n_max: int = 4096) -> Found:
    """Decode all words, with an `out` of n_max events for each call."""
    state, parts, done, found = state or format_.start, [Events.empty()], 0, [0, 0]
    while done < words.size:
        out, reserved = zero_events(n_max), np.zeros(2, np.int64)
        state, read_, n = format_.decode(words[done:], state, out, reserved)
        parts.append(out.span(0, n))
        count, first = reserved.tolist()
        found = [found[0] + count, found[1] if found[0] or not count else done + first]
        done += read_
    return Found(Events.join(parts), found, state)


def reference(words: NDArray[Any], name: str) -> tuple[Events, list[int]]:
    """Events and indices of reserved words, one word after the other."""
    rows: list[tuple[int, int, int, int]] = []
    reserved: list[int] = []
    timed, high, last_us, pending = False, 0, 0, None
    kinds = {"EVT21": ((0, 1), (), 8, (0xA, 0xE, 0xF)), "EVT4": ((0xA, 0xB), (0xC, 0xD), 0xE, (6, 7, 9, 0xF))}
    single, vector, time_high, skipped = kinds[name]
    for i, whole in enumerate(words.tolist()):
        word, mask = (whole >> 32, whole & 0xFFFF_FFFF) if name == "EVT21" else (whole, 1)
        if pending is not None:
            word, mask, pending = pending, whole, None
        elif word >> 28 in vector:
            pending = word
            continue
        elif word >> 28 == time_high:
            value = word & 0xFFF_FFFF
            high = high + step_of(high % (1 << 28), value, 1 << 28) if timed else value
            last_us = last_us if timed else high << 6
            timed = True
            continue
        elif word >> 28 not in single:
            reserved += [] if word >> 28 in skipped else [i]
            continue
        if timed and mask:
            t_us = (high << 6) + (word >> 22 & 0x3F)
            last_us = last_us if 0 < last_us - t_us < EVT2_BACK_US else t_us
            x, y, p = word >> 11 & 0x7FF, word & 0x7FF, word >> 28 & 1
            rows += [(last_us, x + k, y, p) for k in range(32) if mask >> k & 1]
    columns = zip(*rows, strict=True) if rows else [()] * 4
    return Events.from_columns(*columns), reserved


def words_of(name: str) -> st.SearchStrategy[NDArray[Any]]:
    """Words of every type, also reserved ones, most of them events and times near each other."""
    kinds = [0, 1, 1, 8, 0xA, 0xE, 0xF, 5] if name == "EVT21" else [6, 7, 9, 0xA, 0xB, 0xC, 0xD, 0xF, 2]
    top = (1 << 28) - 1
    other = st.tuples(st.sampled_from(kinds), st.integers(0, top))
    time = st.tuples(st.just(8 if name == "EVT21" else 0xE), st.sampled_from([0, 1, 5, 20, top - 3, top]))
    word = st.one_of(other, other, time).map(lambda pair: pair[0] << 28 | pair[1])
    if name == "EVT21":
        mask = st.one_of(st.integers(0, 0xFFFF_FFFF), st.sampled_from([0, 1, 1 << 31, 0xFFFF_FFFF]))
        word = st.tuples(word, mask).map(lambda pair: pair[0] << 32 | pair[1])
    return st.lists(word, max_size=120).map(lambda words: np.array(words, FORMATS[name].dtype))


# --- decoders --------------------------------------------------------------------------------------------------------


@both
@pytest.mark.parametrize("seed", range(3))
def test_written_words_decode_to_their_events_across_a_wrap_of_the_clock(name, seed):
    start_us = (1 << 34) - 50_000
    for events in (
        make_events(500, seed=seed, start_us=start_us, sensor=LARGE),
        in_rows(2000, seed, start_us, 100_000),
    ):
        words, ends = WRITE[name](events)
        found = decode(words, FORMATS[name])
        assert_same(found.events, events)
        assert found.reserved == [0, 0]
        for stop in np.random.default_rng(seed).integers(0, words.size, 20):
            assert decode(words[:stop], FORMATS[name]).events.n == np.searchsorted(ends, stop, "right")


@both
@given(data=st.data())
def test_the_compiled_decoder_equals_its_reference(name, data):
    words = data.draw(words_of(name))
    found = decode(words, FORMATS[name])
    events, reserved = reference(words, name)
    assert_same(found.events, events)
    assert found.reserved == [len(reserved), reserved[0] if reserved else 0]


@both
@given(data=st.data(), splits=st.lists(st.integers(0, 120), max_size=6), n_max=st.integers(32, 70))
def test_events_and_triggers_do_not_depend_on_how_words_are_split(name, data, splits, n_max):
    words, format_ = data.draw(words_of(name)), FORMATS[name]
    want, want_edges = decode(words, format_), format_.triggers(words, format_.first)
    state, edges, parts, triggers = format_.start, format_.first, [Events.empty()], []
    for piece in np.split(words, sorted(splits)):
        found = decode(piece, format_, state=state, n_max=n_max)
        edges, columns = format_.triggers(piece, edges)
        state = found.state
        parts.append(found.events)
        triggers.append(columns)
    assert_same(Events.join(parts), want.events)
    assert (state, edges) == (want.state, want_edges[0])
    for got, column in zip(zip(*triggers, strict=True), want_edges[1], strict=True):
        np.testing.assert_array_equal(np.concatenate(got), column)


@both
def test_without_space_for_a_vector_nothing_is_read_or_written(name):
    words, out = WRITE[name](make_events(5)).words, zero_events(40)
    _, read_, n = FORMATS[name].decode(words, FORMATS[name].start, out.span(0, 31), np.zeros(2, np.int64))
    assert (read_, n) == (0, 0)
    assert not out.t.any()


def test_the_bits_of_evt21_are_those_of_the_specification():
    words = np.array([0x8000_0001_0000_0000, 1 << 60 | 5 << 54 | 64 << 43 | 7 << 32 | 0x8000_0009], np.uint64)
    events = decode(words, FORMATS["EVT21"]).events
    assert [column.tolist() for column in events] == [[69] * 3, [64, 67, 95], [7] * 3, [1] * 3]


def test_the_bits_of_evt4_are_those_of_the_specification():
    body = 5 << 22 | 64 << 11 | 7
    words = [
        0xE000_0001,
        0xB << 28 | body,
        0xA << 28 | body,
        0xC << 28 | body,
        0xE000_0009,
        0xFFFF_FFFF,
        0xD << 28 | body,
        2,
    ]
    events = decode(np.array(words, np.uint32), FORMATS["EVT4"]).events
    mask = [64 + k for k in (0, 3, 29, 30, 31)]  # the mask 0xE0000009 looks like a TIME_HIGH
    assert events.x.tolist() == [64, 64, *mask, 65]
    assert events.p.tolist() == [1, 0, 0, 0, 0, 0, 0, 1]
    assert set(events.t.tolist()) == {69}
    assert set(events.y.tolist()) == {7}


# --- RAW files -------------------------------------------------------------------------------------------------------


@both
def test_a_raw_file_reads_back_identical(name, tmp_path):
    events = in_rows(3000, 5, 9_000_000, 80_000, SENSOR)
    recording = open_source(put(tmp_path, "a.raw", HEADERS[name] + WRITE[name](events).words.tobytes()))
    assert (recording.sensor, recording.streams) == (SENSOR, ("events", "triggers"))
    assert_same(read(recording), events)
    assert recording.faults.found == ()


@pytest.mark.parametrize(
    ("sent", "named"),
    [("little", ""), ("legacy", ""), ("little", "little"), ("legacy", "legacy"), ("big", "big")],
)
def test_evt21_is_read_in_the_order_of_the_header_or_of_its_words(sent, named, tmp_path):
    events = in_rows(500, 6, 9_000_000, 80_000, SENSOR)
    words = write_evt21(events).words
    data = {"little": words, "legacy": legacy(words), "big": words.byteswap()}[sent].tobytes()
    line = f"% endianness {named}\n".encode() if named else b""
    assert_same(read(open_source(put(tmp_path, "a.raw", HEADER_EVT21 + line + data))), events)
    if named:
        header = f"% format EVT21;height=48;width=64;endianness={named}\n% end\n".encode()
        assert_same(read(open_source(put(tmp_path, "b.raw", header + data))), events)


def test_the_example_of_the_specification_in_both_orders():
    assert swapped(np.array([0x0102_0304_0506_0708], np.uint64)).tobytes().hex() == "0403020108070605"
    assert is_legacy(np.array([0x0102_0304_0506_0708], np.uint64)) is None
    assert is_legacy(np.empty(0, np.uint64)) is None


@both
def test_triggers_are_found_with_their_time_channel_and_level(name, tmp_path):
    time_high, trigger = (TIME_HIGH, TRIGGER) if name == "EVT21" else (0xE, 9)
    upper = [
        trigger << 28 | 1,
        time_high << 28 | 2,
        trigger << 28 | 3 << 22 | 5 << 8 | 1,
        trigger << 28 | 4 << 22 | 5 << 8,
    ]
    words = np.array([word << 32 for word in upper] if name == "EVT21" else upper, FORMATS[name].dtype)
    recording = open_source(put(tmp_path, "a.raw", HEADERS[name] + words.tobytes()))
    assert [column.tolist() for column in all_triggers(recording)] == [[131, 132], [5, 5], [1, 0]]


def test_the_mask_of_an_evt4_vector_is_no_trigger(tmp_path):
    words = np.array([0xE000_0002, 0xC << 28 | cd(3, 1, 1), 0x9000_0001, 0x9000_0001], np.uint32)
    recording = open_source(put(tmp_path, "a.raw", HEADER_EVT4 + words.tobytes()))
    assert all_triggers(recording).t.tolist() == [128]
    assert read(recording).n == 3  # the bits of the mask


@both
def test_reserved_words_are_skipped_and_counted_and_truncation_is_said(name, tmp_path):
    events = make_events(50, seed=2)
    words = WRITE[name](events).words
    bad = np.array([3 << (60 if name == "EVT21" else 28)], words.dtype)
    data = HEADERS[name] + np.concatenate([words, bad, bad]).tobytes()
    recording = open_source(put(tmp_path, "a.raw", data))
    assert_same(read(recording), events)
    (fault,) = recording.faults.found
    assert (fault.reason, fault.count, fault.where) == ("reserved_word", 2, f"byte {len(data) - 2 * words.itemsize}")
    got, error = read_broken(open_source(put(tmp_path, "b.raw", data[: -2 * words.itemsize - 1])))
    assert got.n == events.n - 1
    assert error is not None
    assert "ends within a word" in error.message


def test_an_evt4_file_that_ends_within_a_vector_says_so(tmp_path):
    words = np.array([0xE000_0002, 0xA << 28 | cd(3, 1, 1), 0xC << 28 | cd(3, 1, 1)], np.uint32)
    recording = open_source(put(tmp_path, "a.raw", HEADER_EVT4 + words.tobytes()))
    assert read(recording).n == 1
    assert [fault.why for fault in recording.faults.unread] == ["the file ends within a vector"]


# --- bags ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("ros", [1, 2])
@pytest.mark.parametrize(("name", "order"), [*((name, "little") for name in WRITE), ("EVT21", "legacy")])
def test_messages_of_every_word_format_are_read_from_bags(name, order, ros, tmp_path):
    events = in_rows(900, 7, 3_000_000, 200_000, SENSOR)
    store, messages, before = ros_bags.Store(ros), [], 0
    words = WRITE[name](events).words
    for seq, part in enumerate(np.array_split(words, 9)):
        data = (legacy(part) if order == "legacy" else part).tobytes()
        ns = 1_700_000_000 * 10**9 + seq * 20_000_000
        messages.append(("/cam/events", ns, ros_bags.packet(store, data, ns=ns, seq=seq, encoding=name.lower())))
        before += part.size
    recording = open_source(str(ros_bags.write_bag(tmp_path / "a.bag", store, messages)))
    assert_same(read(recording), events)
    assert "triggers" in recording.streams
    assert bool(list(recording.triggers())) == (name == "EVT3")  # the writer of EVT3 adds triggers
    t_us = int(events.t[events.n // 2])
    assert_same(Events.join(list(recording.since(t_us))), events.span(int(events.t.searchsorted(t_us)), events.n))
    assert recording.faults.found == ()


def test_a_lost_message_of_evt4_costs_itself_and_the_time_goes_on(tmp_path):
    t = np.arange(0, 1_000_000, 500)
    events = Events.from_columns(t, t % 60, t % 48, t % 2)
    store, messages = ros_bags.Store(2), []
    for seq in range(10):
        part = events.span(seq * 200, seq * 200 + 200)
        ns = 1_700_000_000 * 10**9 + int(part.t[0]) * 1000
        data = write_evt4(part).words.tobytes()
        messages.append(("/cam/events", ns, ros_bags.packet(store, data, ns=ns, seq=seq, encoding="evt4")))
    del messages[4]
    recording = open_source(str(ros_bags.write_bag(tmp_path / "a", store, messages)))
    want = Events(*(np.delete(column, np.arange(800, 1000)) for column in events))
    assert_same(read(recording), want)
