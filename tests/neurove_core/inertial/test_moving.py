"""The bias of a gyroscope is learned while the camera moves, by refined windows and by gravity, and by nothing else."""

import numpy as np
import pytest

from neurove_core.inertial import moving
from neurove_core.inertial import state as inertial
from neurove_core.inertial.bias import UNKNOWN_RAD_S, Bias
from neurove_core.inertial.moving import Seen, Tilt
from neurove_core.inertial.state import InertialState
from tests.neurove_core.inertial import units

BIAS = (0.04, -0.03, 0.02)
WINDOW_US = 50_000


def gently(t_s):
    return 0.2 * units.shaking(t_s)


def state_after(seconds, *, refined, motion=units.shaking, events=None, bias=BIAS):
    """The state after a camera has moved with a gyroscope of some bias."""
    imu, state, at = units.samples(motion, seconds + 0.1, bias=bias, noise=0.003), InertialState(), 0
    for number in range(round(seconds * 20)):
        stop = int(imu.t.searchsorted(WINDOW_US * (number + 1)))
        state, _ = inertial.push(state, imu.span(at, stop))
        at = stop
        seen = units.window(WINDOW_US * number, events or motion, speed=1.0, refined=refined)
        _, state = inertial.aid(state, seen)
    return state


def test_refined_windows_teach_the_bias_without_rest():
    state = state_after(20, refined=True, motion=gently)
    assert not state.bias.rested
    off = np.abs(state.bias.mean_rad_s - BIAS)
    assert (off < 0.5 * np.abs(BIAS)).all()
    assert (off < 2 * np.sqrt(state.bias.variance)).all()
    assert (state.bias.variance < 0.4 * UNKNOWN_RAD_S**2).all()


def test_a_slow_pan_that_the_network_does_not_see_does_not_become_bias():
    def pan(t_s):
        return np.tile([0.0, 0.1, 0.0], (t_s.size, 1)) + 0.2 * units.shaking(t_s)

    state = state_after(10, refined=False, motion=pan, events=units.still, bias=(0.0, 0.0, 0.0))
    np.testing.assert_array_equal(state.bias.mean_rad_s, 0.0)
    np.testing.assert_allclose(state.bias.variance, UNKNOWN_RAD_S**2, rtol=0.01)


def test_a_difference_that_is_too_large_for_a_bias_teaches_nothing():
    state = state_after(3, refined=True, bias=(0.0, 2.0, 0.0))
    assert np.abs(state.bias.mean_rad_s).max() < 0.02


def test_gravity_alone_shows_the_bias_of_the_level_axes_and_not_that_of_the_vertical_one():
    """A camera that accelerates and turns in bends, so that its accelerometer shows more than gravity."""
    bias, tilt, true = Bias(), Tilt(), np.array(BIAS)
    for number in range(400):
        t_s = (number + 0.5) * 0.05
        speed, rate = 5 + 2 * np.sin(t_s), 2 * np.cos(t_s)
        yaw = np.array([0.0, 0.3 * np.sin(0.5 * t_s), 0.0])
        velocity = np.array([0.0, 0.0, speed])
        force = np.array([0.0, -9.81, rate]) + np.cross(yaw, velocity)
        seen = Seen((number + 1) * WINDOW_US, WINDOW_US, yaw + true, force, velocity, None, np.full(3, 1e-3))
        bias, tilt = moving.learned(bias, tilt, seen)
    off = np.abs(bias.mean_rad_s - true)
    assert off[0] < 0.006
    assert off[2] < 0.006
    assert off[1] > 0.02
    assert bias.variance[1] > 0.8 * UNKNOWN_RAD_S**2
    np.testing.assert_allclose(tilt.force_m_s2, [0.0, -9.81, 0.0], atol=0.5)


def driven(seconds, tilt_rad, vehicle, braking_m_s2=0.0, bias=(0.02, 0.0, -0.015), state=None):
    """The bias and the tilt after a straight drive of a camera that no event shows to turn.

    Args:
        seconds: of the drive.
        tilt_rad: its angle of pitch by time [s].
        vehicle: whether the camera is on a vehicle, by time [s].
        braking_m_s2: change of the speed, now faster, now slower, that its velocities do not show.
        bias: of the gyroscope [rad/s].
        state: bias and tilt at the start.
    """
    found, tilt = state or (Bias(), Tilt())
    for number in range(round(seconds * 20)):
        t_s = (number + 0.5) * 0.05
        angle = tilt_rad(t_s)
        turn = np.array([(tilt_rad(t_s + 0.025) - tilt_rad(t_s - 0.025)) / 0.05, 0.0, 0.0])
        force = np.array([0.0, -9.81 * np.cos(angle), 9.81 * np.sin(angle) + braking_m_s2 * np.sin(1.2 * t_s)])
        at_us = tilt.end_us + WINDOW_US
        velocity = np.array([0.0, 0.0, 8.0])
        seen = Seen(at_us, WINDOW_US, turn + bias, force, velocity, None, np.full(3, 1e-3), vehicle(t_s))
        found, tilt = moving.learned(found, tilt, seen)
    return found, tilt


def test_the_bounded_tilt_of_a_vehicle_shows_the_bias_of_the_level_axes_while_it_brakes():
    def swaying(t_s):
        return 0.01 * np.sin(2 * np.pi * t_s)

    true = np.array([0.02, 0.0, -0.015])
    off = {}
    for vehicle in (False, True):
        bias, _ = driven(4, swaying, lambda _, on=vehicle: on, braking_m_s2=1.0)
        off[vehicle] = np.abs(bias.mean_rad_s - true)
        assert (off[vehicle] < 3 * np.sqrt(bias.variance)).all()
    assert (off[True][[0, 2]] < 0.004).all()
    assert (off[True][[0, 2]] < 0.5 * off[False][[0, 2]]).all()
    assert off[True][1] < 1e-3  # the vertical axis has no bias, and nothing says that it has


def test_a_ramp_is_a_new_slope_and_no_bias():
    def ramp(t_s):
        return 0.1 * np.clip(t_s - 10, 0, 1)

    before, _ = driven(10, ramp, lambda _: True)
    after, tilt = driven(14, ramp, lambda _: True)
    assert np.abs(after.mean_rad_s - before.mean_rad_s).max() < 0.003
    np.testing.assert_allclose(tilt.average_m_s2, tilt.force_m_s2, atol=0.3)
    assert abs(tilt.force_m_s2[2]) > 0.8


def test_a_camera_that_is_taken_from_its_vehicle_tilts_as_it_likes():
    def leaning(t_s):
        return 0.05 * max(0.0, t_s - 5)

    on_vehicle = driven(5, leaning, lambda _: True)
    bias, tilt = driven(10, leaning, lambda t_s: t_s < 5)
    assert on_vehicle[1].average_m_s2 is not None
    assert tilt.average_m_s2 is None
    assert np.abs(bias.mean_rad_s - on_vehicle[0].mean_rad_s).max() < 0.003
    assert np.linalg.eigvalsh(tilt.covariance).min() > -1e-12


@pytest.mark.parametrize("gap_us", [200_000, 5_000_000, -1_000_000])
def test_a_gap_does_not_turn_what_is_known_into_something_wrong(gap_us):
    bias, tilt, rng = Bias(), Tilt(), np.random.default_rng(20160)
    at_us = 10_000_000
    for number in range(600):
        at_us += WINDOW_US if number != 300 else gap_us
        turn = np.array([0.0, rng.normal(0, 0.3), 0.0])  # about gravity, which stays where it is
        gravity = np.array([0.0, -9.81, 0.0]) + rng.normal(0, 0.3, 3)
        seen = Seen(at_us, WINDOW_US, turn + BIAS, gravity, np.zeros(3), turn, np.full(3, 1e-3))
        bias, tilt = moving.learned(bias, tilt, seen)
        assert np.linalg.eigvalsh(tilt.covariance).min() > -1e-12
    assert (bias.variance > 0).all()
    assert (np.abs(bias.mean_rad_s - BIAS) < 3 * np.sqrt(bias.variance)).all()


def test_a_bias_that_motion_taught_is_dropped_when_the_gyroscope_disagrees():
    state = state_after(10, refined=True)._replace(doubts=2)
    assert state.bias.mean_rad_s.any()
    _, after = inertial.aid(state, units.window(9_950_000, units.shaking, speed=1.0))
    assert after.disagrees
    np.testing.assert_array_equal(after.bias.mean_rad_s, 0.0)
    assert after.bias.at_us is None
