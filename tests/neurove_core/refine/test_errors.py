"""Errors beyond the search: each grows with what shows it, and none makes a covariance invalid."""

import itertools

import numpy as np
import pytest

from neurove_core.refine import errors
from neurove_core.refine.vehicle import MOST, START

STILL = np.zeros(6)
SEARCH = np.diag([0.02, 0.02, 0.02, 0.03, 0.03, 0.03]) ** 2
VEHICLE = np.array([0.0, 0.0, 8.0, 0.0, 0.1, 0.0])
GROUND = np.diag([0.1, 0.1, 0.3, 0.02, 0.03, 0.02]) ** 2
GROUND[0, 4] = GROUND[4, 0] = 0.5 * 0.1 * 0.03


def sigma(covariance: np.ndarray) -> np.ndarray:
    assert np.array_equal(covariance, covariance.T)
    assert np.linalg.eigvalsh(covariance)[0] > 0
    return np.sqrt(np.diagonal(covariance))


def of_rotation(motion: np.ndarray, before: np.ndarray | None = None, network: np.ndarray | None = None) -> np.ndarray:
    known = motion[:3] if network is None else network
    return sigma(errors.of_rotation(motion, SEARCH, motion if before is None else before, known))


def test_a_rotation_that_all_sources_agree_on_is_more_certain_than_the_search_says_but_the_camera_trembles():
    unsure = errors.of_rotation(STILL, 100 * SEARCH, STILL, np.zeros(3))
    assert (sigma(unsure) < np.sqrt(100 * np.diagonal(SEARCH)[:3])).all()
    sure = errors.of_rotation(STILL, SEARCH / 1e6, STILL, np.zeros(3))
    np.testing.assert_allclose(sigma(sure), errors.TREMBLE_RAD_S, rtol=0.01)


@pytest.mark.parametrize("axis", range(3))
def test_a_translation_makes_a_rotation_less_certain(axis):
    near, nearer = (np.concatenate([np.zeros(3), size * np.eye(3)[axis]]) for size in (0.1, 0.3))
    assert (of_rotation(STILL) < of_rotation(near)).all()
    assert (of_rotation(near) < of_rotation(nearer)).all()


def test_a_translation_ahead_looks_like_pitch():
    ahead, aside = (np.concatenate([np.zeros(3), way]) for way in ([0, 0, 0.2], [0.2, 0, 0]))
    assert of_rotation(ahead)[0] > 1.2 * of_rotation(aside)[0]
    assert of_rotation(ahead)[1] == of_rotation(aside)[1]


def test_a_rate_that_changes_or_that_the_network_contradicts_is_less_certain():
    turn = np.array([0.2, -0.3, 0.1, 0.0, 0.0, 0.0])
    assert (of_rotation(turn, before=STILL) > of_rotation(turn)).all()
    assert (of_rotation(turn, network=np.zeros(3)) > of_rotation(turn)).all()


def test_a_depth_that_is_not_known_widens_the_velocity_by_the_height_alone():
    both = np.eye(6) * 0.01
    at_1_m, at_2_m = (sigma(errors.of_unknown_depth(both, 0.2, 0.5, scale_m)) for scale_m in (1.0, 2.0))
    more = np.sqrt(at_1_m[:3] ** 2 - 0.01)
    np.testing.assert_allclose(np.sqrt(at_2_m[:3] ** 2 - 0.01), 2 * more)
    assert (at_1_m[3:] == 0.1).all()
    assert (sigma(errors.of_unknown_depth(both, 0.0, 0.0, 1.0)) == 0.1).all()


def of_ground(tilt_rad_s: float, pitch_sigma: float, twist: np.ndarray = VEHICLE) -> np.ndarray:
    return sigma(errors.of_ground(twist, GROUND, tilt_rad_s**2, pitch_sigma, 1.0, MOST))


def test_a_vehicle_of_known_pitch_keeps_the_correlations_of_the_search_and_is_more_certain():
    straight = VEHICLE * [1, 1, 1, 1, 0, 1]
    found = errors.of_ground(straight, GROUND, 0.0, 0.01, 1.0, MOST)
    assert (sigma(found) < sigma(GROUND)).all()
    assert found[0, 4] / np.sqrt(found[0, 0] * found[4, 4]) == pytest.approx(0.5)


def test_the_shares_of_slow_and_fast_vehicles_meet():
    sigmas = [of_ground(0.0, 0.01, np.array([0.0, 0.0, speed, 0.0, 0.0, 0.0])) for speed in (0.5, 1.99, 2.01, 8.0)]
    assert (sigmas[0] < sigmas[1]).all()
    np.testing.assert_allclose(sigmas[1], sigmas[2], rtol=0.01)
    assert np.array_equal(sigmas[2], sigmas[3])


def test_a_camera_is_less_certain_the_less_it_is_known_to_be_on_a_vehicle():
    odds = (MOST, START + 0.5 * errors.SURE, START, 0.5 * START)
    sigmas = [sigma(errors.of_ground(VEHICLE, GROUND, 0.0, 0.01, 1.0, one)) for one in odds]
    assert all((more >= less).all() and (more > less).any() for less, more in itertools.pairwise(sigmas))


def test_a_camera_that_tilts_over_ground_of_unknown_pitch_is_not_taken_for_a_vehicle():
    assert (of_ground(0.1, 0.07)[[0, 1, 3, 4, 5]] > 1.5 * of_ground(0.01, 0.07)[[0, 1, 3, 4, 5]]).all()
    assert (of_ground(0.1, 0.07) >= of_ground(0.1, 0.01)).all()


def test_a_slow_camera_is_more_certain_and_a_turning_one_less_of_pitch_and_roll():
    slow = VEHICLE / 20
    assert (of_ground(0.0, 0.01, slow) <= of_ground(0.0, 0.01)).all()
    turning = slow + np.eye(6)[4]
    assert (of_ground(0.0, 0.01, turning)[[3, 5]] > of_ground(0.0, 0.01, slow)[[3, 5]]).all()


def test_a_bend_makes_yaw_and_sideways_speed_less_certain_most_of_all_near_the_ground():
    bend = VEHICLE + np.array([0.0, 0.0, 0.0, 0.0, 0.3, 0.0])
    straight, high, low = (
        sigma(errors.of_ground(twist, GROUND, 0.0, 0.01, height, MOST))
        for twist, height in ((VEHICLE, 2.0), (bend, 2.0), (bend, 0.3))
    )
    assert (high >= straight).all()
    assert high[0] > straight[0]
    assert low[4] > high[4] > straight[4]
    assert low[3] == high[3]
