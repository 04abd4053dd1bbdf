"""An answer of the middle of its span becomes one of the newest window, where the answers show an acceleration."""

import numpy as np
import pytest

from neurove_core.refine.late import ACCELERATION_M_S2, ANSWERS, LEAST, MOST_M_S2, MOST_RAD_S2, Answers, change

WINDOW_S, DELAY_S = 0.05, 0.075


def answers(count: int, acceleration: float, noise: float = 0.0) -> Answers:
    rng = np.random.default_rng(0)
    times = WINDOW_S * np.arange(count)
    speeds = 4 + acceleration * times + noise * rng.normal(size=count)
    return tuple(zip(times.tolist(), speeds.tolist(), [0.0] * count, strict=True))


def bends(count: int, rad_s2: float, noise: float = 0.0) -> Answers:
    rng = np.random.default_rng(1)
    times = WINDOW_S * np.arange(count)
    rates = rad_s2 * times + noise * rng.normal(size=count)
    return tuple(zip(times.tolist(), [4.0] * count, rates.tolist(), strict=True))


@pytest.mark.parametrize("acceleration", [-2.0, 0.0, 1.6])
def test_a_vehicle_that_brakes_or_starts_is_on_time(acceleration: float):
    found = change(answers(ANSWERS, acceleration, 0.005), DELAY_S)
    assert found.speed_m_s == pytest.approx(acceleration * DELAY_S, abs=0.015)
    assert 0 < found.sigma_m_s < 0.02


def test_answers_that_scatter_tell_less_and_say_so():
    sure, unsure = (change(answers(ANSWERS, 2.0, noise), DELAY_S) for noise in (0.005, 0.3))
    assert abs(unsure.speed_m_s) < 0.7 * sure.speed_m_s
    assert sure.sigma_m_s < unsure.sigma_m_s < ACCELERATION_M_S2 * DELAY_S


def test_few_answers_and_a_search_that_still_comes_nearer_tell_nothing():
    assert change(answers(LEAST - 1, 2.0), DELAY_S) == (0.0, 0.0, 0.0, 0.0)
    assert change(answers(ANSWERS, 2 * MOST_M_S2), DELAY_S) == (0.0, 0.0, 0.0, 0.0)
    assert change(bends(ANSWERS, 2 * MOST_RAD_S2), DELAY_S) == (0.0, 0.0, 0.0, 0.0)


@pytest.mark.parametrize("rad_s2", [-0.4, 0.0, 0.4])
def test_a_vehicle_that_enters_or_leaves_a_bend_is_on_time(rad_s2: float):
    found = change(bends(ANSWERS, rad_s2, 0.002), DELAY_S)
    assert found.yaw_rad_s == pytest.approx(rad_s2 * DELAY_S, abs=0.004)
    assert 0 < found.sigma_rad_s < 0.01
    assert found.speed_m_s == pytest.approx(0.0, abs=1e-9)


def test_yaw_rates_that_scatter_tell_less():
    sure, unsure = (change(bends(ANSWERS, 0.4, noise), DELAY_S) for noise in (0.002, 0.1))
    assert abs(unsure.yaw_rad_s) < 0.7 * sure.yaw_rad_s
    assert sure.sigma_rad_s < unsure.sigma_rad_s
