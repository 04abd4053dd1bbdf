"""Trajectories: the twist is exactly the derivative of the pose, and each trajectory moves as its name says."""

import math
from pathlib import Path

import numpy as np
import pytest

from neurove_core.geometry import rotations
from neurove_core.geometry.motion import Poses, twists
from neurove_core.sim.motion.trajectory import (
    Mounted,
    Trajectory,
    driving,
    from_poses,
    hand_held,
    parse_trajectory,
    still,
)
from neurove_protocol.errors import InvalidField
from tests.recordings import shared

DT_S = 1e-5


def waving(seconds: float, step_us: int = 5_000) -> Poses:
    """A smooth path with motion in every axis, as a motion-capture system records it, in an arbitrary world."""
    t_us = np.arange(0, round(seconds * 1e6), step_us) + 1_500_000_000_000_000
    t = (t_us - t_us[0])[:, None] / 1e6
    world = rotations.exp(np.array([1.4, -0.3, 0.2]))
    position = np.sin(t * [1.0, 1.7, 2.3] + [0.0, 1.0, 2.0])
    orientation = rotations.product(world, rotations.exp(0.4 * np.sin(t * [2.1, 0.9, 1.3])))
    return Poses(t_us, rotations.turn(world, position + 3.0), orientation)


def tum(poses: Poses) -> str:
    rows = zip(poses.t.tolist(), poses.position_m.tolist(), poses.orientation.tolist(), strict=True)
    return "".join(f"{t / 1e6:.6f} " + " ".join(f"{x:.9f}" for x in (*p, *q)) + "\n" for t, p, q in rows)


EACH = {
    "driving": driving(3, 60),
    "handheld": hand_held(1, 20),
    "still": still(),
    "rotation": parse_trajectory("rotation?wx=1&wy=-2&wz=3"),
    "slider": parse_trajectory("slider?vx=0.3&vz=-1"),
    "recorded": from_poses(waving(20)),
    "mounted": Mounted(driving(4, 60), height_m=1.5, pitch_deg=12),
}
each = pytest.mark.parametrize("trajectory", EACH.values(), ids=EACH)


def times(trajectory: Trajectory, n: int = 300) -> np.ndarray:
    last = min(trajectory.duration_s, 20.0) - 2 * DT_S
    return np.sort(np.random.default_rng(0).uniform(2 * DT_S, last, n))


def differences(trajectory: Trajectory, t: np.ndarray, dt: float) -> np.ndarray:
    """Twist by central differences of the pose, of fourth order."""

    def screw(by: float) -> np.ndarray:
        (p0, q0), (p1, q1) = trajectory.position_orientation(t), trajectory.position_orientation(t + by)
        back = rotations.inverse(q0)
        return np.concatenate([rotations.turn(back, p1 - p0), rotations.log(rotations.product(back, q1))], axis=1)

    return (8 * (screw(dt) - screw(-dt)) - (screw(2 * dt) - screw(-2 * dt))) / (12 * dt)


@each
def test_the_twist_is_the_derivative_of_the_pose_to_a_millionth(trajectory):
    t = times(trajectory)
    np.testing.assert_allclose(trajectory.twist(t), differences(trajectory, t, DT_S), atol=1e-6)


@each
def test_pose_and_twist_are_continuous(trajectory):
    t = np.arange(0, min(trajectory.duration_s, 10.0), 1e-3)
    position, rotation = trajectory.pose(t)
    twist = trajectory.twist(t)
    np.testing.assert_allclose(
        rotation @ np.swapaxes(rotation, 1, 2), np.broadcast_to(np.eye(3), (t.size, 3, 3)), atol=1e-12
    )
    np.testing.assert_allclose(np.linalg.det(rotation), 1)
    assert np.abs(np.diff(position, axis=0)).max() < 0.02
    assert np.abs(np.diff(twist, axis=0)).max() < 0.5  # within a millisecond


@each
def test_the_shape_of_the_times_does_not_change_the_result(trajectory):
    t = times(trajectory, 6)
    position, rotation = trajectory.pose(t)
    twist = trajectory.twist(t)
    assert (position.shape, rotation.shape, twist.shape) == ((6, 3), (6, 3, 3), (6, 6))
    np.testing.assert_allclose(trajectory.twist(t.reshape(2, 3)), twist.reshape(2, 3, 6), atol=1e-12)
    p, r = trajectory.pose(float(t[2]))
    assert (p.shape, r.shape, trajectory.twist(float(t[2])).shape) == ((3,), (3, 3), (6,))
    np.testing.assert_allclose(p, position[2], atol=1e-12)
    np.testing.assert_allclose(r, rotation[2], atol=1e-12)
    poses, truth = trajectory.poses((t * 1e6).astype(np.int64)), trajectory.twists((t * 1e6).astype(np.int64))
    np.testing.assert_allclose(poses.position_m, position, atol=1e-4)
    np.testing.assert_allclose(truth.twist, twist, atol=1e-3)


@pytest.mark.parametrize("t_s", [-1e-3, 60.001, math.nan])
def test_a_time_before_the_start_or_after_the_end_is_refused(t_s):
    with pytest.raises(InvalidField, match=r"t_s=.*must be 0 to 60 s"):
        EACH["driving"].pose(np.array([1.0, t_s]))


@each
def test_the_start_and_the_end_are_part_of_the_path(trajectory):
    for t_s in (0.0, min(trajectory.duration_s, 1e4)):
        assert np.isfinite(trajectory.twist(t_s)).all()


def test_the_filter_recovers_the_exact_twist_from_sampled_poses():
    t_us = np.arange(0, 20_000_000, 2_000)
    got = twists(EACH["driving"].poses(t_us), filter_s=0.04)
    np.testing.assert_allclose(got.twist, EACH["driving"].twist(t_us / 1e6), atol=5e-3)


# --- made up --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("seed", range(4))
def test_a_drive_moves_like_a_car(seed):
    trajectory = driving(seed, 300)
    t = np.arange(0, 300, 0.02)
    twist = trajectory.twist(t)
    (position, rotation), (vx, vy, vz, wx, wy, wz) = trajectory.pose(t), twist.T
    assert -1e-6 < vz.min() < 0.01  # it stops, and never rolls back
    assert 9 < vz.max() <= 12
    assert (3 < vz.mean() < 8, np.abs(vx).max() < 1.2, np.abs(vy).max() < 0.7) == (True, True, True)
    assert 0.06 < wy.std() < 0.25
    assert 0.3 < np.abs(wy).max() < 0.8
    assert max(wx.std(), wz.std()) < 0.03
    assert np.abs(vz * wy).max() < 3  # sideways [m/s2]
    assert np.abs(position[:, 1]).max() < 0.1  # about its nominal height
    assert (rotation[:, 1, 1] > math.cos(math.radians(4))).all()  # level except for the suspension
    standing = np.abs(twist).max(axis=1) < 1e-9
    assert 0.01 < standing.mean() < 0.3
    heading = np.arctan2(rotation[:, 0, 2], rotation[:, 2, 2])
    assert 0.5 < np.abs(heading).max() < 1.61  # it turns corners but always advances along z


def test_a_car_pitches_when_it_brakes_and_rolls_to_the_outside_of_a_bend():
    trajectory, t = driving(1, 300), np.arange(0, 300, 0.02)
    _, rotation = trajectory.pose(t)
    _, _, vz, _, wy, _ = trajectory.twist(t).T
    nose_down, right_down = rotation[:, 1, 2], rotation[:, 1, 0]
    assert nose_down[np.gradient(vz, t) < -1.8].mean() > 0.005
    assert nose_down[np.gradient(vz, t) > 1.2].mean() < -0.005
    assert right_down[wy * vz > 1.5].mean() < -0.005
    assert right_down[wy * vz < -1.5].mean() > 0.005


def test_a_drive_of_an_hour_still_advances_along_its_first_direction():
    position, rotation = driving(0, 3600).pose(np.arange(0, 3600, 0.5))
    assert np.abs(np.arctan2(rotation[:, 0, 2], rotation[:, 2, 2])).max() < 1.61
    assert position[-1, 2] > 8_000


@pytest.mark.parametrize("seed", range(4))
def test_a_hand_held_camera_moves_like_that_of_poster_6dof(seed):
    trajectory = hand_held(seed, 60)
    t = np.arange(0, 60, 0.005)
    speed, turning = (np.linalg.norm(part, axis=1) for part in np.split(trajectory.twist(t), 2, axis=1))
    position, rotation = trajectory.pose(t)
    assert (0.6 < np.median(speed) < 1.3, 1.7 < np.percentile(speed, 99) < 3.5) == (True, True)
    assert (0.8 < np.median(turning) < 2.5, 6 < np.percentile(turning, 99) < 18) == (True, True)
    assert np.abs(position).max() < 1.5
    assert np.median(rotation[:, 2, 2]) > math.cos(math.radians(30))  # it looks ahead


@pytest.mark.parametrize("make", [driving, hand_held])
def test_a_seed_determines_the_path_and_a_longer_path_begins_like_the_shorter(make):
    t = np.arange(0, 9, 0.1)
    short, long, other = make(5, 10), make(5, 30), make(6, 10)
    np.testing.assert_allclose(short.twist(t), long.twist(t), atol=1e-9)
    np.testing.assert_array_equal(short.twist(t), make(5, 10).twist(t))
    assert np.abs(short.twist(t) - other.twist(t)).max() > 0.1


def test_a_stationary_camera_does_not_move_and_a_slider_only_translates():
    t = np.array([0.0, 5.0, 1e6])
    assert not still().twist(t).any()
    position, rotation = parse_trajectory("slider?vx=0.3").pose(t)
    np.testing.assert_allclose(position, np.outer(t, [0.3, 0, 0]))
    np.testing.assert_array_equal(rotation, np.broadcast_to(np.eye(3), (3, 3, 3)))
    position, rotation = parse_trajectory("rotation?wy=0.5").pose(math.pi)
    np.testing.assert_allclose(position, 0, atol=1e-12)
    np.testing.assert_allclose(rotation[:, 2], [1, 0, 0], atol=1e-12)  # a quarter turn to the right


# --- mounted --------------------------------------------------------------------------------------------------------


def test_a_mounted_camera_is_above_the_ground_and_looks_down_by_its_pitch():
    position, rotation = Mounted(still(), height_m=1.5, pitch_deg=30).pose(0.0)
    np.testing.assert_allclose(position, [0, -1.5, 0])
    np.testing.assert_allclose(rotation[:, 2], [0, 0.5, math.cos(math.radians(30))], atol=1e-12)
    twist = Mounted(parse_trajectory("slider?vz=10"), height_m=1.5, pitch_deg=30).twist(0.0)
    np.testing.assert_allclose(twist, [0, -5, 10 * math.cos(math.radians(30)), 0, 0, 0], atol=1e-12)


@pytest.mark.parametrize(
    ("field", "height_m", "pitch_deg"),
    [("height_m", -1, 0), ("height_m", math.nan, 0), ("pitch_deg", 1, 91), ("pitch_deg", 1, math.nan)],
)
def test_an_impossible_mount_is_refused(field, height_m, pitch_deg):
    with pytest.raises(InvalidField) as refused:
        Mounted(still(), height_m=height_m, pitch_deg=pitch_deg)
    assert refused.value.details["field"] == field


# --- recorded -------------------------------------------------------------------------------------------------------


def test_the_twist_of_a_recorded_path_does_not_depend_on_its_world():
    poses = waving(10)
    trajectory = from_poses(poses)
    poses = Poses(*(column[:1990] for column in poses))
    t_us = poses.t - poses.t[0]
    inner = slice(20, -20)
    np.testing.assert_allclose(trajectory.twist(t_us / 1e6)[inner], twists(poses).twist[inner], atol=0.03)
    position, _ = trajectory.pose(t_us / 1e6)
    np.testing.assert_allclose(  # distances do not depend on the world
        np.linalg.norm(position - position[:1], axis=1),
        np.linalg.norm(poses.position_m - poses.position_m[:1], axis=1),
        atol=0.01,
    )


def test_a_hand_held_recording_is_level_centred_and_looks_ahead_on_average():
    t = np.arange(0, 19, 0.01)
    position, rotation = EACH["recorded"].pose(t)
    np.testing.assert_allclose(position.mean(axis=0), 0, atol=0.2)
    mean = rotation.mean(axis=0)
    np.testing.assert_allclose(mean[:, 1] / np.linalg.norm(mean[:, 1]), [0, 1, 0], atol=0.05)
    assert abs(mean[0, 2]) < 0.05
    assert mean[2, 2] > 0.8


def hilly(n: int = 2000) -> Poses:
    """A car at 10 m/s over hills of 10 m, the camera along the road, pitched down by 6 degrees."""
    t_us = np.arange(n) * 50_000
    t = t_us / 1e6
    slope = np.arctan(0.15 * np.cos(t / 20))
    pitch = slope - math.radians(6)
    position = np.stack([0 * t, -30 * np.sin(t / 20), 10 * t], axis=1)
    return Poses(t_us, position, rotations.exp(np.stack([pitch, 0 * t, 0 * t], axis=1)))


def test_hills_are_removed_from_a_drive_so_that_level_ground_stays_below_it():
    trajectory = from_poses(hilly())
    t = np.arange(0, trajectory.duration_s, 0.1)
    position, rotation = trajectory.pose(t)
    assert np.abs(position[:, 1]).max() < 0.3
    assert np.degrees(np.arccos(rotation[:, 1, 1])).max() < 0.5
    twist = trajectory.twist(t)
    np.testing.assert_allclose(twist[:, :3], np.broadcast_to([0, 0, 10], (t.size, 3)), atol=0.3)
    kept = from_poses(hilly(), flat=False).pose(t)[0]
    assert np.ptp(kept[:, 1]) > 50


@pytest.mark.parametrize("day", [1, 2])
def test_mvsecs_drives_become_paths_over_level_ground_with_their_speed_and_turns(day):
    pytest.importorskip("h5py", reason="h5py is not installed: pip install 'neurove[recordings]'")
    trajectory = parse_trajectory(str(shared(f"mvsec/outdoor_day{day}_odom.h5")))
    assert trajectory.duration_s == pytest.approx({1: 256.9, 2: 610.1}[day], abs=0.1)
    t = np.arange(0, trajectory.duration_s, 0.05)
    position, rotation = trajectory.pose(t)
    _, _, vz, _, wy, _ = trajectory.twist(t).T
    assert vz.mean() == pytest.approx({1: 4.64, 2: 5.66}[day], abs=0.05)
    assert wy.std() == pytest.approx({1: 0.155, 2: 0.117}[day], abs=0.01)
    assert np.abs(position[:, 1]).max() < 0.5
    assert np.degrees(np.arccos(rotation[:, 1, 1])).max() < 6
    path_m = np.linalg.norm(np.diff(position, axis=0), axis=1).sum()
    assert path_m == pytest.approx({1: 1219.6, 2: 3495}[day], rel=0.02)
    np.testing.assert_allclose(
        trajectory.twist(t[::50]), differences(trajectory, t[::50].clip(1e-3, t[-1] - 1e-3), 1e-4), atol=0.02
    )


def test_a_real_hand_held_path_keeps_its_speed():
    trajectory = parse_trajectory(str(shared("trajectories/poster_6dof.csv")) + "?smooth=0.05")
    twist = trajectory.twist(np.arange(0, trajectory.duration_s, 0.005))
    speed, turning = (np.linalg.norm(part, axis=1) for part in np.split(twist, 2, axis=1))
    assert np.percentile(speed, 99) == pytest.approx(2.35, rel=0.05)
    assert np.percentile(turning, 99) == pytest.approx(13.5, rel=0.05)


def test_start_skips_and_seconds_ends_a_recorded_path(tmp_path: Path):
    file = tmp_path / "path.txt"
    file.write_text(tum(waving(10)))
    whole, part = parse_trajectory(str(file)), parse_trajectory(f"{file}?start=2&seconds=3")
    assert (part.name, part.duration_s) == ("path", 3)
    t = np.arange(0.2, 2.9, 0.1)
    np.testing.assert_allclose(part.twist(t), whole.twist(t + 2), atol=0.02)
    assert parse_trajectory(str(file), seconds=4).duration_s == 4


@pytest.mark.parametrize(
    ("field", "change"),
    [
        ("t", lambda p: p._replace(t=p.t[::-1])),
        ("orientation", lambda p: p._replace(orientation=2 * p.orientation)),
        ("t", lambda p: p._replace(t=np.where(np.arange(p.t.size) < 100, p.t, p.t + 600_000))),
        ("poses", lambda p: Poses(*(column[:2] for column in p))),
        ("poses", lambda p: Poses(*(column[:0] for column in p))),
    ],
)
def test_invalid_poses_are_refused(field, change):
    with pytest.raises(InvalidField) as refused:
        from_poses(change(waving(3)))
    assert refused.value.details["field"] == field


def test_a_camera_that_looks_in_all_directions_uses_the_axes_of_its_first_pose():
    t_us = np.arange(0, 10_000_000, 10_000)
    spin = rotations.exp(np.stack([t_us / 1e6 * 2 * np.pi / 5, 0 * t_us, 0 * t_us], axis=1))
    trajectory = from_poses(Poses(t_us, np.zeros((t_us.size, 3)), spin))
    np.testing.assert_allclose(trajectory.pose(0.0)[1], np.eye(3), atol=1e-6)
    np.testing.assert_allclose(trajectory.twist(5.0), [0, 0, 0, 2 * np.pi / 5, 0, 0], atol=1e-3)


# --- names ----------------------------------------------------------------------------------------------------------


def test_every_generated_trajectory_has_a_name():
    for text, name, seconds in (
        ("driving", "driving 0", 600),
        ("driving?seed=3&seconds=20", "driving 3", 20),
        ("handheld?seed=1", "handheld 1", 60),
        ("still?seconds=5", "still", 5),
        ("slider?vx=0.3", "slider", math.inf),
    ):
        trajectory = parse_trajectory(text)
        assert (trajectory.name, trajectory.duration_s) == (name, seconds)
    assert parse_trajectory("driving?seed=3", seconds=7).duration_s == 7


@pytest.mark.parametrize(
    ("text", "field"),
    [
        ("flying", "name"),
        ("", "name"),
        ("no/such/file.txt?start=1", "name"),
        ("driving?seed=-1", "seed"),
        ("driving?seed=1.5", "seed"),
        ("driving?speed=3", "speed"),
        ("driving?seconds=0", "seconds"),
        ("driving?seconds=1e9", "seconds"),
        ("still?wx=1", "wx"),
        ("rotation?wx=fast", "wx"),
        ("rotation?wx=nan", "wx"),
        ("slider?vx=1e3", "vx"),
        ("slider?vx=", "vx"),
    ],
)
def test_an_invalid_trajectory_is_refused_and_the_error_names_the_field(text, field):
    with pytest.raises(InvalidField) as refused:
        parse_trajectory(text)
    assert refused.value.details["field"] == field
    assert refused.value.details["bound"]


@pytest.mark.parametrize(
    ("query", "field"),
    [("start=99", "start"), ("start=-1", "start"), ("smooth=0", "smooth"), ("flat=2", "flat"), ("seed=1", "seed")],
)
def test_a_wrong_parameter_of_a_file_is_refused(tmp_path: Path, query: str, field: str):
    file = tmp_path / "path.txt"
    file.write_text(tum(waving(3)))
    with pytest.raises(InvalidField) as refused:
        parse_trajectory(f"{file}?{query}")
    assert refused.value.details["field"] == field
