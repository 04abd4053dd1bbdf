"""The Event Camera Dataset, as a folder and as a .zip: lines of events and the other files of a recording."""

import io
import sys
import zipfile
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from neurove_core.extras import MissingExtra
from neurove_core.io import UnknownSource
from neurove_core.io.recording import BLOCK_BYTES
from neurove_core.sources import open_source
from neurove_protocol import Events
from neurove_protocol.errors import InvalidField
from tests.builders import SENSOR, make_events
from tests.recordings import assert_same, ecd_text, put, read, read_broken, shared

EVENTS = make_events(500, seed=1)
IMU = b"# t ax ay az gx gy gz\n0.000001 0 -9.8 1 0.1 0.2 0.3\n0.5 1 2 3 4 5 6\n"
POSES = b"0.1 1 2 3 0 0 0 1\n0.2 4 5 6 0.7071 0 0 0.7071\n"
IMAGES = b"0.25 images/frame_0.png\n0.35 images/frame_1.png\n"


def png(value: int) -> bytes:
    file = io.BytesIO()
    Image.fromarray(np.full((4, 6), value, np.uint8)).save(file, "png")
    return file.getvalue()


FILES = {
    "events.txt": ecd_text(EVENTS),
    "calib.txt": b"60 61 32 24 0 0 0 0 0\n",
    "imu.txt": IMU,
    "groundtruth.txt": POSES,
    "images.txt": IMAGES,
    "images/frame_0.png": png(7),
    "images/frame_1.png": png(9),
}


def put_folder(folder: Path, files: dict[str, bytes]) -> str:
    (folder / "images").mkdir(parents=True)
    for name, data in files.items():
        (folder / name).write_bytes(data)
    return str(folder)


def put_zip(folder: Path, files: dict[str, bytes], inside: str = "") -> str:
    with zipfile.ZipFile(folder / "a.zip", "w", zipfile.ZIP_DEFLATED) as archive:
        for name, data in files.items():
            archive.writestr(inside + name, data)
    return str(folder / "a.zip")


@pytest.mark.parametrize("kind", ["folder", "zip", "zip with a folder"])
def test_a_folder_and_a_zip_give_the_same_events_lens_samples_poses_and_images(kind, tmp_path):
    if kind == "folder":
        path = put_folder(tmp_path / "a", FILES)
    else:
        path = put_zip(tmp_path, FILES, "shapes/" if "with" in kind else "")
    recording = open_source(path)
    assert recording.streams == ("events", "imu", "frames", "poses")
    assert_same(read(recording), EVENTS)
    camera = recording.camera("left")
    assert camera is not None
    assert camera.fx == 60
    (imu,) = recording.imu()
    assert imu.t.tolist() == [1, 500_000]
    assert imu.accel_m_s2.tolist() == [[0, -9.8, 1], [1, 2, 3]]
    assert imu.gyro_rad_s.tolist() == [[0.1, 0.2, 0.3], [4, 5, 6]]
    poses = recording.poses()
    assert poses is not None
    assert poses.t.tolist() == [100_000, 200_000]
    assert poses.position_m.tolist() == [[1, 2, 3], [4, 5, 6]]
    np.testing.assert_allclose(poses.orientation, [[0, 0, 0, 1], [0.5**0.5, 0, 0, 0.5**0.5]], atol=1e-12)
    frames = list(recording.frames())
    assert [(frame.t_us, frame.image[0, 0]) for frame in frames] == [(250_000, 7), (350_000, 9)]
    assert frames[0].image.shape == (4, 6)
    assert frames[0].image.dtype == np.uint8


def test_the_real_slider_has_poses_that_move_right():
    recording = open_source(str(shared("slider_depth/events_chunk.txt")))
    poses = recording.poses()
    assert poses is not None
    assert poses.t.size == 339
    assert poses.position_m[-1, 0] - poses.position_m[0, 0] > 0.9
    assert not poses.position_m[:, 1:].any()


def test_a_file_of_events_alone_has_no_other_streams(tmp_path):
    recording = open_source(put(tmp_path, "a.txt", ecd_text(EVENTS)))
    assert recording.streams == ("events",)
    assert recording.poses() is None
    assert not list(recording.imu())
    assert not list(recording.frames())


def test_comments_between_events_are_skipped_but_counted_as_lines(tmp_path):
    text = b"# t x y p\n0.000001 1 2 1\n  # a remark\n0.000002 3 4 0\nno event\n"
    events, error = read_broken(open_source(put(tmp_path, "a.txt", text)))
    assert events.n == 2
    assert error is not None
    assert error.details["where"] == "line 5"


@pytest.mark.parametrize(
    ("name", "bad", "where"),
    [
        ("imu.txt", IMU + b"0.6 1 2 3\n", "imu.txt line 4"),
        ("imu.txt", IMU + b"0.6 1 2 3 4 5 nan\n", "imu.txt line 4"),
        ("imu.txt", IMU + b"0.4 1 2 3 4 5 6\n", "imu.txt line 4"),
        ("groundtruth.txt", POSES + b"0.3 1 2 3 0 0 0 2\n", "groundtruth.txt pose 3"),
        ("groundtruth.txt", b"zero\n", "groundtruth.txt line 1"),
        ("images.txt", IMAGES + b"0.4\n", "images.txt line 3"),
        ("images.txt", IMAGES + b"0.4 images/none.png\n", "images.txt line 3"),
        ("images.txt", IMAGES + b"0.4 ../secret.png\n", "images.txt line 3"),
        ("images.txt", IMAGES + b"0.3 images/frame_0.png\n", "images.txt line 3"),
        ("images/frame_1.png", png(9)[:40], "images.txt line 2"),
    ],
)
def test_a_bad_line_of_another_file_is_skipped_and_counted_with_its_number(name, bad, where, tmp_path):
    recording = open_source(put_zip(tmp_path, FILES | {name: bad}))
    assert sum(imu.t.size for imu in recording.imu()) == 2
    assert len(list(recording.frames())) == (1 if name.startswith("images/") else 2)
    poses = recording.poses()
    assert poses is not None
    assert poses.t.size == (0 if b"zero" in bad else 2)
    (fault,) = recording.faults.found
    assert fault.where == where
    assert_same(read(recording), EVENTS)


def test_a_corrupt_zip_breaks_while_reading_or_is_refused(tmp_path):
    path = put_zip(tmp_path, FILES)
    data = bytearray(Path(path).read_bytes())
    data[200] ^= 0xFF  # within the packed events
    Path(path).write_bytes(data)
    _, error = read_broken(open_source(path))
    assert error is not None
    for other, why in ((b"no zip", "zip file: "), (b"PK\5\6" + bytes(18), "no events.txt")):
        Path(path).write_bytes(other)
        with pytest.raises(UnknownSource, match=why):
            open_source(path)


def test_the_error_without_pillow_says_how_to_install_it(tmp_path, monkeypatch):
    recording = open_source(put_zip(tmp_path, FILES))
    monkeypatch.setitem(sys.modules, "PIL", None)
    with pytest.raises(MissingExtra, match=r"pillow is not installed: pip install 'neurove\[recordings\]'"):
        next(recording.frames())


def test_a_list_without_its_images_is_not_a_stream(tmp_path):
    (tmp_path / "events.txt").write_bytes(b"0.1 1 2 1\n")
    (tmp_path / "images.txt").write_bytes(IMAGES)
    recording = open_source(str(tmp_path))
    assert recording.streams == ("events",)
    assert list(recording.frames()) == []


# --- lines of events, and the calibration ----------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("bad", "why"),
    [
        ("0.000003 1 2", "not `t[s] x y p`"),
        ("0.000003 1 2 1 1", "not `t[s] x y p`"),
        ("0.000003 -1 2 1", "x=-1 y=2 lies outside the sensor 240x180"),
        ("0.000003 1 2 2", "p=2 is a polarity that is neither"),
        ("nan 1 2 1", "t=nan is not a valid time"),
        ("inf 1 2 1", "t=inf is not a valid time"),
        ("one 1 2 1 " + 100 * "x", "not `t[s] x y p`"),
        ("0.000003 240 2 1", "outside the sensor 240x180"),
        ("0.000003 1 180 1", "outside the sensor 240x180"),
        ("0.0000005 1 2 1", "time runs backwards"),
    ],
)
def test_an_invalid_line_is_skipped_and_counted_with_its_number(bad, why, tmp_path):
    path = put(tmp_path, "a.txt", f"0.000001 1 2 1\n\n0.000002 3 4 0\r\n{bad}\n0.000004 1 2 1\n".encode())
    events, error = read_broken(open_source(path))
    assert_same(events, Events.from_columns([1, 2, 4], [1, 3, 1], [2, 4, 2], [1, 0, 1]))
    assert error is not None
    assert error.details["where"] == "line 4"
    assert why in error.message
    assert "`" not in why or bad[:60] in error.message
    assert len(error.message) < len(path) + 200


def test_invalid_lines_are_counted_by_reason_with_the_place_of_the_first(tmp_path):
    text = b"0.1 1 2 1\n0.2 999 2 1\n0.05 1 2 1\nno event\n\nnor this\n0.2 1 2 1\n0.21 1 999 1\n"
    recording = open_source(put(tmp_path, "a.txt", text))
    assert read(recording).n == 2
    found = {(fault.reason.value, fault.count, fault.where) for fault in recording.faults.found}
    assert found == {("outside_sensor", 2, "line 2"), ("late", 1, "line 3"), ("damaged", 2, "line 4")}


def test_line_numbers_count_over_all_blocks_of_a_large_file(tmp_path):
    lines = ecd_text(make_events(300_000, seed=3)).splitlines()
    lines[250_000] = b"\xff\x00 no text"
    events, error = read_broken(open_source(put(tmp_path, "a.txt", b"\n".join(lines))))
    assert events.n == 299_999
    assert error is not None
    assert error.details["where"] == "line 250001"
    assert repr("\\xff\x00 no text") in error.message


def test_time_must_not_run_backwards_between_blocks_of_a_file(tmp_path):
    block = ecd_text(make_events(150_000, seed=3, start_us=1000))
    block += b"\n" * (BLOCK_BYTES - len(block))
    events, error = read_broken(open_source(put(tmp_path, "a.txt", block + b"0.000999 1 2 1\n")))
    assert events.n == 150_000
    assert error is not None
    assert error.details["where"] == f"line {len(block.splitlines()) + 1}"
    assert "t=999 us comes after" in error.message


def test_a_file_that_is_not_text_is_broken_at_its_first_line(tmp_path):
    events, error = read_broken(open_source(put(tmp_path, "a.txt", bytes(3 * BLOCK_BYTES))))
    assert events.n == 0
    assert error is not None
    assert error.details["where"] == "line 1"


def test_times_in_seconds_are_rounded_to_the_nearest_us(tmp_path):
    path = put(tmp_path, "a.txt", b"0.0000014 1 1 1\n0.0000016 1 1 1\n1.0e1 1 1 0\n1506117902.290381 1 1 0\n")
    assert read(open_source(path)).t.tolist() == [1, 2, 10_000_000, 1506117902290381]


@pytest.mark.parametrize("empty", [b"", b"\n", b"\n \n\n"])
def test_an_empty_text_has_no_events(empty, tmp_path):
    assert read(open_source(put(tmp_path, "a.txt", empty))).n == 0


@pytest.mark.parametrize(
    "calib", ["", "1 2 3 4", "1 2 3 4 5 6 7 8 9 10", "-1 2 3 4 0 0 0 0 0", "1 2 3 4 0 0 0 0 nan", "a b c d e f g h i"]
)
def test_an_invalid_calibration_is_refused_at_open(calib, tmp_path):
    put(tmp_path, "events.txt", ecd_text(EVENTS))
    put(tmp_path, "calib.txt", calib.encode())
    with pytest.raises(InvalidField, match=r"calib\.txt: calib=.* expected nine numbers") as caught:
        open_source(str(tmp_path))
    assert str(tmp_path / "calib.txt") in caught.value.message


def test_a_folder_gives_the_recordings_name_and_a_given_sensor_overrides_the_default(tmp_path):
    put(tmp_path, "events.txt", ecd_text(EVENTS))
    put(tmp_path, "calib.txt", b"60 61 32 24 0 0 0 0 0\n")
    recording = open_source(str(tmp_path), SENSOR)
    assert recording.name == tmp_path.name
    camera = recording.camera("cam0")
    assert camera is not None
    assert (camera.sensor, camera.fx, camera.fy) == (SENSOR, 60, 61)
