"""What teaches the pitch of a camera: the events, and hardly the network's speed."""

import math

import numpy as np
import pytest
from numpy.typing import NDArray

from neurove_core.refine.ground_pitch import LEAST_SIGMA, MAX_CHANGE, SPEED_SHARE, Pitch, by_events, learned
from neurove_core.refine.ground_search import UNKNOWNS, Prior

Array = NDArray[np.float64]

START = math.radians(5)
PRIOR = Prior(np.zeros(UNKNOWNS), np.full(UNKNOWNS, math.radians(4)), 0.02, START)


def narrow(weight: float = 1.0) -> Array:
    """The information of events that show speed and pitch alike, and the other unknowns well."""
    information = np.eye(UNKNOWNS)
    line = np.zeros(UNKNOWNS)
    line[2], line[6] = 1.0, 1.0
    information[2, 2] = information[6, 6] = 1e-3
    return weight * (information + np.outer(line, line))


def most_probable(information: Array, truth: Array, weight: Array) -> Array:
    """The most probable unknowns about a prior of mean 0, where the events alone say `truth`."""
    return np.asarray(np.linalg.solve(information + np.diag(weight), information @ truth))


def test_it_is_the_pitch_of_a_search_with_a_wider_prior_of_the_speed() -> None:
    truth = np.linspace(-0.3, 0.3, UNKNOWNS)
    weight = np.full(UNKNOWNS, PRIOR.weight)
    z = most_probable(narrow(), truth, weight)
    weight[2] *= SPEED_SHARE
    wider = most_probable(narrow(), truth, weight)
    found = by_events(z, narrow(), PRIOR)
    assert found.mean == pytest.approx(START + math.radians(4) * wider[6])
    assert found.sigma < math.radians(4)


def test_an_error_of_the_networks_speed_that_lasts_hardly_moves_the_pitch() -> None:
    truth = np.zeros(UNKNOWNS)
    truth[2] = -1.0  # the network is one sigma too fast, the pitch is right
    z = most_probable(narrow(), truth, np.full(UNKNOWNS, PRIOR.weight))
    by_all = START + math.radians(4) * z[6]
    assert abs(by_events(z, narrow(), PRIOR).mean - START) < 0.2 * abs(by_all - START)


def test_a_single_search_does_not_carry_the_pitch_away() -> None:
    z = np.zeros(UNKNOWNS)
    z[2] = 100.0
    found = by_events(z, narrow(), PRIOR)
    assert abs(found.mean - START) <= MAX_CHANGE * math.radians(4) + 1e-9


def test_the_filter_goes_towards_what_was_found_and_becomes_surer_up_to_a_bound() -> None:
    state, found = Pitch(START, math.radians(4)), Pitch(math.radians(2), math.radians(1))
    after = learned(state, found, 0.25, math.radians(4))
    assert found.mean < after.mean < START
    assert after.sigma < state.sigma
    for _ in range(200):
        after = learned(after, Pitch(found.mean, 1e-5), 1.0, math.radians(4))
    assert after.mean == pytest.approx(found.mean)
    assert after.sigma >= LEAST_SIGMA
    assert learned(state, Pitch(START, 1.0), 0.25, math.radians(4)).sigma <= math.radians(4)
