"""M3ED: calibration, IMU and ground truth."""

import h5py
import numpy as np
import pytest

from neurove_core.io import BrokenRecording
from neurove_core.sources import open_source
from neurove_protocol import Events, Sensor
from neurove_protocol.errors import InvalidField
from tests.builders import SENSOR
from tests.datasets import DAY_US, EVENTS, LATE, make_imu, make_poses, matrices, rigid, write_m3ed, write_mvsec
from tests.recordings import all_samples, assert_same


def test_m3ed_gives_its_lens_and_the_imu_and_truth_in_the_cameras_frame(tmp_path):
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
    samples = all_samples(recording)
    np.testing.assert_allclose(samples.gyro_rad_s, imu.gyro_rad_s @ mount[:3, :3].T, atol=1e-12)
    np.testing.assert_allclose(samples.accel_m_s2, imu.accel_m_s2 @ mount[:3, :3].T, atol=1e-12)
    assert open_source(write_m3ed(tmp_path, EVENTS), Sensor(100, 100)).camera("cam0") is None


def test_the_same_motion_gives_the_same_truth_in_m3ed_and_mvsec(tmp_path):
    poses = make_poses(start_us=DAY_US)
    one = open_source(write_mvsec(tmp_path, LATE, poses=poses)).twists()
    other = open_source(write_m3ed(tmp_path, EVENTS, poses=poses)).twists()
    assert one is not None
    assert other is not None
    np.testing.assert_allclose(one.twist, other.twist, atol=1e-9)


def test_the_calibration_places_the_right_camera_of_m3ed(tmp_path):
    poses, imu = make_poses(), make_imu()
    mounts = {"imu": rigid((0.3, -1.2, 0.5), (0, 0, 0)), "right": rigid((0.01, 0.02, 0.03), (0.12, 0, 0))}
    path = write_m3ed(tmp_path, EVENTS, right=EVENTS, imu=imu, poses=poses, mounts=mounts)
    recording = open_source(path, topic="prophesee/right")
    got = recording.poses()
    assert got is not None
    np.testing.assert_allclose(matrices(got), matrices(poses) @ mounts["right"], atol=1e-12)
    turn = (np.linalg.inv(mounts["right"]) @ mounts["imu"])[:3, :3]
    np.testing.assert_allclose(all_samples(recording).gyro_rad_s, imu.gyro_rad_s @ turn.T, atol=1e-12)


def test_samples_that_the_imu_of_m3ed_never_took_are_left_out(tmp_path):
    imu = make_imu()
    gaps = imu._replace(t=imu.t.copy(), accel_m_s2=imu.accel_m_s2.copy(), gyro_rad_s=imu.gyro_rad_s.copy())
    for row in (0, 7, 8):  # as M3ED's writer leaves them: nan, and in the times the cast of nan
        gaps.t[row], gaps.accel_m_s2[row], gaps.gyro_rad_s[row] = np.iinfo(np.int64).min, np.nan, np.nan
    got = all_samples(open_source(write_m3ed(tmp_path, EVENTS, imu=gaps)))
    keep = np.setdiff1d(np.arange(imu.t.size), [0, 7, 8])
    np.testing.assert_array_equal(got.t, imu.t[keep])
    np.testing.assert_array_equal(got.gyro_rad_s, imu.gyro_rad_s[keep])


def test_m3ed_without_calibration_is_1280x720_and_gives_neither_imu_nor_poses(tmp_path):
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
        ("resolution", [np.inf, 48], "fx fy cx cy"),
        ("distortion_coeffs", [1.0], "fx fy cx cy"),
        ("distortion_coeffs", "none", "fx fy cx cy"),
    ],
)
def test_an_invalid_calibration_is_refused_at_open(name, value, why, tmp_path):
    path = write_m3ed(tmp_path, EVENTS)
    with h5py.File(path, "r+") as file:
        del file[f"prophesee/left/calib/{name}"]
        file[f"prophesee/left/calib/{name}"] = value
    with pytest.raises(InvalidField, match=why):
        open_source(path)


@pytest.mark.parametrize("mount", [np.ones((4, 4)), np.full((4, 4), np.nan), np.eye(3), "none"])
def test_a_mount_that_is_not_a_rigid_transform_is_refused_by_name(mount, tmp_path):
    path = write_m3ed(tmp_path, EVENTS)
    with h5py.File(path, "r+") as file:
        del file["prophesee/left/calib/T_to_prophesee_left"]
        file["prophesee/left/calib/T_to_prophesee_left"] = mount
    with pytest.raises(BrokenRecording, match="T_to_prophesee_left: expected a rigid transform"):
        open_source(path)
