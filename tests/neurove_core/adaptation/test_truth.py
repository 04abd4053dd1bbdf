"""The truth of a robot: every source gives the twist of its camera; what cannot be used is refused before learning."""

import itertools

import numpy as np
import pytest

from neurove_core.adaptation import clock, compare, pieces, truth
from neurove_core.adaptation.truth import Asked
from neurove_core.geometry.motion import Twists
from neurove_core.geometry.mounting import Mounting
from neurove_core.io import Imu, UnknownSource
from neurove_core.sources import open_source
from neurove_protocol.errors import InvalidField
from tests import drives

MOUNTING = Mounting.from_angles(pitch_deg=drives.PITCH_DEG, position_m=drives.POSITION_M)


@pytest.fixture(scope="module", params=["ros1", "sqlite", "mcap"])
def drive(request, tmp_path_factory):
    folder = tmp_path_factory.mktemp(request.param)
    return drives.make_drive(folder, 2.0, 20_201, 1 if request.param == "ros1" else 2, mcap=request.param == "mcap")


def errors(found: Twists, camera: Twists) -> np.ndarray:
    """Greatest error of each axis, away from the ends, where filters are one-sided."""
    t = np.arange(400_000, 1_600_000, 20_000)
    return np.abs(found.at(t) - camera.at(t)).max(0)


@pytest.mark.parametrize("topic", [drives.ODOM, drives.TWIST])
def test_the_motion_of_the_base_becomes_that_of_the_camera(drive, topic):
    found = truth.read(open_source(str(drive.bag)), Asked(topic=topic, mounting=MOUNTING))
    assert (errors(found.twists, drive.camera) < [0.03, 0.06, 0.06, 0.03, 0.03, 0.03]).all()
    assert "motion of the robot base" in found.about
    assert "assumed" not in found.about
    assert found.axes.all()


def test_without_a_mounting_a_level_camera_is_assumed_and_reported(drive):
    found = truth.read(open_source(str(drive.bag)), Asked(topic=drives.ODOM))
    assert "assumed: the camera looks forward" in found.about
    speed = np.linalg.norm(drive.camera.at(np.array([1_000_000]))[0, :3])
    assert found.twists.at(np.array([1_000_000]))[0, 2] == pytest.approx(speed, rel=0.05)


def test_several_topics_need_a_choice_and_an_unknown_one_is_refused_with_the_known_ones(drive):
    recording = open_source(str(drive.bag))
    with pytest.raises(InvalidField, match="choose the topic.*/odom .*/twist"):
        truth.read(recording, Asked())
    with pytest.raises(UnknownSource, match="'/none' does not exist.*/odom"):
        truth.read(recording, Asked(topic="/none"))
    with pytest.raises(UnknownSource, match="has the type event_camera_msgs/EventPacket"):
        truth.read(recording, Asked(topic=drives.EVENTS))


def test_wheel_speed_gives_only_the_forward_axis(drive, tmp_path):
    file = tmp_path / "wheel.csv"
    rows = np.column_stack([drive.base.t[::50] / 1e6, drive.base.twist[::50, 0]])
    np.savetxt(file, rows, delimiter=",", header="t,v", comments="", fmt="%.6f")
    found = truth.read(open_source(str(drive.bag)), Asked(file, mounting=MOUNTING))
    assert found.axes.tolist() == [False, False, True, False, False, False]
    forward = drive.base.twist[::50, 0] * np.cos(np.radians(drives.PITCH_DEG))
    np.testing.assert_allclose(found.twists.twist[:, 2], forward, atol=1e-5)
    sideways = Asked(file, mounting=Mounting.from_angles(yaw_deg=90))
    with pytest.raises(InvalidField, match="at most 60 degrees"):
        truth.read(open_source(str(drive.bag)), sideways)


def test_poses_in_a_text_file_are_of_the_camera_in_any_unit(drive, tmp_path):
    t, position, orientation = drives.poses_of(drive.camera, 10)
    file = tmp_path / "poses.txt"
    for unit, per_us in (("s", 1e-6), ("ms", 1e-3), ("us", 1.0)):
        np.savetxt(file, np.column_stack([t * per_us, position, orientation]), fmt="%.9f")
        found = truth.read(open_source(str(drive.bag)), Asked(file, unit=unit))
        assert (errors(found.twists, drive.camera) < 0.06).all()
        assert "motion of the camera" in found.about


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("0,1\n", "at least two lines"),
        ("0,1\n1,two\n", "line 2.*expected `t,v`"),
        ("0,1\n0,2\n", "must be later"),
        ("0,1\n1,nan\n", "finite"),
        ("0,0\n1,0\n2,0\n", "never moves"),
    ],
)
def test_a_file_of_wheel_speed_that_is_wrong_is_refused(drive, tmp_path, text, words):
    file = tmp_path / "wheel.csv"
    file.write_text(text)
    with pytest.raises(InvalidField, match=words):
        truth.read(open_source(str(drive.bag)), Asked(file))


def test_times_that_do_not_overlap_are_refused_and_a_wrong_unit_is_named():
    t = np.arange(0, 60_000_000, 100_000)
    twists = Twists(t, np.ones((len(t), 6)))
    truth.check_overlap("a", twists, 0, 60_000_000, None)
    with pytest.raises(InvalidField, match="--offset"):
        truth.check_overlap("a", Twists(t + 10**12, twists.twist), 0, 60_000_000, None)
    with pytest.raises(InvalidField, match="--truth-unit ms"):  # milliseconds that were read as seconds
        truth.check_overlap("a", Twists(t * 1000, twists.twist), 0, 60_000_000, None)


def test_a_mounting_from_a_matrix_and_from_a_pose_equals_that_of_its_angles():
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = MOUNTING.rotation, MOUNTING.position_m
    base = Twists(np.array([0]), np.array([[1.0, 0.2, -0.1, 0.3, -0.2, 0.5]]))
    found = Mounting.from_numbers("a file", matrix.ravel().tolist()).of_base(base)
    np.testing.assert_allclose(found.twist, MOUNTING.of_base(base).twist)
    again = drives.base_of(found, MOUNTING)
    np.testing.assert_allclose(again.twist, base.twist, atol=1e-12)
    level = Mounting.from_numbers("a file", [0, 0, 0, -0.5, 0.5, -0.5, 0.5]).of_base(base)
    np.testing.assert_allclose(level.twist[0], [-0.2, 0.1, 1.0, 0.2, -0.5, 0.3], atol=1e-12)
    for wrong in ([1.0] * 16, [0.0] * 5, [0, 0, 0, 0, 0, 0, 2.0], [np.nan] * 7):
        with pytest.raises(InvalidField):
            Mounting.from_numbers("a file", wrong)


def turning(seconds=20, period_s=3.0):
    t = np.arange(0, seconds * 1_000_000, 20_000)
    rng = np.random.default_rng(20_202)
    twist = rng.normal(0, 1e-3, (len(t), 6))
    twist[:, 2] += 2
    twist[:, 4] += 0.5 * np.sin(2 * np.pi * t / 1e6 / period_s) + 0.3 * np.sin(2 * np.pi * t / 1e6 / 1.7)
    return Twists(t, twist)


@pytest.mark.parametrize("offset_us", [-740_000, 150_000, 1_230_000])
def test_a_gyro_shows_the_offset_of_the_truth_to_a_few_milliseconds(offset_us):
    true = turning()
    fine = np.arange(0, 20_000_000, 2_000)
    gyro = np.roll(true.at(fine)[:, 3:], 1, axis=1) + 0.01  # any mounting, with a bias
    seen = clock.seen_by_gyro([Imu(fine, np.zeros_like(gyro), np.nan_to_num(gyro))])
    found = clock.find_offset(seen, Twists(true.t - offset_us, true.twist))
    assert found.us == pytest.approx(offset_us, abs=5_000)
    assert found.agreement > 0.95 > found.before
    assert clock.seen_by_gyro([]) is None


def test_estimates_of_a_model_that_is_wrong_in_scale_show_the_offset_and_noise_shows_none():
    true = turning()
    estimate = 0.5 * true.twist + 0.1
    found = clock.find_offset(clock.seen_by_model(true.t, estimate), Twists(true.t - 1_500_000, true.twist))
    assert found.us == pytest.approx(1_500_000, abs=5_000)
    noise = np.random.default_rng(20_203).normal(size=(len(true.t), 6))
    assert clock.find_offset(clock.seen_by_model(true.t, noise), true) is None
    assert clock.find_offset(clock.seen_by_model(true.t, estimate), Twists(true.t, np.zeros_like(true.twist))) is None


@pytest.mark.parametrize("seconds", [14, 60, 600])
def test_pieces_are_contiguous_apart_from_each_other_and_of_the_stated_share(seconds):
    found = pieces.divide("a", 0, seconds * 1_000_000, 0.2, 3_200_000, 1_600_000)
    assert sum(last - first for first, last in found.held) == pytest.approx(0.2 * seconds * 1e6, rel=0.01)
    spans = sorted([*found.training, *found.validation, *found.held])
    assert all(b[0] - a[1] >= pieces.GAP_US for a, b in itertools.pairwise(spans))
    assert all(last - first >= 3_200_000 for first, last in found.training)
    assert spans[-1][1] <= seconds * 1_000_000
    assert len(found.held) == (1 if seconds < 30 else 2)


def test_a_recording_that_is_too_short_says_how_long_it_must_be():
    with pytest.raises(InvalidField, match=r"'5.0 s'.*at least (\d+) s") as raised:
        pieces.divide("a", 0, 5_000_000, 0.2, 3_200_000, 1_600_000)
    least_s = int(str(raised.value).split("at least ")[1].split()[0])
    pieces.divide("a", 0, (least_s + 1) * 1_000_000, 0.2, 3_200_000, 1_600_000)


def figures_of(error_l, error_a, *, only_vz=False):
    rng = np.random.default_rng(20_204)
    true = np.tile([0.0, 0, 2, 0, 0.3, 0], (500, 1))
    error = rng.normal(size=(500, 6)) * error_l
    error[:, 3:] = rng.normal(size=(500, 3)) * error_a
    if only_vz:
        true[:, [0, 1, 3, 4, 5]] = np.nan
    return compare.figures(compare.Paired(true, true + error, np.full((500, 6), error_l)))


def test_a_model_is_better_only_if_one_part_gains_and_none_loses():
    before = figures_of(0.5, 0.1)
    assert compare.verdict(before, figures_of(0.3, 0.1))[0]
    assert not compare.verdict(before, before)[0]
    better, why = compare.verdict(before, figures_of(0.3, 0.2))
    assert not better
    assert "v_l falls by 40%" in why
    assert "v_a rises by 100%" in why
    assert before["axes"]["vx"]["coverage"] == pytest.approx(0.9, abs=0.04)


def test_axes_without_truth_have_no_figures_and_do_not_decide():
    before, after = figures_of(0.5, 0.1, only_vz=True), figures_of(0.3, 9.0, only_vz=True)
    assert before["axes"]["vx"] == {"rmse": None, "coverage": None}
    assert before["v_a"] == {"re": None, "rmse": None}
    assert before["v_l"]["rmse"] == pytest.approx(before["axes"]["vz"]["rmse"])
    assert compare.verdict(before, after)[0]
