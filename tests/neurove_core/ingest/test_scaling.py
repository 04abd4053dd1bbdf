"""Counting by the factors of a table equals counting by the table, bit for bit; other tables have no factors."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from neurove_core.config import CanonicalConfig
from neurove_core.geometry.camera import lookup_table
from neurove_core.ingest.counting import count_events, count_events_reference
from neurove_core.ingest.scaling import NO_SCALE, Scale, scale_of, scaled
from neurove_core.ingest.wire import count_wire, read_packet
from neurove_protocol import Events, Sensor
from neurove_protocol.events import encode_packet
from tests.builders import make_packet

BINS, BIN_US = 3, 1_000
SIZES = st.integers(8, 1_000)


def events_on(sensor: Sensor, n: int, seed: int) -> Events:
    rng = np.random.default_rng(seed)
    t = np.sort(rng.integers(0, BINS * BIN_US, n))
    x, y = rng.integers(0, sensor.width, n), rng.integers(0, sensor.height, n)
    return Events.from_columns(t, x, y, rng.integers(0, 2, n))


@given(width=SIZES, height=SIZES, columns=SIZES, rows=SIZES)
def test_the_factors_of_a_table_give_the_table_wherever_it_has_some(width, height, columns, rows):
    table = lookup_table(CanonicalConfig(width=columns, height=rows), Sensor(width, height), None)
    scale = scale_of(table, columns)
    if scale != NO_SCALE:
        np.testing.assert_array_equal(scaled(table.shape, scale), table)


@pytest.mark.parametrize("sensor", [Sensor(346, 260), Sensor(640, 480), Sensor(1280, 720)])
@pytest.mark.parametrize("grid", [(86, 65), (173, 130), (346, 260), (320, 180)])
def test_usual_sensors_have_factors_for_usual_grids(sensor, grid):
    table = lookup_table(CanonicalConfig(width=grid[0], height=grid[1]), sensor, None)
    scale = scale_of(table, grid[0])
    assert scale != NO_SCALE
    np.testing.assert_array_equal(scaled(table.shape, scale), table)


@pytest.mark.parametrize("n", [0, 1, 3, 511, 512, 513, 20_000])
@pytest.mark.parametrize("fill", [0, 250])
def test_counts_by_factors_equal_those_of_the_reference(n, fill):
    sensor, grid = Sensor(64, 48), CanonicalConfig(width=16, height=12)
    events, table = events_on(sensor, n, seed=n), lookup_table(grid, sensor, None)
    assert scale_of(table, grid.width) == Scale(1 << 18, 1 << 18, 16)
    counts, expected = (np.full((2 * BINS, 12, 16), fill, np.uint8) for _ in range(2))
    assert count_events(events, 0, BIN_US, table, counts) == 0
    count_events_reference(events, 0, BIN_US, table, expected)
    np.testing.assert_array_equal(counts, expected)


@pytest.mark.parametrize(
    ("sensor", "grid"),
    [((346, 260), (346, 260)), ((346, 260), (86, 65)), ((1280, 720), (320, 180)), ((2048, 1536), (1000, 700))],
)
def test_counts_at_the_far_corner_of_a_large_sensor_equal_those_of_the_reference(sensor, grid):
    width, height = sensor
    at = np.arange(600)
    corner = Events.from_columns(at, width - 1 - at % 40, height - 1 - at % 30, at % 3)  # 2 is ON too
    table = lookup_table(CanonicalConfig(width=grid[0], height=grid[1]), Sensor(*sensor), None)
    assert scale_of(table, grid[0]) != NO_SCALE
    counts, expected = (np.zeros((2, grid[1], grid[0]), np.uint8) for _ in range(2))
    assert count_events(corner, 0, 600, table, counts) == 0
    count_events_reference(corner, 0, 600, table, expected)
    np.testing.assert_array_equal(counts, expected)


def test_counts_of_a_packet_by_factors_equal_those_of_its_columns():
    packet = make_packet(n=3_000)
    table = lookup_table(CanonicalConfig(width=16, height=12), packet.sensor, None)
    assert scale_of(table, 16) != NO_SCALE
    bin_us = int(packet.events.t[-1]) // BINS + 1
    counts, expected = (np.zeros((2 * BINS, 12, 16), np.uint8) for _ in range(2))
    assert count_wire(read_packet(encode_packet(packet)).events, 0, bin_us, table, counts) == 0
    count_events_reference(packet.events, 0, bin_us, table, expected)
    np.testing.assert_array_equal(counts, expected)


def read_only(table: np.ndarray) -> np.ndarray:
    table.setflags(write=False)
    return table


@pytest.mark.parametrize(
    "table",
    [
        np.arange(12, dtype=np.int32).reshape(3, 4)[:, ::-1].copy(),
        np.array([[0, 1], [4, 6]], np.int32),
        np.array([[0, 1], [4, -1]], np.int32),
        np.array([[-1, -1], [-1, -1]], np.int32),
        np.array([[1, 2], [5, 6]], np.int32),
        np.empty((0, 0), np.int32),
    ],
)
def test_a_table_that_does_not_only_scale_has_no_factors(table):
    assert scale_of(read_only(table), 4) == NO_SCALE


def test_a_table_that_may_still_change_has_no_factors():
    assert scale_of(np.arange(12, dtype=np.int32).reshape(3, 4), 4) == NO_SCALE


def test_a_new_table_in_the_memory_of_an_old_one_is_examined_again():
    for turn in range(50):
        table = read_only(np.arange(12, dtype=np.int32).reshape(3, 4) if turn % 2 else np.full((3, 4), 7, np.int32))
        assert (scale_of(table, 4) != NO_SCALE) == bool(turn % 2)
        del table
