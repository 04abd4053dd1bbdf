"""Sigma of a rate follows how unevenly the rates of a camera in the air change."""

import numpy as np
import pytest

from neurove_core.refine import trembling
from neurove_core.refine.errors import TREMBLE_RAD_S
from neurove_core.refine.trembling import LEAST_RAD_S, Trembling

WINDOW_US = 50_000
NOTHING = Trembling()
WITH_TREMBLE = np.eye(3) * (0.03**2 + TREMBLE_RAD_S**2)


def after(rates: np.ndarray, before: Trembling = NOTHING, first: int = 0) -> Trembling:
    known = before
    for number, rate in enumerate(rates, first):
        known = trembling.turned(known, rate, WINDOW_US * number, WINDOW_US * (number + 1))
    return known


def sigma(known: Trembling, *, assumed: bool = True) -> np.ndarray:
    """What the trembling alone makes of sigma."""
    found = trembling.trembled(WITH_TREMBLE, known, assumed=assumed)
    assert np.linalg.eigvalsh(found)[0] > 0
    return np.sqrt(np.diagonal(found) - 0.03**2 - (0 if assumed else TREMBLE_RAD_S**2))


def evenly(count: int = 20) -> np.ndarray:
    return np.outer(np.arange(count), [0.05, -0.1, 0.02])


def jerking(rad_s: float) -> np.ndarray:
    return rad_s * np.random.default_rng(20110).normal(size=(40, 3))


def test_what_is_assumed_stays_until_three_rates_in_a_row_show_more():
    for known in (Trembling(), after(evenly(2))):
        np.testing.assert_allclose(sigma(known), TREMBLE_RAD_S)
        np.testing.assert_array_equal(trembling.trembled(WITH_TREMBLE, known, assumed=False), WITH_TREMBLE)
    assert (sigma(after(evenly(3))) < TREMBLE_RAD_S).all()


def test_rates_that_change_evenly_show_no_trembling():
    np.testing.assert_allclose(sigma(after(evenly())), LEAST_RAD_S, rtol=1e-6)


@pytest.mark.parametrize("assumed", [True, False])
def test_rates_that_jerk_show_it_by_their_size_and_axis(assumed):
    little, much = (sigma(after(jerking(size)), assumed=assumed) for size in (0.05, 0.5))
    assert (little > LEAST_RAD_S).all()
    np.testing.assert_allclose(much, 10 * little, rtol=1e-6)
    about_x = sigma(after(jerking(0.5) * [1, 0, 0]), assumed=assumed)
    assert about_x[0] == pytest.approx(much[0])
    np.testing.assert_allclose(about_x[1:], LEAST_RAD_S, rtol=1e-6)


def test_a_camera_that_calms_down_is_known_again_after_some_windows():
    rough = after(jerking(0.5))
    calm = after(evenly(60), rough, first=40)
    assert (sigma(calm) < 0.2 * sigma(rough)).all()


def test_rates_of_either_side_of_a_gap_are_not_compared():
    calm = after(evenly())
    jump = after(np.full((2, 3), 9.0), calm, first=30)
    np.testing.assert_array_equal(jump.square, calm.square)
    assert len(jump.recent) == 2
