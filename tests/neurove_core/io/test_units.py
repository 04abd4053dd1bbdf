"""Units of time: implausible ones are refused with a guess, and the caller's unit decides."""

from pathlib import Path

import h5py
import numpy as np
import pytest

from neurove_core.io import DoubtfulUnit, TimeSample
from neurove_core.io.units import UNITS, doubt, guess, scaled
from neurove_core.sources import open_source
from neurove_protocol import Sensor
from neurove_protocol.errors import InvalidField
from tests.neurove_core.io.test_evbench import put_mat
from tests.recordings import put, read, shared

N = 3000
I = np.arange(N)  # noqa: E741  # three seconds, one event each millisecond
DAY_NS = 1_564_587_893_000_000_000


def dsec(path: Path, t: np.ndarray) -> str:
    with h5py.File(path, "w") as file:
        for name, column in (("x", I % 240), ("y", I % 180), ("p", I % 2), ("t", t)):
            file[f"events/{name}"] = column if name == "t" else column.astype("u2")
    return str(path)


def mvsec(path: Path, t: np.ndarray) -> str:
    with h5py.File(path, "w") as file:
        file["davis/left/events"] = np.stack([I % 240, I % 180, t, 2 * (I % 2) - 1], 1).astype("f8")
    return str(path)


@pytest.mark.parametrize(
    ("write", "t", "unit"),
    [
        (dsec, I / 1000, "s"),
        (dsec, DAY_NS + I * 1_000_000, "ns"),
        (mvsec, I * 1000, "us"),
        (mvsec, DAY_NS + I * 1_000_000, "ns"),
    ],
)
def test_times_in_another_unit_are_refused_with_a_guess_and_the_guess_is_right(write, t, unit, tmp_path):
    path = write(tmp_path / "a.h5", t)
    with pytest.raises(DoubtfulUnit, match=f"give --time-unit {unit}") as caught:
        open_source(path)
    assert caught.value.details["guess"] == unit
    events = read(open_source(path, time_unit=unit))
    assert events.n == N
    np.testing.assert_allclose(np.diff(events.t), 1000, atol=1)
    assert events.t[0] == (DAY_NS // 1000 if unit == "ns" else 0)


@pytest.mark.parametrize(("write", "unit"), [(dsec, "us"), (mvsec, "s")])
def test_the_unit_of_the_layout_is_accepted_if_the_caller_gives_it(write, unit, tmp_path):
    path = write(tmp_path / "a.h5", I * 10_000_000)
    with pytest.raises(DoubtfulUnit):
        open_source(path)
    assert read(open_source(path, time_unit=unit)).t[1] == 10_000_000 * UNITS[unit]


def test_an_offset_has_the_unit_of_the_times(tmp_path):
    path = dsec(tmp_path / "a.h5", I * 1_000_000)
    with h5py.File(path, "r+") as file:
        file["t_offset"] = 5_000_000_000
    recording = open_source(path, time_unit="ns")
    assert read(recording).t[0] == 5_000_000
    assert sum(chunk.n for chunk in recording.since(6_000_000)) == 2000


def test_a_text_in_nanoseconds_is_doubted_and_read(tmp_path):
    lines = "".join(f"{DAY_NS + i * 1_000_000} {i % 64} {i % 48} {i % 2}\n" for i in range(100))
    path = put(tmp_path, "a.txt", lines.encode())
    with pytest.raises(DoubtfulUnit, match="give --time-unit ns"):
        open_source(path, Sensor(64, 48))
    assert np.diff(read(open_source(path, Sensor(64, 48), time_unit="ns")).t).tolist() == [1000] * 99


def test_a_mat_file_in_another_unit_is_read(tmp_path):
    path = put_mat(tmp_path)
    assert read(open_source(path, time_unit="ms")).t[-1] == 1000 * read(open_source(path)).t[-1]


@pytest.mark.parametrize("unit", ["s", "minutes"])
def test_a_format_that_fixes_its_unit_allows_no_other(unit, tmp_path):
    with pytest.raises(InvalidField, match="time_unit"):
        open_source("pattern://", time_unit=unit)


def test_a_gap_of_years_does_not_make_the_unit_doubtful(tmp_path):
    lines = "0.0 1 1 1\n" + "".join(f"{1564587893 + i / 1000:.6f} {i % 64} {i % 48} 1\n" for i in range(1000))
    recording = open_source(put(tmp_path, "a.txt", lines.encode()), Sensor(64, 48))
    assert read(recording).n == 1001
    assert [fault.reason for fault in recording.faults.found] == ["gap"]


@pytest.mark.parametrize("path", ["ecd/shapes_rotation", "slider_depth/events_chunk.txt", "evbench"])
def test_the_times_of_real_recordings_are_plausible(path):
    place = shared(path)
    source = next(place.glob("*.mat")) if path == "evbench" else place
    assert read(open_source(str(source))).n


@pytest.mark.parametrize("times", [[], [np.nan] * 20, [5], [7] * 100, list(range(3))])
def test_few_or_equal_times_are_not_doubted(times):
    for unit in UNITS:
        sample = TimeSample(Path("a"), np.array(times, np.float64), unit, 0)
        assert not doubt(sample, unit)
        assert guess(sample) in (None, *UNITS)


def test_whole_numbers_keep_their_digits():
    t = np.array([DAY_NS + 1_999, DAY_NS + 2_000])
    assert scaled(t, "ns").tolist() == [DAY_NS // 1000 + 1, DAY_NS // 1000 + 2]
    assert scaled(np.array([3]), "ms", "s").tolist() == [0]
    assert scaled(np.array([3_000]), "ms").tolist() == [3_000_000]
