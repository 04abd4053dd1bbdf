"""The simulated inertial unit: gravity, turns and accelerations of the exact path, with known bias and noise."""

import numpy as np
import pytest

from neurove_core.sim.inertial import GRAVITY_M_S2, ImuConfig, biases, exact
from neurove_core.sim.source import simulation_of
from neurove_protocol.errors import InvalidField
from tests.recordings import all_samples

PERFECT = "&gyro_bias=0&gyro_noise=0"


def test_a_stationary_level_camera_measures_gravity_upwards_and_no_turn():
    path = simulation_of("sim://wall?trajectory=still&pitch=0&seconds=1").trajectory
    accel, gyro = exact(path, np.linspace(0, 1, 11))
    np.testing.assert_allclose(accel, [[0, -GRAVITY_M_S2, 0]] * 11, atol=1e-9)
    np.testing.assert_allclose(gyro, 0, atol=1e-12)


def test_a_camera_that_looks_down_measures_gravity_against_its_axis():
    path = simulation_of("sim://wall?trajectory=still&pitch=30&seconds=1").trajectory
    accel, _ = exact(path, np.array([0.5]))
    np.testing.assert_allclose(accel, [[0, -GRAVITY_M_S2 * np.cos(np.pi / 6), -GRAVITY_M_S2 / 2]], atol=1e-9)


def test_a_turn_to_the_right_with_speed_has_a_centripetal_acceleration_to_the_right():
    path = simulation_of("sim://wall?trajectory=driving&pitch=0&seconds=20&seed=20001").trajectory
    t_s = np.linspace(0.1, 19.9, 400)
    accel, gyro = exact(path, t_s)
    twist = path.twist(t_s)
    np.testing.assert_allclose(gyro, twist[:, 3:])
    steady = np.abs(twist[:, 4]) > 0.1
    expected = twist[:, 4] * twist[:, 2]  # v^2 / r = w v
    assert np.corrcoef(accel[steady, 0], expected[steady])[0, 1] > 0.9


def test_bias_and_noise_are_those_of_the_url_and_the_same_for_the_same_seed():
    url = "sim://wall?trajectory=still&seconds=4&seed=20002&imu=1000&gyro_bias=0.05&gyro_noise=0.01"
    imu, again = (all_samples(simulation_of(url)) for _ in range(2))
    assert imu.n == 4000
    np.testing.assert_array_equal(imu.gyro_rad_s, again.gyro_rad_s)
    np.testing.assert_array_equal(np.diff(imu.t), 1000)
    np.testing.assert_allclose(imu.gyro_rad_s.std(0), 0.01, rtol=0.05)
    bias = biases(ImuConfig(gyro_bias_rad_s=0.05), 20002)[1]
    assert np.abs(bias).max() > 0.01
    np.testing.assert_allclose(imu.gyro_rad_s.mean(0), bias, atol=1e-3)


def test_a_late_clock_shifts_the_times_of_the_samples_and_nothing_else():
    url = "sim://wall?trajectory=handheld&seconds=1&seed=20003&imu=500"
    imu, late = all_samples(simulation_of(url)), all_samples(simulation_of(url + "&imu_offset_ms=12"))
    np.testing.assert_array_equal(late.t, imu.t + 12_000)
    np.testing.assert_array_equal(late.gyro_rad_s, imu.gyro_rad_s)


def test_an_endless_simulation_has_samples_of_one_path_after_the_other():
    simulation = simulation_of("sim://wall?trajectory=handheld&seed=20004&imu=100" + PERFECT)
    batches = simulation.imu()
    last_us = -1
    for _ in range(5):
        batch = next(batches)
        assert batch.t[0] > last_us
        last_us = int(batch.t[-1])
    assert simulation.streams == ("events", "imu")


def test_a_simulation_without_a_unit_has_no_samples():
    simulation = simulation_of("sim://wall?seconds=1")
    assert "imu" not in simulation.streams
    assert not list(simulation.imu())


@pytest.mark.parametrize(
    ("query", "field"),
    [("imu=0", "imu"), ("imu=x", "imu"), ("imu=100&gyro_bias=2", "gyro_bias"), ("gyro_noise=0.1", "gyro_noise")],
)
def test_a_wrong_parameter_of_the_unit_is_refused_by_its_name(query, field):
    with pytest.raises(InvalidField) as caught:
        simulation_of(f"sim://wall?{query}")
    assert caught.value.details["field"] == field
