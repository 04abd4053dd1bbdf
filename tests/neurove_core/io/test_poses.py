"""Pose files: the content of real files, the unit of their times, and the errors for invalid ones."""

import sys
from pathlib import Path

import h5py
import numpy as np
import pytest

from neurove_core.extras import MissingExtra
from neurove_core.geometry import motion
from neurove_core.io import BrokenRecording, UnknownSource
from neurove_core.io.formats import pose_files
from neurove_core.io.formats.pose_files import read_poses
from neurove_protocol.errors import InvalidField
from tests.builders import make_events
from tests.datasets import make_poses, matrices, write_m3ed, write_mvsec
from tests.recordings import shared

LINE = "0.5 -0.5 0.5 -0.5"  # a unit quaternion


def put(folder: Path, text: str, name: str = "poses.txt") -> Path:
    (folder / name).write_text(text)
    return folder / name


# --- real files -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("path", "n", "first_us", "last_us"),
    [
        ("slider_depth/groundtruth.txt", 339, 22_292, 3_402_486),
        ("trajectories/poster_6dof.csv", 11_610, 0, 59_830_544),
        ("trajectories/rpg_desk2.txt", 8377, 1_518_196_794_876_156, 1_518_196_836_756_545),
        ("trajectories/tum_vie_desk.txt", 4497, 992_745, 38_459_412),
        ("mvsec/outdoor_day1_odom.h5", 5137, 1_506_117_902_290_381, 1_506_118_159_183_812),
        ("mvsec/outdoor_day2_odom.h5", 12_200, 1_506_119_819_827_594, 1_506_120_429_953_007),
    ],
)
def test_a_real_file_has_its_known_poses(path, n, first_us, last_us):
    got = read_poses(shared(path))
    assert (got.t.size, got.t[0], got.t[-1]) == (n, first_us, last_us)
    assert (np.diff(got.t) > 0).all()
    np.testing.assert_allclose(np.linalg.norm(got.orientation, axis=1), 1, rtol=1e-12)


@pytest.mark.parametrize(
    ("path", "length_m"),
    [("mvsec/outdoor_day1_odom.h5", 1219.6), ("mvsec/outdoor_day2_odom.h5", 3495.3)],
)
def test_mvsecs_odometry_has_its_known_length(path, length_m):
    got = read_poses(shared(path))
    assert np.linalg.norm(np.diff(got.position_m, axis=0), axis=1).sum() == pytest.approx(length_m, abs=0.1)


def test_the_slider_moves_along_its_own_x_at_its_known_speed():
    got = motion.twists(read_poses(shared("slider_depth/groundtruth.txt"))).twist
    assert 0.2 < got[:200, 0].min() < got[:200, 0].max() < 0.35  # in its first two seconds
    assert np.abs(got[:, 1:]).max() < 1e-3


# --- text -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("times", "separator", "want_us"),
    [
        (("1.5", "1.75"), " ", [1_500_000, 1_750_000]),
        (("1", "2"), " ", [1_000_000, 2_000_000]),
        (("1", "2.5"), ",", [1_000_000, 2_500_000]),
        (("1e0", "2"), ",", [1_000_000, 2_000_000]),
        (("0", "4999161"), ",", [0, 4999]),
        (("0", "4999161"), ", ", [0, 4999]),
        (("1506117902290381123", "1506117902290382923"), " ", [1_506_117_902_290_381, 1_506_117_902_290_383]),
        (("-3000", "3000"), ",", [-3, 3]),
        (("1506117902.290381123", "1506117902.290382923"), "\t", [1_506_117_902_290_381, 1_506_117_902_290_383]),
    ],
)
def test_times_are_seconds_or_whole_nanoseconds_by_rule(times, separator, want_us, tmp_path):
    lines = [separator.join([t, "1", "2", "3", "0", "0", "0", "1"]) for t in times]
    got = read_poses(put(tmp_path, "\n".join(lines)))
    assert got.t.tolist() == want_us
    assert got.position_m.tolist() == [[1, 2, 3]] * 2
    assert got.orientation.tolist() == [[0, 0, 0, 1]] * 2


def test_comments_blank_lines_and_line_ends_are_skipped(tmp_path):
    text = f"\ufeff# t x y z qx qy qz qw\r\n\r\n  1.0 1 2 3 {LINE}\r\n# between\n2.0 4 5 6 {LINE} # after\n\n"
    got = read_poses(put(tmp_path, text))
    assert got.t.tolist() == [1_000_000, 2_000_000]
    assert got.position_m.tolist() == [[1, 2, 3], [4, 5, 6]]


def test_a_quaternion_of_nearly_length_one_is_normalised(tmp_path):
    got = read_poses(put(tmp_path, "1 0 0 0 0 0 0 1.009\n2 0 0 0 0.502 -0.502 0.502 -0.502"))
    np.testing.assert_allclose(got.orientation, [[0, 0, 0, 1], [0.5, -0.5, 0.5, -0.5]], atol=1e-15)


@pytest.mark.parametrize(
    ("bad", "why"),
    [
        ("0.5 0 0 0 0 0 0 1", r"t=500000: must be later \[us\] than .*, 1000000"),
        ("1.0 0 0 0 0 0 0 1", r"t=1000000: must be later \[us\] than .*, 1000000"),
        ("1.0000002 0 0 0 0 0 0 1", r"t=1000000: must be later"),
        ("2.0 0 0 0 0 0 0 1.02", r"\|quaternion\|=1.02: must be 1 to within 0.01"),
        ("2.0 0 0 0 0 0 0 0", r"\|quaternion\|=0.0: must be 1"),
        ("2.0 0 nan 0 0 0 0 1", r"position_m=\[0.0, nan, 0.0\]: .*finite"),
        ("2.0 0 0 inf 0 0 0 1", "position_m=.*: .*finite"),
        ("2.0 0 0 0 0 0 nan 1", "quaternion=.*: .*finite"),
        ("nan 0 0 0 0 0 0 1", "t=nan: .*finite time"),
        ("1e300 0 0 0 0 0 0 1", "t=.*: .*finite time"),
        ("2.0 0 0 0 0 0 1", "columns=7: expected 8 columns: t x y z qx qy qz qw"),
        ("2.0 0 0 0 0 0 0 1 1", "columns=9: expected 8 columns"),
        ("2.0 0 zero 0 0 0 0 1", "y='zero': expected a number"),
        ("2.0,0,0,0,0,0,0,1", "columns=1: expected 8 columns"),
    ],
)
def test_the_error_for_an_invalid_pose_gives_its_line_field_value_and_bound(bad, why, tmp_path):
    path = put(tmp_path, f"# header\n1.0 0 0 0 0 0 0 1\n\n{bad}\n9.0 0 0 0 0 0 0 1\n")
    with pytest.raises(InvalidField, match=why) as caught:
        read_poses(path)
    assert caught.value.message.startswith(f"{path}: line 4: ")


def test_the_first_of_several_invalid_poses_is_reported(tmp_path):
    path = put(tmp_path, "1 0 0 0 0 0 0 1\n2 0 0 0 0 0 0 5\n1 0 0 0 0 0 0 1\n3 nan 0 0 0 0 0 1\n")
    with pytest.raises(InvalidField, match="line 2: "):
        read_poses(path)


@pytest.mark.parametrize("text", ["", "\n\n", "# only a comment\n"])
def test_a_file_without_poses_is_refused(text, tmp_path):
    with pytest.raises(InvalidField, match="poses=0: expected at least one line"):
        read_poses(put(tmp_path, text))


def test_line_numbers_count_over_all_blocks_of_a_long_file(tmp_path):
    lines = [f"{i}.5 0 0 0 0 0 0 1" for i in range(45_000)]
    assert read_poses(put(tmp_path, "\n".join(lines))).t.size == 45_000
    lines[41_234] = "7.0 0 0 0 0 0 0 1"
    with pytest.raises(InvalidField, match=r"line 41235: t=7000000: must be later \[us\] than .*, 41233500"):
        read_poses(put(tmp_path, "\n".join(lines)))


def test_the_unit_of_times_does_not_depend_on_the_blocks_of_a_long_file(tmp_path):
    """All lines but the last have whole seconds, which must not be read as nanoseconds."""
    lines = [f"{i},0,0,0,0,0,0,1" for i in range(30_000)] + ["30000.5,0,0,0,0,0,0,1"]
    assert read_poses(put(tmp_path, "\n".join(lines))).t[-1] == 30_000_500_000


def test_too_many_poses_are_refused(tmp_path, monkeypatch):
    monkeypatch.setattr(pose_files, "MAX_POSES", 10)
    with pytest.raises(InvalidField, match="at most 10"):
        read_poses(put(tmp_path, "".join(f"{i} 0 0 0 0 0 0 1\n" for i in range(11))))


@pytest.mark.parametrize("data", [bytes(200_000), b"\xff\xfe garbage", b"1 2 3 4 5 6 7 1_0\n"])
def test_a_file_that_is_not_a_text_of_poses_is_refused(data, tmp_path):
    (tmp_path / "a.txt").write_bytes(data)
    with pytest.raises(InvalidField, match="line"):
        read_poses(tmp_path / "a.txt")


@pytest.mark.parametrize("name", ["missing.txt", "missing.h5", "."])
def test_a_missing_file_or_a_folder_is_refused(name, tmp_path):
    with pytest.raises(UnknownSource):
        read_poses(tmp_path / name)


# --- HDF5 -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("layout", ["odometry", "mvsec", "m3ed"])
def test_each_hdf5_layout_gives_the_same_trajectory(layout, tmp_path):
    want, events = make_poses(start_us=1_506_117_902_290_381), make_events(10)
    if layout == "odometry":
        path = tmp_path / "odom.h5"
        with h5py.File(path, "w") as file:
            file["ts"], file["poss"], file["rots"] = want.t / 1e6, want.position_m, want.orientation
    elif layout == "mvsec":
        write_mvsec(tmp_path, events, poses=want)
        path = tmp_path / "indoor_flying1_gt.hdf5"
    else:
        write_m3ed(tmp_path, events._replace(t=events.t + 5000), poses=want)
        path = tmp_path / "car_urban_day_horse_pose_gt.h5"
    got = read_poses(path)
    np.testing.assert_array_equal(got.t, want.t)
    np.testing.assert_allclose(matrices(got), matrices(want), atol=1e-12)


@pytest.mark.parametrize(
    ("name", "row", "value", "why"),
    [
        ("ts", 3, 0.0, "row 3: t=0: must be later"),
        ("ts", 3, np.nan, "row 3: t=nan: .*finite time"),
        ("poss", 4, np.inf, "row 4: position_m="),
        ("rots", 5, 2.0, r"row 5: \|quaternion\|=4"),
    ],
)
def test_the_error_for_an_invalid_row_gives_its_number(name, row, value, why, tmp_path):
    want = make_poses(start_us=5_000_000)
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["ts"], file["poss"], file["rots"] = want.t / 1e6, want.position_m, want.orientation
        file[name][row] = value
    with pytest.raises(InvalidField, match=why):
        read_poses(tmp_path / "a.h5")


def test_a_matrix_that_is_not_a_rigid_transform_is_not_a_pose(tmp_path):
    for index, value in (((4, 0), [-1.0, 0, 0, 0]), ((4, 3), [0.5, 0, 0, 1]), ((4, 1, 1), np.nan)):
        with h5py.File(tmp_path / "a.h5", "w") as file:
            file["Cn_T_C0"], file["ts"] = np.tile(np.eye(4), (9, 1, 1)), np.arange(9) * 10
            file["Cn_T_C0"][index] = value
        with pytest.raises(InvalidField, match="row 4 of Cn_T_C0: matrix=.*a rotation and a translation"):
            read_poses(tmp_path / "a.h5")


def test_hdf5_with_missing_unequal_truncated_or_empty_poses_is_refused(tmp_path):
    path = tmp_path / "a.h5"
    with h5py.File(path, "w") as file:
        file["ts"] = np.arange(5.0)
    with pytest.raises(UnknownSource, match="the file has no poses; looked for ts, poss, rots"):
        read_poses(path)
    with h5py.File(path, "a") as file:
        file["poss"], file["rots"] = np.zeros((4, 3)), np.zeros((5, 4))
    with pytest.raises(BrokenRecording, match=r"row 4 of ts: its columns have unequal lengths: \[5, 4, 5\]"):
        read_poses(path)
    path.write_bytes(path.read_bytes()[:-100])
    with pytest.raises(BrokenRecording, match="the file ends here"):
        read_poses(path)
    with h5py.File(path, "w") as file:
        file["ts"], file["poss"], file["rots"] = np.zeros(0), np.zeros((0, 3)), np.zeros((0, 4))
    with pytest.raises(InvalidField, match="poses=0: .*at least one pose"):
        read_poses(path)


def test_hdf5_needs_h5py_and_text_does_not(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "h5py", None)
    assert read_poses(put(tmp_path, "1 0 0 0 0 0 0 1")).t.size == 1
    with pytest.raises(MissingExtra, match="h5py"):
        read_poses(shared("mvsec/outdoor_day1_odom.h5"))
