"""What the Event Camera Dataset has beside its events, in a folder and in the .zip that it comes as."""

import io
import sys
import zipfile
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from neurove_core.extras import MissingExtra
from neurove_core.io import BrokenRecording, UnknownSource, open_source
from tests.builders import make_events
from tests.neurove_core.test_io import assert_same, put, read, read_broken
from tests.recordings import ecd_text, shared

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


def test_events_alone_have_nothing_beside_them(tmp_path):
    recording = open_source(put(tmp_path, "a.txt", ecd_text(EVENTS)))
    assert recording.streams == ("events",)
    assert recording.poses() is None
    assert not list(recording.imu())
    assert not list(recording.frames())


def test_comments_between_events_are_passed_over_and_lines_still_counted(tmp_path):
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
        ("imu.txt", IMU + b"0.4 1 2 3 4 5 6\n", "imu.txt after line 0"),
        ("groundtruth.txt", POSES + b"0.3 1 2 3 0 0 0 2\n", "groundtruth.txt pose 3"),
        ("groundtruth.txt", b"zero\n", "groundtruth.txt line 1"),
        ("images.txt", IMAGES + b"0.4\n", "images.txt line 3"),
        ("images.txt", IMAGES + b"0.4 images/none.png\n", "images.txt line 3"),
        ("images.txt", IMAGES + b"0.4 ../secret.png\n", "images.txt line 3"),
        ("images.txt", IMAGES + b"0.3 images/frame_0.png\n", "images.txt line 3"),
        ("images/frame_1.png", png(9)[:40], "images.txt line 2"),
    ],
)
def test_what_is_broken_beside_the_events_is_named_and_the_events_are_not_touched(name, bad, where, tmp_path):
    recording = open_source(put_zip(tmp_path, FILES | {name: bad}))
    with pytest.raises(BrokenRecording) as caught:
        _ = [list(recording.imu()), list(recording.frames()), recording.poses()]
    assert caught.value.details["where"] == where
    assert_same(read(recording), EVENTS)


def test_a_garbled_zip_gives_what_is_whole_or_is_refused(tmp_path):
    path = put_zip(tmp_path, FILES)
    data = bytearray(Path(path).read_bytes())
    data[200] ^= 0xFF  # within the packed events
    Path(path).write_bytes(data)
    _, error = read_broken(open_source(path))
    assert error is not None
    for other, why in ((b"no zip", "it is no zip file"), (b"PK\5\6" + bytes(18), "no events.txt in it")):
        Path(path).write_bytes(other)
        with pytest.raises(UnknownSource, match=why):
            open_source(path)


def test_images_without_pillow_say_what_to_install(tmp_path, monkeypatch):
    recording = open_source(put_zip(tmp_path, FILES))
    monkeypatch.setitem(sys.modules, "PIL", None)
    with pytest.raises(MissingExtra, match=r"pillow is not installed: pip install 'neurove\[recordings\]'"):
        next(recording.frames())
