"""MVSEC: events, images, IMU and ground truth in the frames of the cameras."""

import itertools
from pathlib import Path

import h5py
import hdf5plugin
import numpy as np
import pytest

from neurove_core.geometry import rotations
from neurove_core.geometry.motion import twists
from neurove_core.io.formats.hdf5 import mvsec
from neurove_core.sources import open_source
from neurove_protocol import Sensor
from tests.builders import SENSOR
from tests.datasets import CHUNK, DAY_US, LATE, corrupt_chunk, make_imu, make_poses, matrices, own_file, write_mvsec
from tests.recordings import all_samples, shared


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


def test_mvsecs_imu_is_rotated_to_the_cameras_frame(tmp_path):
    imu = make_imu(start_us=DAY_US)
    got = all_samples(open_source(write_mvsec(tmp_path, LATE, imu=imu)))
    turn = np.array(mvsec.CAMERA_FROM_IMU["davis/left"])
    np.testing.assert_array_equal(got.t, imu.t)
    np.testing.assert_allclose(got.gyro_rad_s, imu.gyro_rad_s @ turn.T, atol=1e-12)
    np.testing.assert_allclose(got.accel_m_s2, imu.accel_m_s2 @ turn.T, atol=1e-12)
    assert np.abs(got.gyro_rad_s - imu.gyro_rad_s).max() > 0.01


def test_mvsecs_constants_match_its_calibration_file():
    text = shared("mvsec/camchain-imucam-indoor_flying.yaml").read_text()
    numbers = {word.strip(",[] \n") for word in text.replace("[", " ").replace("]", " ").split()}
    values = [value for lens in mvsec.LENS_INDOOR_FLYING.values() for value in lens.distortion]
    values += [getattr(lens, f) for lens in mvsec.LENS_INDOOR_FLYING.values() for f in ("fx", "fy", "cx", "cy")]
    values += [value for rows in mvsec.CAMERA_FROM_IMU.values() for row in rows for value in row]
    values += list(itertools.chain(*mvsec.RIGHT_FROM_LEFT))
    assert [value for value in values if str(value) not in numbers] == []
    for turn in mvsec.CAMERA_FROM_IMU.values():
        np.testing.assert_allclose(np.array(turn) @ np.array(turn).T, np.eye(3), atol=1e-8)


def test_mvsecs_lens_is_equidistant_and_depends_on_the_sequence(tmp_path):
    indoor = open_source(write_mvsec(tmp_path, LATE)).camera("cam0")
    outdoor = open_source(write_mvsec(tmp_path, LATE, name="outdoor_day2")).camera("cam0")
    assert indoor is not None
    assert outdoor is not None
    assert (indoor.stream, indoor.lens, indoor.fx) == ("cam0", "equidistant", 226.38018519795807)
    assert (outdoor.lens, outdoor.fx) == ("equidistant", 223.9940010790056)
    assert open_source(write_mvsec(tmp_path, LATE), SENSOR).camera("cam0") is None


def test_the_right_camera_of_mvsec_is_ten_centimetres_to_the_right_and_rotates_with_the_left(tmp_path):
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
    one, other = (all_samples(open_source(path, topic=topic)) for topic in mvsec.TOPICS)
    np.testing.assert_allclose(np.linalg.norm(one.gyro_rad_s, axis=1), np.linalg.norm(other.gyro_rad_s, axis=1))


def test_mvsec_without_a_truth_file_has_no_poses(tmp_path):
    recording = open_source(write_mvsec(tmp_path, LATE))
    assert recording.streams == ("events",)
    assert recording.poses() is None
    assert recording.twists() is None
    assert list(recording.frames()) == []


@pytest.mark.parametrize(("row", "value"), [(7, np.nan), (7, np.inf), (7, 1.0)])
def test_an_invalid_imu_sample_is_skipped_and_named_by_its_row(row, value, tmp_path):
    imu = make_imu(start_us=DAY_US)
    path = write_mvsec(tmp_path, LATE, imu=imu)
    with h5py.File(path, "r+") as file:
        file["davis/left/imu_ts"][row] = value
    recording = open_source(path)
    assert all_samples(recording).t.tolist() == np.delete(imu.t, row).tolist()
    (fault,) = recording.faults.found
    assert fault.where == f"row {row} of davis/left/imu"


def test_images_of_another_type_are_refused(tmp_path):
    path = write_mvsec(tmp_path, LATE, images=np.zeros((2, 260, 346)))  # type: ignore[arg-type]  # on purpose
    recording = open_source(path)
    assert not list(recording.frames())
    assert "expected images of uint8, not float64" in recording.faults.unread[0].why


def test_an_unreadable_imu_chunk_is_skipped_and_named_by_its_first_row(tmp_path):
    path = Path(own_file(tmp_path))
    with h5py.File(path, "r+") as file:
        imu = make_imu(250, start_us=DAY_US)
        for name, rows in zip(("t", "accel", "gyro"), imu, strict=True):
            chunks = (CHUNK, *rows.shape[1:])
            file.create_dataset(f"imu/{name}", data=rows, chunks=chunks, compression=hdf5plugin.Zstd())
    with h5py.File(path) as file:
        corrupt_chunk(path, file["imu/gyro"], 1)
    recording = open_source(str(path))
    assert all_samples(recording).t.tolist() == np.delete(imu.t, slice(CHUNK, 2 * CHUNK)).tolist()
    (fault,) = recording.faults.found
    assert (fault.where, fault.count) == (f"row {CHUNK} of imu", CHUNK)


def test_an_image_out_of_order_is_skipped_and_named_by_its_row(tmp_path):
    path = write_mvsec(tmp_path, LATE, images=np.zeros((4, 260, 346), np.uint8))
    with h5py.File(path, "r+") as file:
        file["davis/left/image_raw_ts"][2] = 1.0
    recording = open_source(path)
    assert len(list(recording.frames())) == 3
    assert recording.faults.found[0].where == "row 2 of davis/left/image_raw"


def test_a_pose_that_is_not_a_rigid_transform_is_skipped_and_named_by_its_row(tmp_path):
    path = write_mvsec(tmp_path, LATE, poses=make_poses(start_us=DAY_US))
    with h5py.File(tmp_path / "indoor_flying1_gt.hdf5", "r+") as file:
        file["davis/left/odometry"][5, 0, 0] = 3.0
    recording = open_source(path)
    poses = recording.poses()
    assert poses is not None
    assert poses.t.tolist() == np.delete(make_poses(start_us=DAY_US).t, 5).tolist()
    assert "row 5 of davis/left/odometry" in recording.faults.found[0].where
