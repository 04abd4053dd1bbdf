"""The compiled counting kernel equals its reference implementation, bit for bit."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from neurove_core.geometry.camera import OUTSIDE
from neurove_core.ingest.counting import count_events, count_events_reference
from neurove_protocol import Events
from tests.builders import SENSOR, make_events

BINS, BIN_US, HEIGHT, WIDTH = 3, 1_000, 6, 7


def random_lut(seed: int) -> np.ndarray:
    return np.random.default_rng(seed).integers(OUTSIDE, HEIGHT * WIDTH, (SENSOR.height, SENSOR.width), np.int32)


def counts_of(count, events: Events, start_us: int, lut: np.ndarray, fill: int = 0) -> tuple[int, np.ndarray]:
    counts = np.full((2 * BINS, HEIGHT, WIDTH), fill, np.uint8)
    return count(events, start_us, BIN_US, lut, counts), counts


def assert_agree(events: Events, start_us: int, lut: np.ndarray, fill: int = 0) -> tuple[int, np.ndarray]:
    outside, counts = counts_of(count_events, events, start_us, lut, fill)
    expected_outside, expected = counts_of(count_events_reference, events, start_us, lut, fill)
    np.testing.assert_array_equal(counts, expected)
    assert outside == expected_outside
    return outside, counts


@given(seed=st.integers(0, 2**32), n=st.integers(0, 3_000), start_us=st.integers(-(1 << 60), 1 << 60))
def test_the_compiled_kernel_counts_as_the_reference_does(seed, n, start_us):
    events = make_events(n, seed=seed, start_us=start_us, duration_us=BINS * BIN_US)
    assert_agree(events, start_us, random_lut(seed))


@pytest.mark.parametrize("fill", [0, 200, 254, 255])
def test_both_saturate_at_255_and_never_wrap_around(fill):
    lut = np.zeros((SENSOR.height, SENSOR.width), np.int32)  # every pixel maps to one cell
    _, counts = assert_agree(make_events(4_000, duration_us=BINS * BIN_US), 0, lut, fill)
    assert (counts[:, 0, 0] == 255).all()
    assert (counts.reshape(2 * BINS, -1)[:, 1:] == fill).all()


@pytest.mark.parametrize(("n", "expected"), [(254, 254), (255, 255), (256, 255), (257, 255)])
def test_a_cell_counts_exactly_up_to_255(n, expected):
    events = Events.from_columns([5] * n, [0] * n, [0] * n, [1] * n)
    _, counts = assert_agree(events, 0, np.zeros((SENSOR.height, SENSOR.width), np.int32))
    assert int(counts[1, 0, 0]) == int(counts.sum()) == expected


def test_an_event_without_a_cell_is_counted_as_outside_and_changes_nothing():
    blind = np.full((SENSOR.height, SENSOR.width), OUTSIDE, np.int32)
    outside, counts = assert_agree(make_events(500, duration_us=BINS * BIN_US), 0, blind)
    assert outside == 500
    assert not counts.any()


def test_any_polarity_above_zero_is_on():
    events = Events.from_columns([0, 0, 0], [0, 0, 0], [0, 0, 0], [0, 1, 255])
    _, counts = assert_agree(events, 0, np.zeros((SENSOR.height, SENSOR.width), np.int32))
    assert counts[:2, 0, 0].tolist() == [1, 2]


def test_counts_add_up_over_calls():
    events, lut = make_events(600, duration_us=BINS * BIN_US), random_lut(1)
    together, parts = np.zeros((2 * BINS, HEIGHT, WIDTH), np.uint8), np.zeros((2 * BINS, HEIGHT, WIDTH), np.uint8)
    outside = count_events(events, 0, BIN_US, lut, together)
    outside_parts = sum(count_events(events.span(i, i + 100), 0, BIN_US, lut, parts) for i in range(0, 600, 100))
    np.testing.assert_array_equal(parts, together)
    assert outside_parts == outside


@pytest.mark.parametrize("read_only", ["", "t", "x", "y", "p", "txyp"])
def test_columns_may_be_read_only_views(read_only):
    events, lut = make_events(300, duration_us=BINS * BIN_US), random_lut(2)
    expected = counts_of(count_events_reference, events, 0, lut)
    for name in read_only:
        getattr(events, name).flags.writeable = False
    outside, counts = counts_of(count_events, events, 0, lut)
    assert outside == expected[0]
    np.testing.assert_array_equal(counts, expected[1])
