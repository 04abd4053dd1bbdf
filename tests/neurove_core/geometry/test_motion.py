"""From poses to twists: exact for constant twists, independent of the world frame, checked on real odometry."""

import numpy as np
import pytest

from neurove_core.geometry import rotations
from neurove_core.geometry.motion import MAX_GAP_US, Poses, Twists, filter_for, interpolate_poses, smoothed, twists
from neurove_protocol.errors import InvalidField
from tests.recordings import shared

h5py = pytest.importorskip("h5py", reason="h5py is not installed: pip install 'neurove[recordings]'")


def unit(rng: np.random.Generator, *shape: int) -> np.ndarray:
    q = rng.normal(size=(*shape, 4))
    return q / np.linalg.norm(q, axis=-1, keepdims=True)


def screw_motion(twist: np.ndarray, t_us: np.ndarray, seed: int = 0) -> Poses:
    """Poses of a camera with a constant twist at these times, from a random start pose."""
    rng = np.random.default_rng(seed)
    q0, p0 = unit(rng), rng.normal(size=3)
    q, p = rotations.pose_of(np.asarray(twist) * (t_us / 1e6)[:, None])
    return Poses(t_us, p0 + rotations.turn(q0, p), rotations.product(q0, q))


def wobble(t_us: np.ndarray) -> Poses:
    """A smooth motion whose twist is not constant."""
    t = t_us[:, None] / 1e6
    position = np.sin(t * [1.0, 1.7, 2.3] + [0.0, 1.0, 2.0])
    return Poses(t_us, position, rotations.exp(0.8 * np.sin(t * [2.1, 0.9, 1.3])))


def mvsec(day: int) -> tuple[Poses, np.ndarray, np.ndarray]:
    """Odometry of outdoor_day, the velocity stored with it (N, 3) [m/s], and unrounded times (N,) [s]."""
    with h5py.File(shared(f"mvsec/outdoor_day{day}_odom.h5")) as file:
        t_s = file["ts"][:]
        return Poses(np.rint(t_s * 1e6).astype(np.int64), file["poss"][:], file["rots"][:]), file["vs"][:], t_s


def rms(difference: np.ndarray) -> np.ndarray:
    return np.sqrt(np.mean(difference**2, axis=0))


# --- rotations ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("angle", [0.0, 1e-9, 1e-4, 0.5, 3.0, np.pi - 1e-6])
def test_log_is_the_inverse_of_exp_below_180_degrees(angle):
    axes = np.random.default_rng(1).normal(size=(50, 3))
    screw = np.concatenate([axes[::-1], axes / np.linalg.norm(axes, axis=1, keepdims=True) * angle], axis=1)
    np.testing.assert_allclose(rotations.screw_of(*rotations.pose_of(screw)), screw, atol=1e-8)


def test_matrices_and_quaternions_describe_the_same_rotations_at_180_degrees_too():
    q = np.concatenate([unit(np.random.default_rng(2), 200), np.eye(4)])
    m = rotations.matrix_of(q)
    back = rotations.quaternion_of(m)
    np.testing.assert_allclose(np.abs((q * back).sum(-1)), 1, atol=1e-12)
    v = np.array([0.3, -2.0, 1.0])
    np.testing.assert_allclose(m @ v, rotations.turn(q, v), atol=1e-12)
    np.testing.assert_allclose(m @ np.swapaxes(m, -1, -2), np.broadcast_to(np.eye(3), m.shape), atol=1e-12)
    ab = rotations.product(q[:100], q[100:200])
    np.testing.assert_allclose(rotations.matrix_of(ab), m[:100] @ m[100:200], atol=1e-12)


# --- twists ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("sampling", ["even", "uneven"])
@pytest.mark.parametrize("twist", [(0, 0, 0, 0, 0, 0), (1.5, -0.2, 8, 0, 0, 0), (0.3, 0.1, -2, 1.5, -3, 2)], ids=str)
def test_a_constant_twist_is_recovered_exactly_and_at_the_ends_too(twist, sampling):
    t_us = np.arange(0, 2_000_000, 10_000)
    if sampling == "uneven":
        t_us = t_us + np.random.default_rng(3).integers(0, 9_999, t_us.size)
    got = twists(screw_motion(np.array(twist), t_us))
    np.testing.assert_array_equal(got.t, t_us)
    np.testing.assert_allclose(got.twist, np.broadcast_to(twist, (t_us.size, 6)), atol=2e-5)


def test_the_filter_has_the_documented_gain():
    t_us = np.arange(0, 1_500_000, 1_000)
    position = np.zeros((t_us.size, 3))
    for frequency_hz, response in ((3.0, 0.91), (8.0, 0.49)):
        position[:, 2] = np.sin(2 * np.pi * frequency_hz * t_us / 1e6) / (2 * np.pi * frequency_hz)
        still = np.broadcast_to([0.0, 0, 0, 1], (t_us.size, 4))
        vz = twists(Poses(t_us, position, still), filter_s=0.1).twist[100:-100, 2]
        assert np.abs(vz).max() == pytest.approx(response, abs=0.01)


@pytest.mark.parametrize("seed", range(3))
def test_the_twist_does_not_depend_on_the_world_frame(seed):
    rng = np.random.default_rng(seed)
    poses = wobble(np.arange(0, 1_000_000, 5_000))
    q, p = unit(rng), rng.normal(size=3) * 100
    moved = Poses(
        poses.t, p + rotations.turn(q, poses.position_m), rotations.product(q, poses.orientation) * rng.choice([-1, 1])
    )
    np.testing.assert_allclose(twists(moved).twist, twists(poses).twist, atol=1e-9)


def test_a_camera_mounted_elsewhere_on_the_body_has_the_twist_of_the_body_at_that_place():
    rng = np.random.default_rng(5)
    poses = wobble(np.arange(0, 1_000_000, 5_000))
    q, p = unit(rng), rng.normal(size=3)
    mounted = Poses(
        poses.t,
        poses.position_m + rotations.turn(poses.orientation, p),
        rotations.product(poses.orientation, q),
    )
    v, w = np.split(twists(poses).twist, 2, axis=1)
    back = rotations.inverse(q)
    want = np.concatenate([rotations.turn(back, v + np.cross(w, p)), rotations.turn(back, w)], axis=1)
    np.testing.assert_allclose(twists(mounted).twist, want, atol=2e-3)


def test_pose_noise_is_filtered_and_smoothed_poses_are_closer_to_the_trajectory():
    rng = np.random.default_rng(6)
    clean = wobble(np.arange(0, 5_000_000, 5_000))
    noisy = Poses(
        clean.t,
        clean.position_m + rng.normal(0, 1e-3, (clean.t.size, 3)),
        rotations.product(clean.orientation, rotations.exp(rng.normal(0, 1e-3, (clean.t.size, 3)))),
    )
    difference = twists(noisy).twist - twists(clean).twist
    assert rms(difference[10:-10]).max() < 0.01  # differences of neighbouring poses would have 0.28
    got = smoothed(noisy)
    assert rms(got.position_m - clean.position_m).max() < 0.5e-3
    turned = rotations.log(rotations.product(rotations.inverse(clean.orientation), got.orientation))
    assert rms(turned).max() < 0.5e-3


def test_a_long_trajectory_fitted_in_blocks_has_no_error_between_them():
    t_us = np.arange(36_000) * 10_000
    t_us[20_000:] += 20_000_000
    twist = np.array([1.0, 0, 5, 0, 0.3, 0])
    np.testing.assert_allclose(twists(screw_motion(twist, t_us)).twist, np.broadcast_to(twist, (36_000, 6)), atol=1e-3)


def test_the_twist_is_nan_where_there_are_too_few_poses_but_not_next_to_a_gap():
    twist = np.array([0.0, 0, 2, 0, 0.5, 0])
    t_us = np.concatenate([np.arange(0, 500_000, 10_000), [1_000_000], np.arange(1_500_000, 2_000_000, 10_000)])
    got = twists(screw_motion(twist, t_us))
    alone = t_us == 1_000_000
    assert np.isnan(got.twist[alone]).all()
    np.testing.assert_allclose(got.twist[~alone], np.broadcast_to(twist, (100, 6)), atol=1e-5)
    for n in range(3):
        assert np.isnan(twists(screw_motion(twist, np.arange(n) * 10_000)).twist).all()


def test_the_filter_spans_ten_samples_but_at_least_a_tenth_of_a_second():
    for step_us, want_s in ((50_000, 0.5), (10_000, 0.1), (5_000, 0.1), (200_000, 2.0)):
        assert filter_for(wobble(np.arange(0, 3_000_000, step_us))) == pytest.approx(want_s)


@pytest.mark.parametrize(
    ("field", "change"),
    [
        ("t", lambda p: p._replace(t=p.t[[0, 2, 1, *range(3, p.t.size)]])),
        ("t", lambda p: p._replace(t=p.t[[0, 1, 1, *range(3, p.t.size)]])),
        ("orientation", lambda p: p._replace(orientation=p.orientation * 1.1)),
        ("orientation", lambda p: p._replace(orientation=p.orientation * 0)),
        ("orientation", lambda p: p._replace(orientation=p.orientation * np.nan)),
        ("position_m", lambda p: p._replace(position_m=p.position_m * np.inf)),
    ],
)
def test_an_invalid_trajectory_is_refused_and_the_wrong_pose_is_named(field, change):
    with pytest.raises(InvalidField) as refused:
        twists(change(wobble(np.arange(0, 1_000_000, 10_000) + 10_000)))
    assert refused.value.details["field"] == field
    assert refused.value.message.startswith("pose ")


@pytest.mark.parametrize("filter_s", [0.0, -1.0, float("nan"), float("inf")])
def test_a_filter_length_that_is_not_positive_and_finite_is_refused(filter_s):
    with pytest.raises(InvalidField, match="filter_s"):
        twists(wobble(np.arange(0, 100_000, 10_000)), filter_s=filter_s)


# --- interpolation --------------------------------------------------------------------------------------------------


def test_twists_are_interpolated_linearly_and_unknown_outside_the_samples():
    rows = np.arange(12.0).reshape(2, 6)
    got = Twists(np.array([100, 200]), rows).at(np.array([99, 100, 125, 200, 201]))
    assert np.isnan(got[[0, 4]]).all()
    np.testing.assert_allclose(got[1:4], [rows[0], 0.75 * rows[0] + 0.25 * rows[1], rows[1]])


def test_an_unknown_sample_makes_only_the_times_next_to_it_unknown():
    rows = np.ones((4, 6))
    rows[1] = np.nan
    got = Twists(np.array([0, 10, 20, 30]), rows).at(np.array([0, 5, 10, 15, 20, 25, 30]))
    np.testing.assert_array_equal(np.isnan(got[:, 0]), [False, True, True, True, False, False, False])


def test_nothing_is_interpolated_over_a_gap():
    t = np.array([0, MAX_GAP_US, 2 * MAX_GAP_US + 1])
    twist = Twists(t, np.ones((3, 6)))
    poses = Poses(t, np.zeros((3, 3)), np.broadcast_to([0.0, 0, 0, 1], (3, 4)))
    at = np.array([10, MAX_GAP_US, MAX_GAP_US + 10, 2 * MAX_GAP_US + 1])
    want = [False, False, True, False]
    np.testing.assert_array_equal(np.isnan(twist.at(at)[:, 0]), want)
    np.testing.assert_array_equal(np.isnan(interpolate_poses(poses, at).position_m[:, 0]), want)
    np.testing.assert_array_equal(np.isnan(interpolate_poses(poses, at).orientation[:, 0]), want)
    assert np.isfinite(twist.at(at, max_gap_us=10 * MAX_GAP_US)).all()


def test_one_sample_is_known_only_at_its_own_time_and_no_samples_at_none():
    for n, known in ((0, 0), (1, 1)):
        twist = Twists(np.arange(n), np.ones((n, 6)))
        poses = screw_motion(np.ones(6), np.arange(n))
        at = np.array([-1, 0, 1])
        assert np.isfinite(twist.at(at)[:, 0]).sum() == known
        assert np.isfinite(interpolate_poses(poses, at).position_m[:, 0]).sum() == known
        assert np.isfinite(interpolate_poses(poses, at).orientation[:, 0]).sum() == known


def test_between_two_poses_the_camera_rotates_at_a_constant_rate_along_the_shorter_arc():
    twist = np.array([0.0, 0, 0, 1.0, 2.0, -2.0])
    poses = screw_motion(twist, np.array([0, 400_000]))
    poses = poses._replace(orientation=poses.orientation * [[1], [-1]])  # the same rotation
    want = screw_motion(twist, np.array([0, 100_000, 300_000]))
    got = interpolate_poses(poses, want.t)
    np.testing.assert_allclose(np.abs((got.orientation * want.orientation).sum(-1)), 1, atol=1e-12)


# --- real odometry --------------------------------------------------------------------------------------------------


def euler_zyx(q: np.ndarray) -> np.ndarray:
    """Roll, pitch, yaw [rad] of the rotation z(yaw) y(pitch) x(roll)."""
    m = rotations.matrix_of(q)
    return np.stack(
        [
            np.arctan2(m[..., 2, 1], m[..., 2, 2]),
            np.arcsin(np.clip(-m[..., 2, 0], -1, 1)),
            np.arctan2(m[..., 1, 0], m[..., 0, 0]),
        ],
        axis=-1,
    )


def steps(poses: Poses) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """From each pose to the next: relative rotation, relative position in the frame of the first, dt [s]."""
    back = rotations.inverse(poses.orientation[:-1])
    q = rotations.product(back, poses.orientation[1:])
    return q, rotations.turn(back, np.diff(poses.position_m, axis=0)), np.diff(poses.t)[:, None] / 1e6


@pytest.mark.parametrize("day", [1, 2])
def test_angular_velocity_is_the_relative_rotation_over_dt_and_not_the_slope_of_euler_angles(day):
    poses, _, _ = mvsec(day)
    q, _, dt = steps(poses)
    body = rotations.log(q) / dt
    assert rms(euler_zyx(q) / dt - body).max() < 2.5e-4
    slope = np.diff(np.unwrap(euler_zyx(poses.orientation), axis=0), axis=0) / dt
    assert rms(slope - body).max() > 0.3


def running_mean(values: np.ndarray, half: int, *, in_place: bool) -> np.ndarray:
    """The mean of each row and its neighbours; in place, the means of earlier rows enter the later ones."""
    out = values.copy()
    source = out if in_place else values
    for i in range(len(out)):
        out[i] = source[max(0, i - half) : i + half + 1].mean(axis=0)
    return out


@pytest.mark.parametrize(("day", "apart_m_s"), [(1, (0.029, 0.025, 0.082)), (2, (0.014, 0.018, 0.039))])
def test_mvsecs_stored_velocities_are_smoothed_in_place_and_therefore_differ_from_the_poses(day, apart_m_s):
    poses, stored, t_s = mvsec(day)
    _, moved, _ = steps(poses)
    raw = np.concatenate([np.zeros((1, 3)), moved / np.diff(t_s)[:, None]])
    inner = slice(12, -12)  # how the data set treats the ends is unknown
    assert np.abs(running_mean(raw, 10, in_place=True) - stored)[inner].max() < 1e-8  # the quaternions are rounded
    clean = running_mean(raw, 10, in_place=False)
    np.testing.assert_allclose(rms((clean - stored)[inner]), apart_m_s, atol=5e-4)
    ours = twists(poses, filter_s=1.0).twist[:, :3]
    assert (rms((ours - stored)[inner]) > 0.9 * np.array(apart_m_s)).all()


def test_the_slider_moves_only_to_the_right():
    rows = np.loadtxt(shared("slider_depth/groundtruth.txt"))
    got = twists(Poses(np.rint(rows[:, 0] * 1e6).astype(np.int64), rows[:, 1:4], rows[:, 4:])).twist
    assert (0.20 < got[0, 0] < 0.24, 0.30 < np.median(got[:, 0]) < 0.34) == (True, True)
    assert np.abs(got[:, 1:]).max() < 1e-9
