"""Sigma of an answer over the ground follows how much the answers of its stream scatter, within bounds."""

import numpy as np
import pytest

from neurove_core.refine import scatter
from neurove_core.refine.scatter import BELIEVED, KEPT, LAG, Scatter
from neurove_core.sim.render.camera import named_camera
from tests.neurove_core.refine.test_errors import VEHICLE

WINDOW_US = 50_000
SIGMA = np.array([0.1, 0.1, 0.3, 0.02, 0.03, 0.02])
NOTHING = Scatter()
CAMERA = named_camera("davis346-half", 1.0).info


def after(noise: float, windows: int = 100, before: Scatter = NOTHING, first: int = 0) -> Scatter:
    """What answers with errors of this share of SIGMA show."""
    rng, known = np.random.default_rng(20600), before
    for number in range(first, first + windows):
        twist = VEHICLE + noise * SIGMA * rng.normal(size=6)
        known = scatter.answered(known, twist, WINDOW_US * number, WINDOW_US * (number + 1))
    return known


def share(known: Scatter, speed_m_s: float = 0.0, narrow: float = 1.0) -> np.ndarray:
    return scatter.shares(known, SIGMA, speed_m_s, narrow)


def test_without_answers_to_compare_sigma_stays():
    assert (share(Scatter()) == 1).all()
    assert (share(after(0.1, windows=LAG)) == 1).all()
    assert (share(after(0.1, windows=LAG + 1)) < 1).all()


def test_answers_that_agree_narrow_sigma_by_and_by_and_answers_that_scatter_keep_it():
    calm = [share(after(0.1, windows=LAG + count)) for count in (1, BELIEVED, 10 * KEPT)]
    assert (calm[0] > calm[1]).all()
    assert (calm[1] > calm[2]).all()
    assert (calm[2] > scatter.SEARCH).all()
    assert (calm[2] < 0.5).all()
    assert (share(after(5.0)) == 1).all()


def test_the_share_follows_a_stream_that_scatters_more_or_less_than_before():
    rough = after(5.0)
    smooth = after(0.1, before=rough, first=100)
    assert (share(smooth) < share(rough)).all()
    assert (share(after(5.0, before=smooth, first=200)) > share(smooth)).all()


def test_answers_of_either_side_of_a_gap_are_not_compared():
    calm = after(0.0, windows=20)
    jump = scatter.answered(calm, VEHICLE + 100 * SIGMA, WINDOW_US * 30, WINDOW_US * 31)
    np.testing.assert_array_equal(jump.square, calm.square)
    assert jump.windows == calm.windows
    assert len(jump.recent) == 1
    at_once = scatter.answered(calm, VEHICLE + 100 * SIGMA, WINDOW_US * 20, WINDOW_US * 21)
    assert (at_once.square > calm.square).all()


def test_what_lasts_widens_with_the_speed_and_more_for_a_narrow_lens():
    calm = after(0.0)
    slow, fast = share(calm, 0.5), share(calm, 5.0)
    assert (fast >= slow).all()
    assert (fast[1:] > slow[1:]).all()
    narrow = share(calm, 5.0, narrow=2.5)
    assert (narrow[1:3] > fast[1:3]).all()
    np.testing.assert_array_equal(np.delete(narrow, [1, 2]), np.delete(fast, [1, 2]))
    assert (share(calm, 1e3, narrow=2.5) <= 1).all()


@pytest.mark.parametrize("noise", [0.0, 0.1, 5.0])
def test_the_covariance_keeps_its_correlations_and_stays_valid(noise):
    correlation = np.eye(6)
    correlation[0, 4] = correlation[4, 0] = 0.7
    before = correlation * np.outer(SIGMA, SIGMA)
    found = scatter.narrowed(before, after(noise), 8.0, CAMERA)
    assert np.array_equal(found, found.T)
    assert np.linalg.eigvalsh(found)[0] > 0
    assert (np.diagonal(found) <= np.diagonal(before) * (1 + 1e-12)).all()
    assert found[0, 4] / np.sqrt(found[0, 0] * found[4, 4]) == pytest.approx(0.7)
