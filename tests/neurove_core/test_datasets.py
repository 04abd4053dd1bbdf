"""MVSEC, DSEC and M3ED in HDF5, in files that are written here in those layouts, and what neurove itself writes."""

import itertools
import re
import tracemalloc
from pathlib import Path

import h5py
import hdf5plugin
import numpy as np
import pytest

from neurove_core import rotations
from neurove_core.extras import MissingExtra
from neurove_core.geometry import Twists, twists
from neurove_core.io import (
    BrokenRecording,
    EventsOnly,
    Imu,
    Recording,
    UnknownSource,
    hdf5,
    mvsec,
    open_source,
    read_poses,
    write_dsec,
)
from neurove_core.io.dsec_write import MAX_SPAN_S
from neurove_core.io.recording import CHUNK_EVENTS
from protocol import Events, NeuroVEError, Sensor
from protocol.errors import InvalidField
from protocol.events import check_events
from tests.builders import SENSOR, make_events
from tests.datasets import CHUNK, make_imu, make_poses, matrices, rigid, write_dsec_file, write_m3ed, write_mvsec
from tests.recordings import shared

DAY_US = 1_506_117_902_000_000
EVENTS = make_events(1000, seed=1, start_us=500_000, duration_us=1_000_000)
LATE = EVENTS._replace(t=EVENTS.t + DAY_US)


def read(recording: Recording) -> Events:
    return Events.join(list(recording.chunks()))


def read_broken(recording: Recording) -> tuple[Events, BrokenRecording | None]:
    """What is whole, and what ended it."""
    parts = []
    try:
        for chunk in recording.chunks():
            parts.append(chunk)  # noqa: PERF402 what came before the error counts
    except BrokenRecording as error:
        return Events.join(parts), error
    return Events.join(parts), None


def assert_same(got: Events, want: Events) -> None:
    for name, a, b in zip("txyp", got, want, strict=True):
        np.testing.assert_array_equal(a, b, err_msg=name)
        assert a.dtype == b.dtype


def imu_of(recording: Recording) -> Imu:
    return Imu(*(np.concatenate(parts) for parts in zip(*recording.imu(), strict=True)))


def mvsec_file(folder: Path) -> str:
    return write_mvsec(folder, LATE)


def dsec_file(folder: Path) -> str:
    return write_dsec_file(folder / "events.h5", LATE, offset_us=DAY_US)


def m3ed_file(folder: Path) -> str:
    return write_m3ed(folder, LATE._replace(t=EVENTS.t))


def own_file(folder: Path) -> str:
    write_dsec(open_source(mvsec_file(folder), SENSOR), folder / "own.h5")
    return str(folder / "own.h5")


each_layout = pytest.mark.parametrize("written", [mvsec_file, dsec_file, m3ed_file, own_file])


# --- all layouts ----------------------------------------------------------------------------------------------------


@each_layout
def test_a_file_in_a_data_sets_layout_gives_its_events_each_time(written, tmp_path):
    recording = open_source(written(tmp_path), SENSOR)
    want = EVENTS if written is m3ed_file else LATE
    assert_same(read(recording), want)
    assert_same(read(recording), want)
    assert recording.sensor == SENSOR
    assert not recording.endless
    assert "events" in recording.streams


@each_layout
@pytest.mark.parametrize("seed", range(3))
def test_reading_from_a_time_on_gives_all_events_from_it_and_none_before(written, seed, tmp_path):
    recording = open_source(written(tmp_path), SENSOR)
    events = EVENTS if written is m3ed_file else LATE
    rng = np.random.default_rng(seed)
    times = rng.integers(events.t[0] - 2000, events.t[-1] + 2000, 20).tolist()
    grid = [int(t) // 1000 * 1000 for t in times[:5]]
    for t_us in [*times, *grid, int(events.t[0]), int(events.t[-1]), int(events.t[-1]) + 1, -5, int(events.t[500])]:
        first = int(np.searchsorted(events.t, t_us))
        assert_same(Events.join(list(recording.since(t_us))), events.span(first, events.n))


@pytest.mark.parametrize(("written", "name"), [(dsec_file, "events/x"), (m3ed_file, "prophesee/left/x")])
def test_what_is_before_a_time_is_not_read(written, name, tmp_path):
    """It may even be unreadable."""
    path = Path(written(tmp_path))
    with h5py.File(path) as file:
        spoil(path, file[name], 0)
    recording = open_source(str(path), SENSOR)
    events = EVENTS if written is m3ed_file else LATE
    assert read_broken(recording)[0].n == 0
    assert_same(Events.join(list(recording.since(int(events.t[700])))), events.span(700, 1000))


def spoil(path: Path, data: h5py.Dataset, number: int) -> None:
    """Overwrite a stored chunk."""
    chunk = data.id.get_chunk_info(number)
    with path.open("r+b") as file:
        file.seek(chunk.byte_offset)
        file.write(b"\xff" * chunk.size)


@each_layout
def test_a_wrong_index_of_milliseconds_costs_time_and_no_events(written, tmp_path):
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
def test_a_cut_file_says_at_which_byte_it_ends(written, seed, tmp_path):
    data = Path(written(tmp_path)).read_bytes()
    cut = tmp_path / "cut.h5"
    for size in np.random.default_rng(seed).integers(200, len(data), 10).tolist():
        cut.write_bytes(data[:size])
        with pytest.raises(BrokenRecording) as caught:
            open_source(str(cut), SENSOR)
        assert caught.value.details["where"] == f"byte {size}"
        assert str(len(data)) in caught.value.message


@each_layout
@pytest.mark.parametrize("seed", range(2))
def test_a_garbled_file_is_refused_in_our_own_words_or_read_without_a_bad_event(written, seed, tmp_path):
    data = Path(written(tmp_path)).read_bytes()
    rng = np.random.default_rng(seed)
    for i in range(40):
        bad = bytearray(data)
        for at in rng.integers(0, len(data) if i % 2 else min(len(data), 8000), 8):
            bad[at] = rng.integers(0, 256)
        path = tmp_path / "garbled.h5"
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
            assert str(tmp_path) in error.message  # noqa: PT017 not raising is fine too


@pytest.mark.parametrize(
    ("column", "value", "why"),
    [
        ("x", 64, "x=64 y=.* lies outside the sensor 64x48"),
        ("y", 48, "y=48 lies outside the sensor 64x48"),
        ("x", -1, "x=-1"),
        ("t", 3, "time runs backwards"),
        ("t", np.nan, "t=nan is no time"),
        ("t", np.inf, "t=inf is no time"),
        ("t", -1e300, "is no time"),
        ("p", 7, "the polarity p=7"),
    ],
)
@pytest.mark.parametrize("written", [mvsec_file, dsec_file, m3ed_file])
def test_a_bad_event_ends_the_recording_at_its_row(written, column, value, why, tmp_path):
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
    assert_same(events, (EVENTS if written is m3ed_file else LATE).span(0, row))
    assert error is not None
    assert str(error.details["where"]).startswith(f"row {row} of ")
    assert re.search(why, error.message)


@pytest.mark.parametrize(("written", "name"), [(dsec_file, "events/y"), (m3ed_file, "prophesee/left/y")])
def test_an_unreadable_chunk_ends_the_recording_at_its_first_row(written, name, tmp_path):
    path = Path(written(tmp_path))
    with h5py.File(path) as file:
        spoil(path, file[name], 4)
    events, error = read_broken(open_source(str(path), SENSOR))
    assert_same(events, (EVENTS if written is m3ed_file else LATE).span(0, 4 * CHUNK))
    assert error is not None
    assert str(error.details["where"]).startswith(f"row {4 * CHUNK} of ")


def test_columns_of_unequal_length_give_what_is_whole(tmp_path):
    path = dsec_file(tmp_path)
    with h5py.File(path, "r+") as file:
        y = file["events/y"][:900]
        del file["events/y"]
        file["events/y"] = y
    events, error = read_broken(open_source(path, SENSOR))
    assert_same(events, LATE.span(0, 900))
    assert error is not None
    assert "unequal length" in error.message
    assert "row 900 of events" in error.message


def test_a_table_of_another_kind_is_told_by_its_name(tmp_path):
    with h5py.File(tmp_path / "a.hdf5", "w") as file:
        file["davis/left/events"] = np.zeros((5, 3))
    with pytest.raises(BrokenRecording, match=r"davis/left/events: numbers of shape \(N, 4\) are expected"):
        read(open_source(str(tmp_path / "a.hdf5")))
    with h5py.File(tmp_path / "b.h5", "w") as file:
        for name in "pxyt":
            file[f"events/{name}"] = [b"one", b"two"]
    with pytest.raises(BrokenRecording, match="numbers of shape"):
        read(open_source(str(tmp_path / "b.h5")))


def test_rows_that_were_never_written_are_no_events(tmp_path):
    with h5py.File(tmp_path / "a.h5", "w") as file:
        for name in "pxyt":
            file.create_dataset(f"events/{name}", (1 << 60,), "u2", chunks=(1000,))
    with pytest.raises(BrokenRecording, match="1152921504606846976 rows were never written"):
        read(open_source(str(tmp_path / "a.h5")))


def test_chunks_too_large_for_memory_are_refused_before_they_are_unpacked(tmp_path):
    with h5py.File(tmp_path / "a.h5", "w") as file:
        for name in "pxyt":
            file.create_dataset(f"events/{name}", (10,), "i8", maxshape=(None,), chunks=(9_000_000,), compression=1)
    with pytest.raises(BrokenRecording, match="chunks of 72000000 bytes; at most 67108864"):
        read(open_source(str(tmp_path / "a.h5")))


def test_a_long_file_comes_in_bounded_chunks_and_memory(tmp_path):
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


# --- which layout, which stream -------------------------------------------------------------------------------------


def test_a_file_of_no_known_layout_is_told_what_was_looked_for(tmp_path):
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["something"] = 1
    with pytest.raises(UnknownSource) as caught:
        open_source(str(tmp_path / "a.h5"))
    for name in ("davis/left/events", "events/p, x, y, t", "prophesee/left"):
        assert name in caught.value.message


def test_a_file_of_truth_alone_says_that_it_has_poses(tmp_path):
    write_mvsec(tmp_path, LATE, poses=make_poses())
    with pytest.raises(UnknownSource, match="no events.*it has poses: davis/left/odometry"):
        open_source(str(tmp_path / "indoor_flying1_gt.hdf5"))


@pytest.mark.parametrize("data", [b"", b"no HDF5 at all", b"PK\x03\x04"])
def test_what_is_no_hdf5_is_refused(data, tmp_path):
    (tmp_path / "a.hdf5").write_bytes(data)
    with pytest.raises(UnknownSource, match="does not begin as HDF5 does"):
        open_source(str(tmp_path / "a.hdf5"))


def test_a_topic_picks_one_of_several_cameras(tmp_path):
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


def test_of_a_file_with_the_right_camera_alone_that_is_read(tmp_path):
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


def test_without_h5py_its_absence_is_told(tmp_path, monkeypatch):
    path = dsec_file(tmp_path)
    monkeypatch.setitem(__import__("sys").modules, "h5py", None)
    with pytest.raises(MissingExtra, match=r"h5py is not installed: pip install 'neurove\[recordings\]'"):
        open_source(path)
    with pytest.raises(MissingExtra):
        hdf5.library()


# --- MVSEC ----------------------------------------------------------------------------------------------------------


def test_mvsec_gives_events_images_imu_and_truth(tmp_path):
    poses, imu = make_poses(start_us=DAY_US), make_imu(start_us=DAY_US)
    images = np.random.default_rng(3).integers(0, 256, (4, 260, 346), np.uint8)
    recording = open_source(write_mvsec(tmp_path, LATE, imu=imu, poses=poses, images=images))
    assert recording.sensor == Sensor(346, 260)
    assert recording.streams == ("events", "imu", "frames", "poses", "twists")
    frames = list(recording.frames())
    np.testing.assert_array_equal(np.stack([frame.image for frame in frames]), images)
    assert [frame.t_us - int(LATE.t[0]) for frame in frames] == [0, 25_000, 50_000, 75_000]
    got = recording.poses()
    assert got is not None
    np.testing.assert_array_equal(got.t, poses.t)
    np.testing.assert_allclose(got.position_m, poses.position_m, atol=1e-12)
    np.testing.assert_allclose(matrices(got), matrices(poses), atol=1e-12)
    truth, want = recording.twists(), twists(poses)
    assert truth is not None
    np.testing.assert_allclose(truth.twist, want.twist, atol=1e-9)


def test_mvsecs_imu_is_turned_into_the_cameras_frame(tmp_path):
    imu = make_imu(start_us=DAY_US)
    got = imu_of(open_source(write_mvsec(tmp_path, LATE, imu=imu)))
    turn = np.array(mvsec.CAMERA_FROM_IMU["davis/left"])
    np.testing.assert_array_equal(got.t, imu.t)
    np.testing.assert_allclose(got.gyro_rad_s, imu.gyro_rad_s @ turn.T, atol=1e-12)
    np.testing.assert_allclose(got.accel_m_s2, imu.accel_m_s2 @ turn.T, atol=1e-12)
    assert np.abs(got.gyro_rad_s - imu.gyro_rad_s).max() > 0.01


def test_mvsecs_constants_are_those_of_its_calibration():
    text = shared("mvsec/camchain-imucam-indoor_flying.yaml").read_text()
    numbers = {word.strip(",[] \n") for word in text.replace("[", " ").replace("]", " ").split()}
    told = [value for lens in mvsec.LENS_INDOOR_FLYING.values() for value in lens.distortion]
    told += [getattr(lens, f) for lens in mvsec.LENS_INDOOR_FLYING.values() for f in ("fx", "fy", "cx", "cy")]
    told += [value for rows in mvsec.CAMERA_FROM_IMU.values() for row in rows for value in row]
    told += list(itertools.chain(*mvsec.RIGHT_FROM_LEFT))
    assert [value for value in told if str(value) not in numbers] == []
    for turn in mvsec.CAMERA_FROM_IMU.values():
        np.testing.assert_allclose(np.array(turn) @ np.array(turn).T, np.eye(3), atol=1e-8)


def test_mvsecs_lens_is_equidistant_and_that_of_its_sequence(tmp_path):
    indoor = open_source(write_mvsec(tmp_path, LATE)).camera("cam0")
    outdoor = open_source(write_mvsec(tmp_path, LATE, name="outdoor_day2")).camera("cam0")
    assert indoor is not None
    assert outdoor is not None
    assert (indoor.stream, indoor.lens, indoor.fx) == ("cam0", "equidistant", 226.38018519795807)
    assert (outdoor.lens, outdoor.fx) == ("equidistant", 223.9940010790056)
    assert open_source(write_mvsec(tmp_path, LATE), SENSOR).camera("cam0") is None


def test_the_right_camera_of_mvsec_stands_ten_centimetres_to_the_right_and_turns_as_the_left(tmp_path):
    poses = make_poses(start_us=DAY_US)
    path = write_mvsec(tmp_path, LATE, right=LATE, poses=poses, imu=make_imu(start_us=DAY_US))
    left, right = open_source(path).poses(), open_source(path, topic="davis/right").poses()
    assert left is not None
    assert right is not None
    offset = rotations.turn(rotations.inverse(left.orientation), right.position_m - left.position_m)
    np.testing.assert_allclose(offset, np.broadcast_to([0.0999, 0, 0], offset.shape), atol=3e-3)
    want = np.vstack([mvsec.RIGHT_FROM_LEFT, [0, 0, 0, 1]])
    got = np.linalg.inv(matrices(right)) @ matrices(left)
    np.testing.assert_allclose(got, np.broadcast_to(want, got.shape), atol=1e-7)
    one, other = (imu_of(open_source(path, topic=topic)) for topic in mvsec.TOPICS)
    np.testing.assert_allclose(np.linalg.norm(one.gyro_rad_s, axis=1), np.linalg.norm(other.gyro_rad_s, axis=1))


def test_mvsec_without_truth_has_none(tmp_path):
    recording = open_source(write_mvsec(tmp_path, LATE))
    assert recording.streams == ("events",)
    assert recording.poses() is None
    assert recording.twists() is None
    assert list(recording.frames()) == []


@pytest.mark.parametrize(("row", "value"), [(7, np.nan), (7, np.inf), (7, 1.0)])
def test_a_bad_imu_sample_ends_the_stream_at_its_row(row, value, tmp_path):
    imu = make_imu(start_us=DAY_US)
    path = write_mvsec(tmp_path, LATE, imu=imu)
    with h5py.File(path, "r+") as file:
        file["davis/left/imu_ts"][row] = value
    blocks = open_source(path).imu()
    assert next(blocks).t.tolist() == imu.t[:row].tolist()
    with pytest.raises(BrokenRecording, match=f"row {row} of davis/left/imu"):
        next(blocks)


def test_images_out_of_order_are_told_by_their_row(tmp_path):
    path = write_mvsec(tmp_path, LATE, images=np.zeros((4, 260, 346), np.uint8))
    with h5py.File(path, "r+") as file:
        file["davis/left/image_raw_ts"][2] = 1.0
    with pytest.raises(BrokenRecording, match="row 2 of davis/left/image_raw"):
        list(open_source(path).frames())


def test_a_truth_that_is_no_rigid_motion_is_told_by_its_row(tmp_path):
    path = write_mvsec(tmp_path, LATE, poses=make_poses(start_us=DAY_US))
    with h5py.File(tmp_path / "indoor_flying1_gt.hdf5", "r+") as file:
        file["davis/left/odometry"][5, 0, 0] = 3.0
    with pytest.raises(InvalidField, match="row 5 of davis/left/odometry: matrix="):
        open_source(path).poses()


# --- DSEC -----------------------------------------------------------------------------------------------------------


def test_dsec_is_640x480_and_its_offset_may_be_absent(tmp_path):
    recording = open_source(write_dsec_file(tmp_path / "events.h5", EVENTS))
    assert recording.sensor == Sensor(640, 480)
    assert_same(read(recording), EVENTS)
    assert recording.camera("cam0") is None


def test_a_file_in_dsecs_layout_of_a_larger_sensor_asks_for_it(tmp_path):
    """TUM-VIE's are such files."""
    events = make_events(100, seed=4, sensor=Sensor(1280, 720))
    path = write_dsec_file(tmp_path / "events.h5", events)
    _, error = read_broken(open_source(path))
    assert error is not None
    assert "lies outside the sensor 640x480, which is DSEC's" in error.message
    assert "--sensor WIDTHxHEIGHT" in error.message
    assert_same(read(open_source(path, Sensor(1280, 720))), events)


def test_dsec_without_an_index_is_read_from_a_time_on_all_the_same(tmp_path):
    recording = open_source(write_dsec_file(tmp_path / "events.h5", LATE, offset_us=DAY_US, index=False))
    assert_same(Events.join(list(recording.since(int(LATE.t[600]) + 1))), LATE.span(601, 1000))


@pytest.mark.parametrize("offset", [2**63, [1, 2], b"soon"])
def test_a_time_offset_that_is_none_is_named(offset, tmp_path):
    path = write_dsec_file(tmp_path / "events.h5", EVENTS)
    with h5py.File(path, "r+") as file:
        file["t_offset"] = np.array(offset, "u8") if isinstance(offset, int) else offset
    with pytest.raises(BrokenRecording, match="t_offset"):
        open_source(path)


def test_what_is_written_in_dsecs_layout_is_read_back_with_all_that_the_source_had(tmp_path):
    poses, imu = make_poses(start_us=DAY_US), make_imu(start_us=DAY_US)
    images = np.zeros((4, 260, 346), np.uint8)
    source = open_source(write_mvsec(tmp_path, LATE, imu=imu, poses=poses, images=images))
    told: list[int] = []
    written = write_dsec(source, tmp_path / "out.h5", told.append)
    assert written == (LATE.n, ("events", "poses", "twists", "imu"), ("frames",))
    assert told == [LATE.n]
    copy = open_source(str(tmp_path / "out.h5"))
    assert copy.sensor == source.sensor
    assert copy.camera("cam0") == source.camera("cam0")
    assert_same(read(copy), read(source))
    assert set(copy.streams) == {"events", "imu", "poses", "twists"}
    for a, b in zip(imu_of(copy), imu_of(source), strict=True):
        np.testing.assert_array_equal(a, b)
    for mine, theirs in ((copy.poses(), source.poses()), (copy.twists(), source.twists())):
        assert mine is not None
        assert theirs is not None
        for a, b in zip(mine, theirs, strict=True):
            np.testing.assert_allclose(a, b, rtol=0, atol=1e-15)
    assert read_poses(tmp_path / "out.h5").t.tolist() == poses.t.tolist()


def test_the_index_that_is_written_is_that_of_dsecs_own_example(tmp_path):
    t = [0, 500, 2100, 5000, 5000, 7100, 7200, 7200, 8100, 9000]
    write_dsec(Given([Events.from_columns(np.array(t) + 77, [1] * 10, [2] * 10, [1] * 10)]), tmp_path / "a.h5")
    with h5py.File(tmp_path / "a.h5") as file:
        assert file["ms_to_idx"][()].tolist() == [0, 2, 2, 3, 3, 3, 5, 5, 8, 9]
        assert file["t_offset"][()] == 77
        assert file["events/t"][()].tolist() == t
        assert {name: file[f"events/{name}"].dtype.str for name in "pxy"} == {"p": "|u1", "x": "<u2", "y": "<u2"}


@pytest.mark.parametrize("seed", range(3))
def test_what_is_written_does_not_depend_on_how_the_source_cuts_its_chunks(seed, tmp_path):
    events = make_events(3000, seed=seed, start_us=123, duration_us=50_000)
    cuts = [0, *sorted(np.random.default_rng(seed).choice(np.arange(1, 3000), 20, replace=False).tolist()), 3000]
    write_dsec(Given([events]), tmp_path / "one.h5")
    write_dsec(Given([events.span(a, b) for a, b in itertools.pairwise(cuts)]), tmp_path / "many.h5")
    with h5py.File(tmp_path / "one.h5") as one, h5py.File(tmp_path / "many.h5") as many:
        np.testing.assert_array_equal(one["ms_to_idx"], many["ms_to_idx"])
        t = one["events/t"][()]
        for ms, entry in enumerate(one["ms_to_idx"][()].tolist()):
            assert t[entry] >= ms * 1000
            assert entry == 0 or t[entry - 1] < ms * 1000
    assert_same(read(open_source(str(tmp_path / "many.h5"))), events)


class Given(EventsOnly):
    """A recording of these chunks, and an error after them."""

    name, sensor, endless = "given", SENSOR, False

    def __init__(self, parts: list[Events], error: Exception | None = None) -> None:
        self.parts, self.error = parts, error

    def chunks(self):
        yield from self.parts
        if self.error:
            raise self.error


def test_a_source_that_breaks_leaves_nothing_behind_and_what_was_there_stays(tmp_path):
    out = tmp_path / "out.h5"
    out.write_bytes(b"precious")
    broken = Given([EVENTS], BrokenRecording(Path("a.raw"), "byte 7", "why not"))
    with pytest.raises(BrokenRecording, match="byte 7"):
        write_dsec(broken, out)
    assert out.read_bytes() == b"precious"
    assert list(tmp_path.iterdir()) == [out]


def test_a_source_without_end_or_with_a_jump_in_time_is_not_written(tmp_path):
    with pytest.raises(InvalidField, match="one that ends is expected"):
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
def test_a_real_recording_survives_the_way_through_dsecs_layout(path, tmp_path):
    source = open_source(str(shared(path)))
    write_dsec(source, tmp_path / "out.h5")
    copy = open_source(str(tmp_path / "out.h5"))
    assert_same(read(copy), read(source))
    assert copy.sensor == source.sensor
    assert copy.camera("cam0") == source.camera("cam0")
    middle = int(read(source).t[10_000])
    assert next(copy.since(middle)).t[0] == next(source.since(middle)).t[0] >= middle


@pytest.mark.parametrize(("group", "name"), [("events", "width"), ("camera", "fx")])
def test_attributes_that_were_spoilt_are_named(group, name, tmp_path):
    path = tmp_path / "out.h5"
    write_dsec(open_source(write_mvsec(tmp_path, LATE)), path)
    with h5py.File(path, "r+") as file:
        file[group].attrs[name] = "wide"
    with pytest.raises(BrokenRecording, match=f"attributes of {group}"):
        open_source(str(path))


def test_twists_that_run_backwards_are_told_by_their_row(tmp_path):
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


# --- M3ED -----------------------------------------------------------------------------------------------------------


def test_m3ed_gives_its_lens_imu_and_truth_in_the_cameras_frame(tmp_path):
    poses, imu = make_poses(), make_imu()
    mount = rigid((0.3, -1.2, 0.5), (0.1, 0.2, 0.3))
    recording = open_source(write_m3ed(tmp_path, EVENTS, imu=imu, poses=poses, mounts={"imu": mount}))
    assert recording.streams == ("events", "imu", "poses", "twists")
    assert recording.sensor == SENSOR
    camera = recording.camera("cam0")
    assert camera is not None
    assert (camera.stream, camera.lens, camera.sensor) == ("cam0", "pinhole", SENSOR)
    assert (camera.fx, camera.cy, camera.distortion) == (60.0, 24.5, (-0.1, 0.02, 0.001, -0.002))
    got = recording.poses()
    assert got is not None
    np.testing.assert_allclose(matrices(got), matrices(poses), atol=1e-12)
    samples = imu_of(recording)
    np.testing.assert_allclose(samples.gyro_rad_s, imu.gyro_rad_s @ mount[:3, :3].T, atol=1e-12)
    np.testing.assert_allclose(samples.accel_m_s2, imu.accel_m_s2 @ mount[:3, :3].T, atol=1e-12)
    assert open_source(write_m3ed(tmp_path, EVENTS), Sensor(100, 100)).camera("cam0") is None


def test_m3eds_matrices_are_the_inverse_of_mvsecs_and_one_motion_gives_one_truth(tmp_path):
    poses = make_poses(start_us=DAY_US)
    one = open_source(write_mvsec(tmp_path, LATE, poses=poses)).twists()
    other = open_source(write_m3ed(tmp_path, EVENTS, poses=poses)).twists()
    assert one is not None
    assert other is not None
    np.testing.assert_allclose(one.twist, other.twist, atol=1e-9)


def test_the_right_camera_of_m3ed_is_where_its_calibration_says(tmp_path):
    poses, imu = make_poses(), make_imu()
    mounts = {"imu": rigid((0.3, -1.2, 0.5), (0, 0, 0)), "right": rigid((0.01, 0.02, 0.03), (0.12, 0, 0))}
    path = write_m3ed(tmp_path, EVENTS, right=EVENTS, imu=imu, poses=poses, mounts=mounts)
    recording = open_source(path, topic="prophesee/right")
    got = recording.poses()
    assert got is not None
    np.testing.assert_allclose(matrices(got), matrices(poses) @ mounts["right"], atol=1e-12)
    turn = (np.linalg.inv(mounts["right"]) @ mounts["imu"])[:3, :3]
    np.testing.assert_allclose(imu_of(recording).gyro_rad_s, imu.gyro_rad_s @ turn.T, atol=1e-12)


def test_samples_that_m3eds_imu_never_took_are_left_out(tmp_path):
    imu = make_imu()
    holes = imu._replace(t=imu.t.copy(), accel_m_s2=imu.accel_m_s2.copy(), gyro_rad_s=imu.gyro_rad_s.copy())
    for row in (0, 7, 8):  # as its writer leaves them: nan, and in the times what a cast makes of nan
        holes.t[row], holes.accel_m_s2[row], holes.gyro_rad_s[row] = np.iinfo(np.int64).min, np.nan, np.nan
    got = imu_of(open_source(write_m3ed(tmp_path, EVENTS, imu=holes)))
    keep = np.setdiff1d(np.arange(imu.t.size), [0, 7, 8])
    np.testing.assert_array_equal(got.t, imu.t[keep])
    np.testing.assert_array_equal(got.gyro_rad_s, imu.gyro_rad_s[keep])


def test_m3ed_without_calibration_is_1280x720_and_has_no_imu_in_a_frame_that_is_known(tmp_path):
    path = write_m3ed(tmp_path, EVENTS, imu=make_imu(), poses=make_poses())
    with h5py.File(path, "r+") as file:
        del file["prophesee/left/calib"]
        del file["prophesee/left/ms_map_idx"]
    recording = open_source(path)
    assert recording.sensor == Sensor(1280, 720)
    assert recording.streams == ("events",)
    assert recording.camera("cam0") is None
    assert list(recording.imu()) == []
    assert recording.poses() is None
    assert_same(Events.join(list(recording.since(int(EVENTS.t[600]) + 1))), EVENTS.span(601, 1000))


@pytest.mark.parametrize(
    ("name", "value", "why"),
    [
        ("distortion_model", "omni", "distortion_model='pinhole-omni'"),
        ("intrinsics", [1.0, 2.0], "fx fy cx cy"),
        ("intrinsics", [-1.0, 2.0, 3.0, 4.0], "fx fy cx cy"),
        ("resolution", [0, 48], "fx fy cx cy"),
    ],
)
def test_a_calibration_that_is_none_is_named_when_the_file_is_opened(name, value, why, tmp_path):
    path = write_m3ed(tmp_path, EVENTS)
    with h5py.File(path, "r+") as file:
        del file[f"prophesee/left/calib/{name}"]
        file[f"prophesee/left/calib/{name}"] = value
    with pytest.raises(InvalidField, match=why):
        open_source(path)


def test_a_mount_that_is_no_rigid_motion_is_named(tmp_path):
    path = write_m3ed(tmp_path, EVENTS)
    with h5py.File(path, "r+") as file:
        file["prophesee/left/calib/T_to_prophesee_left"][...] = np.ones((4, 4))
    with pytest.raises(BrokenRecording, match="T_to_prophesee_left: a rigid motion"):
        open_source(path)


def test_a_compressed_file_of_another_packing_is_read_too(tmp_path):
    path = write_mvsec(tmp_path, LATE, compression=hdf5plugin.Zstd())
    assert_same(read(open_source(path, SENSOR)), LATE)
