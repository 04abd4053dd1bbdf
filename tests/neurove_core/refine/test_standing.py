"""A vehicle that stopped is answered as standing; few events alone, or a stop that no motion led to, change nothing."""

import numpy as np
import pytest

from neurove_core.refine.standing import KEPT_US, Standing, answered, hold, outweighs, towards_zero

WINDOW_US = 50_000
NETWORK = np.tile([0.0, 0.1, 2.0, 0.02, 0.0, 0.01], (5, 1))  # it goes on with 2 m/s
COVARIANCE = np.diag([0.3, 0.3, 1.5, 0.05, 0.05, 0.05]) ** 2


def speed(share: float, before: Standing, end_us: int = WINDOW_US, height_m: float = 1.0) -> float:
    return float(hold(NETWORK, COVARIANCE, end_us, share, height_m, before).twists[0, 2])


def slow() -> Standing:
    """After a slow motion over the ground in the window before."""
    return answered(Standing(), 0, 0.1, 0.1)


def test_few_events_after_a_slow_motion_are_a_stop():
    found = hold(NETWORK, COVARIANCE, WINDOW_US, 0.01, 1.0, slow())
    assert np.linalg.norm(found.twists[:, :3], axis=1).max() < 0.01
    assert np.abs(found.twists[:, 3:]).max() < 0.001
    assert np.sqrt(found.covariance[2, 2]) < 0.05
    assert np.array_equal(found.covariance, found.covariance.T)
    assert np.linalg.eigvalsh(found.covariance)[0] > 0


@pytest.mark.parametrize("before", [Standing(), answered(slow(), 0, 4.0, 0.5)])
def test_few_events_without_a_slow_motion_before_are_no_stop(before: Standing):
    """Dark ground and lost data look alike."""
    found = hold(NETWORK, COVARIANCE, WINDOW_US, 0.01, 1.0, before)
    assert found.twists is NETWORK
    assert found.covariance is COVARIANCE
    assert not outweighs(found.standing, 10.0)


def test_a_slow_motion_long_ago_tells_no_stop():
    assert speed(0.01, slow(), KEPT_US + 1) == 2.0
    assert speed(0.01, slow(), KEPT_US) < 0.01


def test_a_stop_lasts_while_there_are_few_events():
    standing = slow()
    for end_us in range(WINDOW_US, 10 * KEPT_US, WINDOW_US):
        found = hold(NETWORK, COVARIANCE, end_us, 0.01, 1.0, standing)
        standing = found.standing
    assert found.twists[0, 2] < 0.01


def test_the_more_events_the_less_a_stop_counts():
    speeds = [speed(share, slow()) for share in (0.02, 0.1, 0.24)]
    assert speeds == sorted(speeds)
    assert speeds[-1] > 5 * speeds[0]


def test_a_slow_motion_with_its_events_is_no_stop():
    assert speed(0.4, slow()) == 2.0


def test_a_vehicle_that_starts_gains_speed_no_faster_than_vehicles_do():
    standing = hold(NETWORK, COVARIANCE, WINDOW_US, 0.24, 1.0, slow()).standing
    speeds = []
    for count in range(1, 20):
        found = hold(NETWORK, COVARIANCE, (1 + count) * WINDOW_US, 5.0, 1.0, standing)
        standing = found.standing
        speeds.append(found.twists[0, 2])
    assert speeds[0] < 0.05
    assert speeds[:10] == sorted(speeds[:10])
    assert speeds[-1] == 2.0  # half a second after the stop it says nothing


def test_a_motion_over_the_ground_counts_where_it_is_more_certain():
    standing = hold(NETWORK, COVARIANCE, WINDOW_US, 0.24, 1.0, slow()).standing
    assert outweighs(standing, 0.5)
    assert not outweighs(standing, 0.2)


def test_a_motion_that_is_found_ends_the_stop():
    standing = hold(NETWORK, COVARIANCE, WINDOW_US, 0.24, 1.0, slow()).standing
    moving = hold(NETWORK, COVARIANCE, 2 * WINDOW_US, 2.0, 1.0, standing).standing
    assert speed(2.0, answered(moving, 2 * WINDOW_US, 0.2, 0.1), 3 * WINDOW_US) == 2.0


def test_an_answer_that_may_be_slow_as_well_does_not_end_what_is_known():
    """The last events of a vehicle that stops leave the motion over the ground to the network."""
    assert speed(0.01, answered(slow(), 0, 0.9, 0.5)) < 0.01
    assert speed(0.01, answered(slow(), 0, 0.9, 0.1)) == 2.0


def test_a_speed_that_is_small_against_its_sigma_is_shrunk_and_the_turning_stays():
    unseen = np.tile([0.0, 0.0, 0.11, 0.02, 0.0, 0.01], (5, 1))
    found = towards_zero(unseen, np.diag([0.1, 0.1, 1.6, 0.05, 0.05, 0.05]) ** 2)
    assert 0.0 < found[0, 2] < 0.08
    assert np.array_equal(found[:, 3:], unseen[:, 3:])


def test_a_speed_that_is_seen_stays():
    found = towards_zero(NETWORK, COVARIANCE)
    assert np.abs(found - NETWORK).max() < 0.01
    crawl = NETWORK * 0.1
    assert np.abs(towards_zero(crawl, COVARIANCE / 25) - crawl).max() < 0.01


def test_no_speed_stays_none():
    assert np.array_equal(towards_zero(np.zeros((5, 6)), COVARIANCE), np.zeros((5, 6)))
