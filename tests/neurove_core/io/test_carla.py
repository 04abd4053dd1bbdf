"""CARLA's events and poses: the container, the conversion from its left-handed world, and the recorder's errors."""

import importlib.util
import sys
import zipfile
from pathlib import Path

import numpy as np
import pytest

from neurove_core.extras import MissingExtra
from neurove_core.io import BrokenRecording, UnknownSource
from neurove_core.io.formats.carla import RECORD, CarlaPoses, to_optical, write
from neurove_core.io.formats.carla_server import record
from neurove_core.sources import open_source
from neurove_protocol import Events
from neurove_protocol.errors import InvalidField
from tests.builders import SENSOR, make_events
from tests.recordings import assert_same, put, read, read_broken

EVENTS = make_events(3000, seed=1)


def records(events: Events) -> np.ndarray:
    rows = np.zeros(events.n, RECORD)
    rows["t"], rows["x"], rows["y"], rows["pol"] = events.t * 1000 + 999, events.x, events.y, events.p
    return rows


def poses(n: int = 5) -> CarlaPoses:
    rng = np.random.default_rng(0)
    return CarlaPoses(np.arange(n) * 10_000_000, rng.normal(size=(n, 3)), rng.uniform(-80, 80, (n, 3)))


def written(folder: Path, events: Events = EVENTS, *, posed: bool = True) -> str:
    path = folder / "a.npz"
    parts = (records(events.span(i, i + 700)) for i in range(0, events.n, 700))
    assert write(path, parts, SENSOR, 90.0, poses if posed else None) == events.n
    assert [file.name for file in folder.iterdir()] == ["a.npz"]
    return str(path)


def matrix(quaternion: np.ndarray) -> np.ndarray:
    x, y, z, w = quaternion
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )


def optical_twist(first: CarlaPoses, dt_s: float) -> np.ndarray:
    """Body twist of the optical frame from the difference of two poses."""
    got = to_optical(first)
    a, b = (matrix(quaternion) for quaternion in got.orientation)
    turn = a.T @ b
    w = np.array([turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]]) / 2 / dt_s
    return np.concatenate([a.T @ (got.position_m[1] - got.position_m[0]) / dt_s, w])


@pytest.mark.parametrize("posed", [True, False])
def test_a_written_recording_is_read_back(posed, tmp_path):
    recording = open_source(written(tmp_path, posed=posed))
    assert (recording.name, recording.sensor) == ("a.npz", SENSOR)
    assert recording.streams == (("events", "poses") if posed else ("events",))
    assert_same(read(recording), EVENTS)
    camera = recording.camera("left")
    assert camera is not None
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == (pytest.approx(32), pytest.approx(32), 31.5, 23.5)
    truth = recording.poses()
    assert (truth is not None) == posed
    if truth is not None:
        for got, want in zip(truth, to_optical(poses()), strict=True):
            np.testing.assert_array_equal(got, want)


def test_an_event_has_thirteen_bytes():
    assert RECORD.itemsize == 13


@pytest.mark.parametrize(
    ("turned", "twist"),
    [
        ((1, 0, 0), (0, 0, 0, 0, 0, 1)),  # roll: clockwise, about the axis forward
        ((0, 1, 0), (0, 0, 0, 1, 0, 0)),  # pitch: up, about the axis to the right
        ((0, 0, 1), (0, 0, 0, 0, 1, 0)),  # yaw: right, about the axis down
    ],
)
def test_a_turn_in_carla_is_the_same_turn_about_the_optical_axis(turned, twist):
    dt_s = 1e-3
    two = CarlaPoses(np.array([0, 1_000_000]), np.zeros((2, 3)), np.array([[0, 0, 0], np.degrees(turned) * dt_s]))
    np.testing.assert_allclose(optical_twist(two, dt_s), twist, atol=1e-6)


@pytest.mark.parametrize(("moved", "v"), [((1, 0, 0), (0, 0, 1)), ((0, 1, 0), (1, 0, 0)), ((0, 0, 1), (0, -1, 0))])
def test_forward_right_and_up_are_the_optical_z_x_and_minus_y(moved, v):
    two = CarlaPoses(np.array([0, 10**9]), np.array([(5, 6, 7), np.add((5, 6, 7), moved)]), np.zeros((2, 3)))
    np.testing.assert_allclose(optical_twist(two, 1.0)[:3], v, atol=1e-12)


@pytest.mark.parametrize("seed", range(5))
def test_a_camera_that_moves_forward_moves_along_its_optical_axis_in_any_orientation(seed):
    rng = np.random.default_rng(seed)
    roll, pitch, yaw = rng.uniform(-80, 80, 3)
    p, y = np.radians([pitch, yaw])
    forward = np.array([np.cos(p) * np.cos(y), np.cos(p) * np.sin(y), np.sin(p)])  # what CARLA calls forward
    start = rng.normal(size=3)
    two = CarlaPoses(np.array([0, 10**9]), np.array([start, start + forward]), np.tile([roll, pitch, yaw], (2, 1)))
    np.testing.assert_allclose(optical_twist(two, 1.0), [0, 0, 1, 0, 0, 0], atol=1e-9)
    np.testing.assert_allclose(np.linalg.norm(to_optical(two).orientation, axis=1), 1)


@pytest.mark.parametrize(
    ("index", "name", "value", "why"),
    [(2000, "x", 64, "outside the sensor"), (2000, "t", 0, "comes after"), (0, "y", 48, "outside the sensor")],
)
def test_an_invalid_event_is_skipped_and_named(index, name, value, why, tmp_path):
    rows = records(EVENTS)
    rows[name][index] = value
    write(tmp_path / "a.npz", [rows], SENSOR, 90)
    events, error = read_broken(open_source(str(tmp_path / "a.npz")))
    assert_same(events, Events(*(np.delete(column, index) for column in EVENTS)))
    assert error is not None
    assert error.details["where"] == f"event {index:,}"
    assert why in error.message


def test_a_corrupt_file_gives_valid_events_first_and_a_truncated_one_is_refused(tmp_path):
    data = Path(written(tmp_path)).read_bytes()
    for size in (0, 100, len(data) // 2, len(data) - 1):
        with pytest.raises(UnknownSource):
            open_source(put(tmp_path, "b.npz", data[:size]))
    corrupt = bytearray(data)
    corrupt[len(data) // 2] ^= 0xFF
    events, error = read_broken(open_source(put(tmp_path, "b.npz", bytes(corrupt))))
    assert_same(events, EVENTS.span(0, events.n))
    assert error is not None


def test_objects_are_not_unpickled_and_other_archives_are_refused(tmp_path):
    np.savez(tmp_path / "a.npz", events=np.zeros(1, RECORD), width=np.array([{}], object), height=4, fov_deg=90.0)
    with pytest.raises(UnknownSource, match="objects are not read"):
        open_source(str(tmp_path / "a.npz"))
    np.savez(tmp_path / "b.npz", weights=np.zeros(3))
    with pytest.raises(UnknownSource, match="it lacks events, fov_deg, height, width"):
        open_source(str(tmp_path / "b.npz"))


def test_inconsistent_poses_are_refused(tmp_path):
    path = written(tmp_path)
    with zipfile.ZipFile(path) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    for name, wrong in (("location", np.zeros((4, 3))), ("pose_t_ns", np.arange(5)[::-1])):
        with zipfile.ZipFile(path, "w") as archive:
            for member, data in members.items():
                if member != f"{name}.npy":
                    archive.writestr(member, data)
            with archive.open(f"{name}.npy", "w") as file:
                np.lib.format.write_array(file, wrong)
        with pytest.raises(BrokenRecording):
            open_source(path).poses()


def test_a_recording_that_fails_leaves_no_file(tmp_path):
    def failing():
        yield records(EVENTS)
        raise ConnectionError

    with pytest.raises(ConnectionError):
        write(tmp_path / "a.npz", failing(), SENSOR, 90)
    assert not list(tmp_path.iterdir())


def test_the_error_without_the_client_says_how_to_install_it(tmp_path, monkeypatch):
    if importlib.util.find_spec("carla"):
        monkeypatch.setitem(sys.modules, "carla", None)
    with pytest.raises(MissingExtra, match=r"carla is not installed: pip install 'neurove\[carla\]'"):
        record(tmp_path / "a.npz", 1.0)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("wrong", [{"seconds": 0.0}, {"seconds": 1.0, "fov_deg": 180.0}])
def test_invalid_settings_are_refused_by_name(wrong, tmp_path):
    with pytest.raises(InvalidField, match="must"):
        record(tmp_path / "a.npz", **wrong)
