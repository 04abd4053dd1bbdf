"""HDF5 recordings in all layouts: MVSEC, DSEC, M3ED and files of `write_dsec`. The tests write the files."""

import re
import sys
import tracemalloc
from pathlib import Path

import h5py
import hdf5plugin
import numpy as np
import pytest

from neurove_core.extras import MissingExtra
from neurove_core.io import BrokenRecording, UnknownSource
from neurove_core.io.formats.hdf5 import file as hdf5
from neurove_core.io.recording import CHUNK_EVENTS
from neurove_core.sources import open_source
from neurove_protocol import Events, NeuroVEError
from neurove_protocol.events import check_events
from tests.builders import SENSOR, make_events
from tests.datasets import (
    CHUNK,
    DAY_US,
    EVENTS,
    LATE,
    corrupt_chunk,
    dsec_file,
    m3ed_file,
    make_poses,
    mvsec_file,
    own_file,
    write_m3ed,
    write_mvsec,
)
from tests.recordings import assert_same, read, read_broken


def without(events: Events, first: int, stop: int) -> Events:
    return Events(*(np.delete(column, slice(first, stop)) for column in events))


def unread(path: Path) -> str:
    """Why no event of a file can be read."""
    recording = open_source(str(path))
    assert read(recording).n == 0
    (fault,) = recording.faults.unread
    return f"{fault.where}: {fault.why}"


each_layout = pytest.mark.parametrize("written", [mvsec_file, dsec_file, m3ed_file, own_file])


@each_layout
def test_a_file_in_each_layout_gives_the_same_events_on_every_read(written, tmp_path):
    recording = open_source(written(tmp_path), SENSOR)
    want = EVENTS if written is m3ed_file else LATE
    assert_same(read(recording), want)
    assert_same(read(recording), want)
    assert recording.sensor == SENSOR
    assert not recording.endless
    assert "events" in recording.streams


@each_layout
@pytest.mark.parametrize("seed", range(3))
def test_since_gives_all_events_from_a_time_on_and_no_earlier_ones(written, seed, tmp_path):
    recording = open_source(written(tmp_path), SENSOR)
    events = EVENTS if written is m3ed_file else LATE
    rng = np.random.default_rng(seed)
    times = rng.integers(events.t[0] - 2000, events.t[-1] + 2000, 20).tolist()
    grid = [int(t) // 1000 * 1000 for t in times[:5]]
    for t_us in [*times, *grid, int(events.t[0]), int(events.t[-1]), int(events.t[-1]) + 1, -5, int(events.t[500])]:
        first = int(np.searchsorted(events.t, t_us))
        assert_same(Events.join(list(recording.since(t_us))), events.span(first, events.n))


@pytest.mark.parametrize(("written", "name"), [(dsec_file, "events/x"), (m3ed_file, "prophesee/left/x")])
def test_since_does_not_read_earlier_events(written, name, tmp_path):
    """The earlier events are unreadable."""
    path = Path(written(tmp_path))
    with h5py.File(path) as file:
        corrupt_chunk(path, file[name], 0)
    recording = open_source(str(path), SENSOR)
    events = EVENTS if written is m3ed_file else LATE
    assert read_broken(recording)[0].t[0] == events.t[CHUNK]
    assert_same(Events.join(list(recording.since(int(events.t[700])))), events.span(700, 1000))


@each_layout
def test_a_wrong_millisecond_index_loses_no_events(written, tmp_path):
    path = written(tmp_path)
    with h5py.File(path, "r+") as file:
        for name in ("ms_to_idx", "prophesee/left/ms_map_idx"):
            if name in file:
                file[name][...] = np.minimum(np.arange(file[name].size) * 7 % 1300, 2**40)
    events = EVENTS if written is m3ed_file else LATE
    recording = open_source(path, SENSOR)
    for i in (1, 400, 999):
        assert_same(Events.join(list(recording.since(int(events.t[i]) + 1))), events.span(i + 1, 1000))


@each_layout
@pytest.mark.parametrize("seed", range(2))
def test_a_truncated_file_is_refused_with_the_byte_where_it_ends(written, seed, tmp_path):
    data = Path(written(tmp_path)).read_bytes()
    truncated = tmp_path / "truncated.h5"
    for size in np.random.default_rng(seed).integers(200, len(data), 10).tolist():
        truncated.write_bytes(data[:size])
        with pytest.raises(BrokenRecording) as caught:
            open_source(str(truncated), SENSOR)
        assert caught.value.details["where"] == f"byte {size}"
        assert str(len(data)) in caught.value.message


@each_layout
@pytest.mark.parametrize("seed", range(2))
def test_a_corrupt_file_is_refused_with_our_error_or_read_without_an_invalid_event(written, seed, tmp_path):
    data = Path(written(tmp_path)).read_bytes()
    rng = np.random.default_rng(seed)
    for i in range(40):
        bad = bytearray(data)
        for at in rng.integers(0, len(data) if i % 2 else min(len(data), 8000), 8):
            bad[at] = rng.integers(0, 256)
        path = tmp_path / "corrupt.h5"
        path.write_bytes(bad)
        try:
            recording = open_source(str(path), SENSOR)
            events, _ = read_broken(recording)
            check_events(events, SENSOR)
            assert not (events.p > 1).any()
            list(recording.since(int(LATE.t[500])))
            list(recording.imu())
            recording.twists()
        except NeuroVEError as error:
            assert str(tmp_path) in error.message  # noqa: PT017 the file may also be readable


@pytest.mark.parametrize(
    ("column", "value", "why"),
    [
        ("x", 64, "x=64 y=.* lies outside the sensor 64x48"),
        ("y", 48, "y=48 lies outside the sensor 64x48"),
        ("x", -1, "x=-1"),
        ("t", 3, "time runs backwards"),
        ("t", np.nan, "t=nan is not a valid time"),
        ("t", np.inf, "t=inf is not a valid time"),
        ("t", -1e300, "is not a valid time"),
        ("p", 7, "the polarity p=7"),
    ],
)
@pytest.mark.parametrize("written", [mvsec_file, dsec_file, m3ed_file])
def test_an_invalid_event_is_skipped_and_named_by_its_row(written, column, value, why, tmp_path):
    path, row = written(tmp_path), 537
    with h5py.File(path, "r+") as file:
        if written is mvsec_file:
            file["davis/left/events"][row, "xytp".index(column)] = value
        else:
            group = file["events" if written is dsec_file else "prophesee/left"]
            rows = group[column][()].astype("f8" if isinstance(value, float) else "i8")
            rows[row] = value
            del group[column]
            group[column] = rows
    events, error = read_broken(open_source(path, SENSOR))
    assert_same(events, without(EVENTS if written is m3ed_file else LATE, row, row + 1))
    assert error is not None
    assert str(error.details["where"]).startswith(f"row {row} of ")
    assert re.search(why, error.message)


@pytest.mark.parametrize(("written", "name"), [(dsec_file, "events/y"), (m3ed_file, "prophesee/left/y")])
def test_an_unreadable_chunk_is_skipped_and_named_by_its_first_row(written, name, tmp_path):
    path = Path(written(tmp_path))
    with h5py.File(path) as file:
        corrupt_chunk(path, file[name], 4)
    events, error = read_broken(open_source(str(path), SENSOR))
    assert_same(events, without(EVENTS if written is m3ed_file else LATE, 4 * CHUNK, 5 * CHUNK))
    assert error is not None
    assert str(error.details["where"]).startswith(f"row {4 * CHUNK} of ")


def test_columns_of_unequal_length_give_their_common_rows_and_then_an_error(tmp_path):
    path = dsec_file(tmp_path)
    with h5py.File(path, "r+") as file:
        y = file["events/y"][:900]
        del file["events/y"]
        file["events/y"] = y
    events, error = read_broken(open_source(path, SENSOR))
    assert_same(events, LATE.span(0, 900))
    assert error is not None
    assert "unequal lengths" in error.message
    assert "row 900 of events" in error.message


def test_a_table_of_another_shape_or_type_is_refused_by_name(tmp_path):
    with h5py.File(tmp_path / "a.hdf5", "w") as file:
        file["davis/left/events"] = np.zeros((5, 3))
    assert "expected numbers of shape (N, 4)" in unread(tmp_path / "a.hdf5")
    for rows in ([b"one", b"two"], np.zeros(2, np.longdouble), np.zeros(2, np.float16)):
        with h5py.File(tmp_path / "b.h5", "w") as file:
            for name in "pxyt":
                file[f"events/{name}"] = rows
        assert "expected numbers of shape" in unread(tmp_path / "b.h5")


def test_rows_that_were_never_written_are_refused(tmp_path):
    with h5py.File(tmp_path / "a.h5", "w") as file:
        for name in "pxyt":
            file.create_dataset(f"events/{name}", (1 << 60,), "u2", chunks=(1000,))
    assert "1152921504606846976 rows were never written" in unread(tmp_path / "a.h5")


def test_too_large_chunks_are_refused_before_decompression(tmp_path):
    with h5py.File(tmp_path / "a.h5", "w") as file:
        for name in "pxyt":
            file.create_dataset(f"events/{name}", (10,), "i8", maxshape=(None,), chunks=(9_000_000,), compression=1)
    assert "chunks of 72000000 bytes; at most 67108864" in unread(tmp_path / "a.h5")


def test_a_long_file_is_read_in_bounded_chunks_and_memory(tmp_path):
    events = make_events(1_000_000, seed=2, start_us=5, duration_us=3_000_000)
    path = tmp_path / "long_data.hdf5"
    with h5py.File(path, "w") as file:
        rows = np.stack([events.x, events.y, events.t / 1e6, events.p * 2.0 - 1], axis=1)
        file.create_dataset("davis/left/events", data=rows, chunks=(16_384, 4))
    del rows
    recording = open_source(str(path), SENSOR)
    tracemalloc.start()
    sizes = [chunk.n for chunk in recording.chunks()]
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert max(sizes) <= CHUNK_EVENTS
    assert sum(sizes) == events.n
    assert peak < 64 << 20
    assert_same(read(recording), events)


def test_an_empty_data_set_has_no_events(tmp_path):
    with h5py.File(tmp_path / "a.h5", "w") as file:
        for name in "pxyt":
            file.create_dataset(f"events/{name}", (0,), "i8")
        file["ms_to_idx"] = np.empty(0, "u8")
    recording = open_source(str(tmp_path / "a.h5"))
    assert read(recording).n == 0
    assert list(recording.since(5)) == []
    assert list(recording.imu()) == []
    assert recording.poses() is None
    assert recording.twists() is None


def test_a_file_with_another_compression_is_read(tmp_path):
    path = write_mvsec(tmp_path, LATE, compression=hdf5plugin.Zstd())
    assert_same(read(open_source(path, SENSOR)), LATE)


# --- choice of layout and stream --------------------------------------------------------------------------------------


def test_the_error_for_an_unknown_layout_lists_the_known_ones(tmp_path):
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["something"] = 1
    with pytest.raises(UnknownSource) as caught:
        open_source(str(tmp_path / "a.h5"))
    for name in ("davis/left/events", "events/p, x, y, t", "prophesee/left"):
        assert name in caught.value.message


def test_the_error_for_a_file_without_events_says_that_it_has_poses(tmp_path):
    write_mvsec(tmp_path, LATE, poses=make_poses())
    with pytest.raises(UnknownSource, match="no events.*it has poses: davis/left/odometry"):
        open_source(str(tmp_path / "indoor_flying1_gt.hdf5"))


@pytest.mark.parametrize("data", [b"", b"no HDF5 at all", b"PK\x03\x04"])
def test_a_file_that_is_not_hdf5_is_refused(data, tmp_path):
    (tmp_path / "a.hdf5").write_bytes(data)
    with pytest.raises(UnknownSource, match="does not start with the HDF5 signature"):
        open_source(str(tmp_path / "a.hdf5"))


def test_a_topic_selects_one_of_several_cameras(tmp_path):
    right = make_events(50, seed=9, start_us=DAY_US)
    path = write_mvsec(tmp_path, LATE, right=right)
    assert_same(read(open_source(path, SENSOR, "davis/right")), right)
    assert_same(read(open_source(path, SENSOR, topic="/davis/left")), LATE)
    assert open_source(path, topic="davis/right").name == "indoor_flying1_data.hdf5 (davis/right)"
    with pytest.raises(UnknownSource, match="no event stream 'davis/up'; it has davis/left, davis/right"):
        open_source(path, topic="davis/up")
    m3ed = write_m3ed(tmp_path, EVENTS)
    with pytest.raises(UnknownSource, match="no event stream 'prophesee/right'; it has prophesee/left"):
        open_source(m3ed, topic="prophesee/right")


def test_the_right_camera_is_read_if_the_file_has_no_left_one(tmp_path):
    path = write_mvsec(tmp_path, LATE)
    with h5py.File(path, "r+") as file:
        file.move("davis/left", "davis/right")
    assert_same(read(open_source(path, SENSOR)), LATE)


@pytest.mark.parametrize("source", ["pattern://", "events.txt", "events.h5"])
def test_a_source_with_one_event_stream_refuses_a_topic(source, tmp_path):
    dsec_file(tmp_path)
    (tmp_path / "events.txt").write_text("0.1 1 2 1\n")
    with pytest.raises(UnknownSource, match="one event stream and no topic 'left'"):
        open_source(source if "://" in source else str(tmp_path / source), topic="left")


def test_the_error_without_h5py_says_how_to_install_it(tmp_path, monkeypatch):
    path = dsec_file(tmp_path)
    monkeypatch.setitem(sys.modules, "h5py", None)
    with pytest.raises(MissingExtra, match=r"h5py is not installed: pip install 'neurove\[recordings\]'"):
        open_source(path)
    with pytest.raises(MissingExtra):
        hdf5.library()
