"""The bins of a gyroscope that turns smoothly have less noise; a motion that is not smooth stays as it was measured."""

import numpy as np
import pytest

from neurove_core.inertial import gyro, smooth
from tests.neurove_core.inertial import units

NOISE_RAD_S = 0.003


def smoothly(t_s):
    return 0.1 * units.shaking(t_s)


def jerking(t_s):
    return np.outer(np.where(t_s < 0.955, 0.0, 0.5), (1.0, 0.0, 0.0))


def vibrating(t_s):
    return np.outer(0.05 * np.sin(2 * np.pi * 25 * t_s), (1.0, 0.5, -1.0))


def errors(motion, noise=NOISE_RAD_S, seconds=20, rate_hz=500):
    """Errors (W, n, 3) of the rates of many windows, as measured and smoothed; truth from samples without noise."""
    imu = units.samples(motion, seconds, noise=noise, rate_hz=rate_hz)
    exact = units.samples(motion, seconds, noise=0, rate_hz=rate_hz)
    measured, less_noise = [], []
    for start_us in range(100_000, int(imu.t[-1]) - 50_000, 50_000):
        edges_us = np.arange(start_us, start_us + 50_001, 10_000)
        found, truth = gyro.rates(imu, edges_us, noise), gyro.rates(exact, edges_us, noise).gyro_rad_s
        measured.append(found.gyro_rad_s - truth)
        less_noise.append(gyro.smooth_rates(imu, edges_us, found).gyro_rad_s - truth)
    return np.array(measured), np.array(less_noise)


def rms(errors_rad_s):
    return np.sqrt((errors_rad_s**2).mean())


@pytest.mark.parametrize("motion", [units.still, smoothly, units.shaking])
@pytest.mark.parametrize("rate_hz", [200, 500])
def test_a_smooth_turn_has_less_noise(motion, rate_hz):
    measured, less_noise = errors(motion, rate_hz=rate_hz)
    assert rms(less_noise) < 0.8 * rms(measured)
    assert np.abs(less_noise.mean((0, 1))).max() < 2e-4


@pytest.mark.parametrize("motion", [jerking, vibrating])
def test_a_turn_that_is_not_smooth_stays_as_it_was_measured(motion):
    measured, less_noise = errors(motion, seconds=2)
    assert rms(less_noise) < 1.15 * rms(measured)
    assert np.abs(less_noise).max() < 5 * NOISE_RAD_S


def test_without_noise_nothing_changes():
    _, less_noise = errors(units.shaking, noise=0, seconds=2)
    assert np.abs(less_noise).max() < 2e-5


def unsmoothed(less, found):
    return less.gyro_rad_s is found.gyro_rad_s and less.variance is found.variance


def test_without_the_samples_before_a_window_its_rates_are_those_that_were_measured():
    imu, edges_us = units.samples(units.shaking, 0.3), np.arange(0, 50_001, 10_000)
    found = gyro.rates(imu, edges_us, 0.002)
    assert unsmoothed(gyro.smooth_rates(imu, edges_us, found), found)
    late = imu.span(int(imu.t.searchsorted(100_000)) - 2, imu.n)
    edges_us = edges_us + 100_000
    found = gyro.rates(late, edges_us, 0.002)
    assert unsmoothed(gyro.smooth_rates(late, edges_us, found), found)


@pytest.mark.parametrize("motion", [units.still, units.shaking])
def test_the_noise_of_a_unit_is_known_while_it_moves(motion):
    assert smooth.noise_of(units.samples(motion, 0.2, noise=NOISE_RAD_S)) == pytest.approx(NOISE_RAD_S, rel=0.2)
    assert smooth.noise_of(units.samples(motion, 0.01, noise=NOISE_RAD_S)) == 0.0


def test_windows_of_one_bin_stay():
    found = smooth.smoothed(np.ones((2, 3)), 1.0)
    np.testing.assert_array_equal(found.rates_rad_s, np.ones((2, 3)))
    np.testing.assert_array_equal(found.left, np.ones(2))


@pytest.mark.parametrize("motion", [units.still, smoothly, vibrating])
@pytest.mark.parametrize("noise", [0.002, 0.003, 0.008])
def test_the_variance_is_that_of_the_errors_whatever_the_noise_that_is_assumed(motion, noise):
    imu, exact = (units.samples(motion, 10, noise=sigma) for sigma in (noise, 0))
    ratios = []
    for start_us in range(100_000, 9_900_000, 50_000):
        edges_us = np.arange(start_us, start_us + 50_001, 10_000)
        found, truth = gyro.rates(imu, edges_us, 0.004), gyro.rates(exact, edges_us, 0.004).gyro_rad_s
        less = gyro.smooth_rates(imu, edges_us, found)
        of_scale = found.variance - found.noise_variance
        ratios.append((less.gyro_rad_s - truth) / np.sqrt(less.variance - of_scale))
    assert 0.7 < rms(np.array(ratios)) < 1.2


def test_a_unit_that_rested_has_the_noise_of_its_rest():
    imu, edges_us = units.samples(units.still, 0.3, noise=0.003), np.arange(100_000, 150_001, 10_000)
    found = [gyro.rates(imu, edges_us, noise) for noise in (0.003, 0.03)]
    of_noise = {
        rested: [
            gyro.smooth_rates(imu, edges_us, one, rested=rested).variance - one.variance + one.noise_variance
            for one in found
        ]
        for rested in (True, False)
    }
    np.testing.assert_allclose(of_noise[True][1], 100 * of_noise[True][0], rtol=1e-3)
    np.testing.assert_allclose(of_noise[False][1], of_noise[False][0], rtol=1e-3)
