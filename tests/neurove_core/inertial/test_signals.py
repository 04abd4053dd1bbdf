"""The parts that read samples: buffer, rates over bins, rest and bias."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from neurove_core.inertial import bias, buffer, gyro, rest
from neurove_core.inertial.bias import REST_RAD_S, UNKNOWN_RAD_S, Bias
from neurove_protocol import Imu
from tests.neurove_core.inertial import units

EDGES = np.arange(100_000, 150_001, 10_000)


# --- buffer


@given(st.lists(st.integers(1, 400), min_size=1, max_size=20))
def test_the_buffer_keeps_the_newest_samples_in_order_for_any_packets(sizes):
    whole = units.samples(units.shaking, sum(sizes) / 500)
    kept, at = Imu.empty(), 0
    for size in sizes:
        kept, late, restarted = buffer.push(kept, whole.span(at, at + size))
        assert (late, restarted) == (0, False)
        at += size
        assert kept.t[-1] - kept.t[0] <= buffer.KEPT_US
        assert kept.n <= buffer.KEPT_SAMPLES
        np.testing.assert_array_equal(kept.gyro_rad_s, whole.gyro_rad_s[at - kept.n : at])


def test_late_samples_are_left_out_and_counted_and_a_clock_that_was_reset_begins_anew():
    imu = units.samples(units.still, 2)
    kept = buffer.push(Imu.empty(), imu).samples
    again = buffer.push(kept, imu.span(990, 1000))
    assert (again.late, again.samples.n) == (9, kept.n + 1)  # the last one is of the same time
    anew = buffer.push(kept, units.samples(units.still, 0.1))
    assert (anew.restarted, anew.samples.n) == (True, 50)


# --- rates


@pytest.mark.parametrize("rate_hz", [200, 500, 1000])
def test_the_rates_of_bins_are_the_means_of_the_motion(rate_hz):
    imu = units.samples(units.shaking, 0.3, rate_hz=rate_hz, noise=0)
    found = gyro.rates(imu, EDGES, 0.002)
    fine = np.linspace(0.1, 0.15, 5001)
    expected = units.shaking(fine[:-1] + 5e-6).reshape(5, 1000, 3).mean(1)
    np.testing.assert_allclose(found.gyro_rad_s, expected, atol=2e-4)


def test_samples_that_are_late_for_the_window_are_extrapolated_with_more_variance_up_to_a_limit():
    imu = units.samples(units.shaking, 0.3)
    whole = gyro.rates(imu, EDGES, 0.002)
    last = int(imu.t.searchsorted(143_000))
    some = gyro.rates(imu.span(0, last), EDGES, 0.002)
    assert some.extrapolated_us > 0
    assert (some.variance > whole.variance).all()
    error = np.abs(some.gyro_rad_s - whole.gyro_rad_s)
    assert error[:4].max() < 1e-3
    assert error[4].max() < 3 * np.sqrt(some.variance.max())
    assert gyro.rates(imu.span(0, int(imu.t.searchsorted(139_000))), EDGES, 0.002) is None


def test_without_samples_or_with_a_gap_there_is_no_rate():
    imu = units.samples(units.shaking, 0.3)
    early, late = imu.span(0, int(imu.t.searchsorted(110_000))), imu.span(int(imu.t.searchsorted(140_000)), imu.n)
    assert gyro.rates(Imu.empty(), EDGES, 0.002) is None
    assert gyro.rates(early, EDGES, 0.002) is None
    assert gyro.rates(late, EDGES, 0.002) is None
    gap = Imu(*(np.concatenate(columns) for columns in zip(early, late, strict=True)))
    assert gyro.rates(gap, EDGES, 0.002) is None


# --- rest


@pytest.mark.parametrize("seed", range(20101, 20111))
def test_a_unit_that_does_not_move_is_still_and_shows_its_bias_and_noise(seed):
    imu = units.samples(units.still, 0.5, bias=(0.05, -0.03, 0.01), noise=0.003, accel_noise=0.05, seed=seed)
    found = rest.still(imu, 500_000)
    np.testing.assert_allclose(found.gyro_rad_s, (0.05, -0.03, 0.01), atol=1e-3)
    assert found.noise_rad_s == pytest.approx(0.003, rel=0.2)


MOTIONS = {
    "hand": lambda t: 0.03 * np.sin(8 * t[:, None] + np.arange(3)),
    "slow swing": lambda t: np.outer(0.02 * np.sin(3 * t), (0, 1, 0)),
    "speeding up a turn": lambda t: np.outer(0.03 * t, (0, 1, 0)),
    "steady turn": lambda t: np.outer(np.ones_like(t), (0, 0.3, 0)),
}


@pytest.mark.parametrize("motion", MOTIONS.values(), ids=MOTIONS)
def test_a_motion_is_not_still(motion):
    assert rest.still(units.samples(motion, 0.5), 500_000) is None


def test_an_acceleration_is_not_still():
    imu = units.samples(units.still, 0.5)
    speeding = imu.accel_m_s2 + np.outer(imu.t / 1e6, (0, 0, 1.0))
    assert rest.still(imu._replace(accel_m_s2=speeding), 500_000) is None
    assert rest.still(imu._replace(accel_m_s2=imu.accel_m_s2 * 0.5), 500_000) is None  # falling, or no gravity
    assert rest.still(imu._replace(accel_m_s2=imu.accel_m_s2 + np.array([0, 0, 4.5])), 500_000) is None


def test_few_samples_do_not_tell():
    imu = units.samples(units.still, 0.5)
    assert rest.still(imu, 0) is None
    assert rest.still(imu.span(150, imu.n), 500_000) is None
    assert rest.still(imu.span(0, 120), 500_000) is None


# --- bias


def test_the_bias_is_unknown_before_a_rest_and_less_certain_long_after():
    unknown = Bias()
    assert not unknown.known
    assert np.sqrt(unknown.variance_at(10**9)).tolist() == [UNKNOWN_RAD_S] * 3
    known = bias.learned(unknown, np.array([0.05, 0.0, -0.02]), 150, 0.002, 1_000_000)
    np.testing.assert_allclose(known.mean_rad_s, (0.05, 0.0, -0.02))
    sigmas = [float(np.sqrt(known.variance_at(1_000_000 + seconds * 1_000_000)).max()) for seconds in (0, 60, 10**6)]
    assert sigmas[0] < 0.001 < sigmas[1] * 2 < sigmas[2] == pytest.approx(UNKNOWN_RAD_S)


def test_the_error_of_a_bias_that_motion_taught_is_smaller_than_the_filter_says_and_of_a_rested_one_larger():
    unknown, taught = Bias(), Bias(variance=np.full(3, 0.01**2), at_us=0)
    np.testing.assert_allclose(unknown.error_variance_at(0), UNKNOWN_RAD_S**2)
    assert (taught.error_variance_at(0) < 0.5 * taught.variance_at(0)).all()
    assert (np.diff(taught.error_variance_at(0)) < 0).all()  # pitch, yaw, roll
    assert (taught.error_variance_at(0) < taught.error_variance_at(10**9)).all()
    rested = taught._replace(rested=True)
    np.testing.assert_allclose(rested.error_variance_at(0), rested.variance_at(0) + REST_RAD_S**2)


def test_more_time_at_rest_makes_the_bias_more_exact():
    rng, true = np.random.default_rng(20112), np.array([0.02, -0.01, 0.005])
    found = Bias()
    for number in range(100):
        mean = true + rng.normal(0, 0.003 / 5, 3)
        found = bias.learned(found, mean, 25, 0.003, number * 50_000)
    np.testing.assert_allclose(found.mean_rad_s, true, atol=4e-4)
