"""DSEC's layout: files of the data set, and files of `write_dsec`."""

import itertools
from pathlib import Path

import h5py
import numpy as np
import pytest

from neurove_core.geometry.motion import Twists
from neurove_core.io import BrokenRecording, EventsOnly
from neurove_core.io.formats.hdf5.dsec_write import MAX_SPAN_S, write_dsec
from neurove_core.io.formats.pose_files import read_poses
from neurove_core.sources import open_source
from neurove_protocol import Events, Sensor
from neurove_protocol.errors import InvalidField
from tests.builders import SENSOR, make_events
from tests.datasets import DAY_US, EVENTS, LATE, make_imu, make_poses, write_dsec_file, write_mvsec
from tests.recordings import all_samples, assert_same, read, read_broken, shared


def test_dsec_is_640x480_and_its_time_offset_is_optional(tmp_path):
    recording = open_source(write_dsec_file(tmp_path / "events.h5", EVENTS))
    assert recording.sensor == Sensor(640, 480)
    assert_same(read(recording), EVENTS)
    assert recording.camera("cam0") is None


def test_the_error_for_a_larger_sensor_in_dsecs_layout_asks_for_its_size(tmp_path):
    """TUM-VIE has such files."""
    events = make_events(100, seed=4, sensor=Sensor(1280, 720))
    path = write_dsec_file(tmp_path / "events.h5", events)
    _, error = read_broken(open_source(path))
    assert error is not None
    assert "lies outside the sensor 640x480, which is DSEC's" in error.message
    assert "--sensor WIDTHxHEIGHT" in error.message
    assert_same(read(open_source(path, Sensor(1280, 720))), events)


def test_since_works_without_dsecs_index(tmp_path):
    recording = open_source(write_dsec_file(tmp_path / "events.h5", LATE, offset_us=DAY_US, index=False))
    assert_same(Events.join(list(recording.since(int(LATE.t[600]) + 1))), LATE.span(601, 1000))


@pytest.mark.parametrize("offset", [2**63, [1, 2], b"soon"])
def test_an_invalid_time_offset_is_refused_by_name(offset, tmp_path):
    path = write_dsec_file(tmp_path / "events.h5", EVENTS)
    with h5py.File(path, "r+") as file:
        file["t_offset"] = np.array(offset, "u8") if isinstance(offset, int) else offset
    with pytest.raises(BrokenRecording, match="t_offset"):
        open_source(path)


def test_a_written_recording_is_read_back_with_all_streams_of_its_source(tmp_path):
    poses, imu = make_poses(start_us=DAY_US), make_imu(start_us=DAY_US)
    images = np.zeros((4, 260, 346), np.uint8)
    source = open_source(write_mvsec(tmp_path, LATE, imu=imu, poses=poses, images=images))
    progress: list[int] = []
    written = write_dsec(source, tmp_path / "out.h5", progress.append)
    assert written == (LATE.n, ("events", "poses", "twists", "imu"), ("frames",))
    assert progress == [LATE.n]
    copy = open_source(str(tmp_path / "out.h5"))
    assert copy.sensor == source.sensor
    assert copy.camera("cam0") == source.camera("cam0")
    assert_same(read(copy), read(source))
    assert set(copy.streams) == {"events", "imu", "poses", "twists"}
    for a, b in zip(all_samples(copy), all_samples(source), strict=True):
        np.testing.assert_array_equal(a, b)
    for mine, theirs in ((copy.poses(), source.poses()), (copy.twists(), source.twists())):
        assert mine is not None
        assert theirs is not None
        for a, b in zip(mine, theirs, strict=True):
            np.testing.assert_allclose(a, b, rtol=0, atol=1e-15)
    assert read_poses(tmp_path / "out.h5").t.tolist() == poses.t.tolist()


def test_the_written_index_matches_dsecs_own_example(tmp_path):
    t = [0, 500, 2100, 5000, 5000, 7100, 7200, 7200, 8100, 9000]
    write_dsec(Given([Events.from_columns(np.array(t) + 77, [1] * 10, [2] * 10, [1] * 10)]), tmp_path / "a.h5")
    with h5py.File(tmp_path / "a.h5") as file:
        assert file["ms_to_idx"][()].tolist() == [0, 2, 2, 3, 3, 3, 5, 5, 8, 9]
        assert file["t_offset"][()] == 77
        assert file["events/t"][()].tolist() == t
        assert {name: file[f"events/{name}"].dtype.str for name in "pxy"} == {"p": "|u1", "x": "<u2", "y": "<u2"}


@pytest.mark.parametrize("seed", range(3))
def test_the_written_file_does_not_depend_on_the_chunks_of_its_source(seed, tmp_path):
    events = make_events(3000, seed=seed, start_us=123, duration_us=50_000)
    bounds = [0, *sorted(np.random.default_rng(seed).choice(np.arange(1, 3000), 20, replace=False).tolist()), 3000]
    write_dsec(Given([events]), tmp_path / "one.h5")
    write_dsec(Given([events.span(a, b) for a, b in itertools.pairwise(bounds)]), tmp_path / "many.h5")
    with h5py.File(tmp_path / "one.h5") as one, h5py.File(tmp_path / "many.h5") as many:
        np.testing.assert_array_equal(one["ms_to_idx"], many["ms_to_idx"])
        t = one["events/t"][()]
        for ms, entry in enumerate(one["ms_to_idx"][()].tolist()):
            assert t[entry] >= ms * 1000
            assert entry == 0 or t[entry - 1] < ms * 1000
    assert_same(read(open_source(str(tmp_path / "many.h5"))), events)


class Given(EventsOnly):
    """A recording of these chunks, followed by an error if one is given."""

    name, sensor, endless = "given", SENSOR, False

    def __init__(self, parts: list[Events], error: Exception | None = None) -> None:
        self.parts, self.error = parts, error

    def chunks(self):
        yield from self.parts
        if self.error:
            raise self.error


def test_a_broken_source_writes_nothing_and_keeps_the_existing_file(tmp_path):
    out = tmp_path / "out.h5"
    out.write_bytes(b"precious")
    broken = Given([EVENTS], BrokenRecording(Path("a.raw"), "byte 7", "why not"))
    with pytest.raises(BrokenRecording, match="byte 7"):
        write_dsec(broken, out)
    assert out.read_bytes() == b"precious"
    assert list(tmp_path.iterdir()) == [out]


def test_an_endless_source_or_a_jump_in_time_is_refused(tmp_path):
    with pytest.raises(InvalidField, match="must not be endless"):
        write_dsec(open_source("pattern://"), tmp_path / "out.h5")
    jump = Events.from_columns([5, MAX_SPAN_S * 1_000_000 + 6], [1, 1], [1, 1], [1, 1])
    with pytest.raises(InvalidField, match=f"at most {MAX_SPAN_S} s"):
        write_dsec(Given([jump]), tmp_path / "out.h5")
    assert list(tmp_path.iterdir()) == []


def test_a_recording_without_events_is_written_and_read(tmp_path):
    assert write_dsec(Given([]), tmp_path / "out.h5") == (0, ("events",), ())
    recording = open_source(str(tmp_path / "out.h5"))
    assert (read(recording).n, recording.sensor) == (0, SENSOR)


def test_a_long_gap_is_indexed(tmp_path):
    gap = Events.from_columns([5, 3_600_000_005], [1, 2], [1, 2], [1, 0])
    write_dsec(Given([gap]), tmp_path / "out.h5")
    assert (tmp_path / "out.h5").stat().st_size < 1 << 20
    assert_same(Events.join(list(open_source(str(tmp_path / "out.h5")).since(6))), gap.span(1, 2))


@pytest.mark.parametrize("path", ["prophesee/evt3.raw", "ecd/shapes_rotation", "aedat4/davis346.aedat4"])
def test_a_real_recording_survives_a_copy_to_dsecs_layout(path, tmp_path):
    source = open_source(str(shared(path)))
    write_dsec(source, tmp_path / "out.h5")
    copy = open_source(str(tmp_path / "out.h5"))
    assert_same(read(copy), read(source))
    assert copy.sensor == source.sensor
    assert copy.camera("cam0") == source.camera("cam0")
    middle = int(read(source).t[10_000])
    assert next(copy.since(middle)).t[0] == next(source.since(middle)).t[0] >= middle


@pytest.mark.parametrize(
    ("group", "name", "value"),
    [
        ("events", "width", "wide"),
        ("events", "width", 0),
        ("events", "height", np.inf),
        ("camera", "fx", -1.0),
        ("camera", "distortion", [1.0]),
    ],
)
def test_corrupt_attributes_are_refused_by_name(group, name, value, tmp_path):
    path = tmp_path / "out.h5"
    write_dsec(open_source(write_mvsec(tmp_path, LATE)), path)
    with h5py.File(path, "r+") as file:
        file[group].attrs[name] = value
    with pytest.raises(BrokenRecording, match=f"attributes of {group}"):
        open_source(str(path))


def test_the_error_for_twists_that_run_backwards_names_the_row(tmp_path):
    write_dsec(open_source(write_mvsec(tmp_path, LATE, poses=make_poses(start_us=DAY_US))), tmp_path / "out.h5")
    with h5py.File(tmp_path / "out.h5", "r+") as file:
        file["twists/t"][3] = 0
    with pytest.raises(BrokenRecording, match="row 3 of twists"):
        open_source(str(tmp_path / "out.h5")).twists()
    with h5py.File(tmp_path / "out.h5", "r+") as file:
        del file["twists"]
    recording = open_source(str(tmp_path / "out.h5"))
    assert "twists" in recording.streams
    assert isinstance(recording.twists(), Twists)
