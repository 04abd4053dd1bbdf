"""Events and gyroscope together: who is used, rest, offset and disagreement."""

import numpy as np
import pytest

from neurove_core.inertial import state as inertial
from neurove_core.inertial.state import InertialState
from neurove_protocol import Imu
from tests.neurove_core.inertial import units

MOVING_M_S = 1.0


def run(imu, motion, *, windows=120, speed=MOVING_M_S, state=None, refined=True, network=None):
    """The aided estimates of consecutive windows, and the state after them."""
    state, _ = inertial.push(state or InertialState(), Imu.empty())
    at, found = 0, []
    for number in range(windows):
        end_us = 50_000 * (number + 1)
        stop = int(imu.t.searchsorted(end_us + 4_000))
        state, _ = inertial.push(state, imu.span(at, stop))
        at = stop
        seen = units.window(end_us - 50_000, network or motion, speed=speed, refined=refined)
        aided, state = inertial.aid(state, seen)
        found.append(aided)
    return found, state


def test_the_angular_part_is_that_of_the_gyroscope_and_the_linear_part_stays():
    imu = units.samples(units.shaking, 6.1)
    found, _ = run(imu, units.shaking, network=units.still, refined=False)  # a network that is blind to turning
    times = (np.arange(120)[:, None] * 50_000 + np.arange(5) * 10_000 + 5_000).ravel() / 1e6
    angular = np.concatenate([one.twists[:, 3:] for one in found[1:]])
    np.testing.assert_allclose(angular, units.shaking(times)[5:], atol=0.004)
    assert all(one.used and one.twists[:, 2].tolist() == [MOVING_M_S] * 5 for one in found[1:])


def test_the_covariance_holds_with_an_unknown_bias_and_with_a_known_one():
    for known in (False, True):
        errors = []
        for seed in range(20120, 20140):
            true = np.random.default_rng(seed).normal(0, 0.02, 3)
            imu = units.samples(units.shaking, 1.1, bias=tuple(true), noise=0.003, seed=seed)
            state = InertialState()
            if known:
                resting = units.samples(units.still, 1, bias=tuple(true), noise=0.003, start_us=-1_000_000, seed=seed)
                state, _ = inertial.push(state, resting)
                _, state = inertial.aid(state, units.window(-50_000, units.still))
                assert state.bias.known
            found, _ = run(imu, units.shaking, windows=20, state=state)
            sigma = np.sqrt(np.diagonal(found[-1].covariance))[3:]
            errors.append((found[-1].twists[2, 3:] - units.shaking(np.array([0.975]))[0]) / sigma)
        within = (np.abs(errors) < 1.645).mean()
        assert within > 0.8


def test_rest_is_zero_and_teaches_the_bias_which_is_then_taken_off():
    def rest_then_turn(t_s):
        return np.where((t_s < 2)[:, None], 0.0, units.shaking(t_s))

    imu = units.samples(rest_then_turn, 6.1, bias=(0.04, -0.02, 0.01))
    found, state = run(imu, rest_then_turn, speed=0.05)
    assert [one.resting for one in found[10:38]] == [True] * 28
    assert not any(one.resting for one in found[41:])
    assert all(not one.twists.any() for one in found[10:38])
    np.testing.assert_allclose(state.bias.mean_rad_s, (0.04, -0.02, 0.01), atol=1e-3)
    np.testing.assert_allclose(found[-1].twists[2, 3:], units.shaking(np.array([5.975]))[0], atol=0.005)


def test_smooth_travel_is_no_rest_because_the_events_show_speed():
    imu = units.samples(units.still, 3.1)  # a slider, or a very good road
    found, state = run(imu, units.still, windows=60, speed=0.5)
    assert not any(one.resting for one in found)
    assert not state.bias.known


def test_without_samples_the_estimate_of_the_events_stands():
    seen = units.window(0, units.shaking)
    for samples in (Imu.empty(), units.samples(units.shaking, 1, start_us=10**9)):
        state, _ = inertial.push(InertialState(), samples)
        aided, _ = inertial.aid(state, seen)
        assert not aided.used
        assert aided.twists is seen.twists
        assert aided.covariance is seen.covariance


def test_a_replay_gives_the_same_for_any_packets_of_samples():
    imu, rng = units.samples(units.shaking, 4.1), np.random.default_rng(20141)
    whole, _ = run(imu, units.shaking, windows=80)
    state, at, found = InertialState(), 0, []
    for number in range(80):
        stop = int(imu.t.searchsorted(50_000 * (number + 1) + rng.integers(0, 60_000)))  # earlier than needed
        while at < stop:
            size = int(rng.integers(1, 20))
            state, _ = inertial.push(state, imu.span(at, min(at + size, stop)))
            at = min(at + size, stop)
        aided, state = inertial.aid(state, units.window(50_000 * number, units.shaking, speed=MOVING_M_S))
        found.append(aided)
    for one, other in zip(found, whole, strict=True):
        np.testing.assert_array_equal(one.twists, other.twists)
        np.testing.assert_array_equal(one.covariance, other.covariance)


# --- offset and disagreement


@pytest.mark.parametrize("late_us", [-20_000, 0, 12_000, 25_000])
def test_the_time_offset_between_gyroscope_and_events_is_found(late_us):
    imu = units.samples(units.shaking, 8.2, late_us=late_us)
    _, state = run(imu, units.shaking, windows=160)
    assert state.agreement.offset_us == pytest.approx(late_us, abs=2_500)
    assert state.agreement.why == ""
    assert not state.disagrees


WRONG = {
    "sign of y": ((1, -1, 1), (0, 1, 2), "the other way about y"),
    "all signs": ((-1, -1, -1), (0, 1, 2), "the other way about x and y and z"),
    "x and z": ((1, 1, 1), (2, 1, 0), "axes are exchanged"),
    "x, y and z": ((1, 1, 1), (1, 2, 0), "axes are exchanged"),
}


@pytest.mark.parametrize(("signs", "order", "why"), WRONG.values(), ids=WRONG)
def test_a_gyroscope_in_another_frame_is_found_told_and_not_used(signs, order, why):
    imu = units.samples(lambda t_s: units.shaking(t_s)[:, order] * signs, 8.2)
    found, state = run(imu, units.shaking, windows=160)
    assert why in state.agreement.why
    assert state.disagrees
    assert not found[-1].used
    np.testing.assert_array_equal(found[-1].twists, units.window(159 * 50_000, units.shaking, speed=MOVING_M_S).twists)


def test_a_gyroscope_that_is_badly_timed_is_found():
    _, state = run(units.samples(units.shaking, 8.2, late_us=60_000), units.shaking, windows=160)
    assert state.disagrees
    assert "60 ms late" in state.agreement.why


def test_a_gyroscope_that_is_mended_is_used_again():
    _, state = run(units.samples(lambda t_s: -units.shaking(t_s), 8.2), units.shaking, windows=160)
    assert state.disagrees
    good, at = units.samples(units.shaking, 17, start_us=8_200_000), 0
    for number in range(164, 480):
        stop = int(good.t.searchsorted(50_000 * (number + 1) + 4_000))
        state, _ = inertial.push(state, good.span(at, stop))
        at = stop
        aided, state = inertial.aid(state, units.window(50_000 * number, units.shaking, speed=MOVING_M_S))
    assert not state.disagrees
    assert aided.used


def test_a_network_that_is_blind_to_an_axis_does_not_accuse_the_gyroscope():
    rng = np.random.default_rng(20142)

    def only_yaw(t_s):  # some yaw, and noise about the other axes
        return units.shaking(t_s) * (0, 0.6, 0) + rng.normal(0, 0.05, (t_s.size, 3))

    _, state = run(units.samples(units.shaking, 8.2), units.shaking, windows=160, refined=False, network=only_yaw)
    assert not state.disagrees


def test_nothing_is_said_about_a_camera_that_hardly_turns():
    def straight(t_s):
        return 0.02 * units.shaking(t_s)

    _, state = run(units.samples(straight, 8.2), straight, windows=160)
    assert state.agreement == inertial.Agreement()
    assert not state.disagrees


@pytest.mark.parametrize("seed", range(20150, 20154))
def test_any_valid_samples_give_a_finite_estimate_in_bounded_memory(seed):
    rng, state = np.random.default_rng(seed), InertialState()
    for number in range(400):
        now_us, size = number * 10_000, rng.choice([1e-3, 1.0, 1e3])
        jump_us = int(rng.choice([0, -5_000_000, 3_000_000, 2**61, -(2**61)], p=[0.9, *[0.025] * 4]))
        n = int(rng.integers(1, 30))
        t = np.sort(now_us + jump_us + rng.integers(0, 20_000, n))
        accel, gyro = (np.clip(rng.normal(0, size, (n, 3)), -1e3, 1e3) for _ in range(2))
        state, _ = inertial.push(state, Imu(t, accel, gyro))
        if number % 5 == 4:
            aided, state = inertial.aid(state, units.window(now_us - 40_000, units.shaking, speed=1.0))
            assert np.isfinite(aided.twists).all()
            assert (np.diagonal(aided.covariance) > 0).all()
    assert state.samples.n <= 8192
    assert state.track.grid_us.size <= 4000
