"""A fast turn is found without the network; a motion that goes on outweighs it for a few windows."""

import numpy as np
import pytest

from neurove_core.ingest.sample import Sample
from neurove_core.refine.fast import fast_turn
from neurove_core.refine.rotation import MAX_AGAINST, MOVING_EVERY, Filter, refine
from tests.neurove_core.evaluation.test_contrast import of_rotation, of_slide
from tests.neurove_core.geometry.test_geometry import ECD
from tests.neurove_core.refine.test_rotation import SPREAD, VIEW, W, given, sample_of

SURE = np.diag([0.05] * 6) ** 2
FAST = [(0.0, -6.0, 0.0), (3.0, -2.0, 8.0), (2.0, 0.0, -2.5), (-9.0, 4.0, 0.0)]


def turning(w, points=800, seed=0, seconds=0.05):
    return sample_of(of_rotation(ECD, np.array(w), seconds, seed=seed, points=points))


@pytest.mark.parametrize("w", FAST, ids=str)
def test_a_fast_turn_is_found_although_the_network_is_sure_of_no_motion(w):
    found = refine(given(turning(w), w=np.zeros(3), covariance=SURE))
    assert found.outcome == "accepted"
    error = found.rate.w_rad_s - w
    assert np.linalg.norm(error) < 0.06 * np.linalg.norm(w)
    assert error @ np.linalg.solve(found.rate.covariance, error) < 16
    after = refine(given(turning(w), w=np.zeros(3), covariance=SURE, before=found.filter)._replace(start_us=1_050_000))
    assert after.outcome == "accepted"


def test_a_rate_that_changes_within_the_window_gives_its_mean():
    first, second = np.array([1.0, 2.0, 3.0]), np.array([2.0, 1.0, 6.0])
    parts = turning(first, seconds=0.025), turning(second, seconds=0.025, seed=1)
    t_us = np.concatenate([parts[0].t_us, parts[1].t_us + 25_000])
    both = Sample(t_us, *(np.concatenate(columns) for columns in zip(parts[0][1:], parts[1][1:], strict=True)))
    found = refine(given(both, w=np.zeros(3), covariance=SURE))
    assert found.outcome == "accepted"
    np.testing.assert_allclose(found.rate.w_rad_s, (first + second) / 2, atol=0.25)
    assert np.linalg.norm(found.filter.motion[:3] - second) < np.linalg.norm(found.filter.motion[:3] - first)


def test_neither_a_slow_turn_nor_a_slide_nor_noise_is_a_fast_turn():
    rng = np.random.default_rng(20170)
    noise = Sample(
        np.sort(rng.integers(0, 50_000, 8000)).astype(np.int32),
        *(rng.integers(0, high, 8000).astype(np.uint16) for high in (240, 180)),
    )
    slide = sample_of(of_slide(ECD, np.array([4.0, 0.0]), 0.05, points=800))
    for sample, reasons in (
        (turning(W), {"slow"}),
        (slide, {"slow", "out of range", "disagreeing"}),
        (noise, {"slow"}),
    ):
        turn, why = fast_turn(VIEW.rays_of(sample, 50_000), VIEW.grid, 0.05, [])
        assert turn is None
        assert why in reasons
    assert fast_turn(VIEW.rays_of(turning(W, points=2), 50_000), VIEW.grid, 0.05, [])[1] == "few events"


def outcomes(before, **fields):
    """Outcomes of windows of a camera that turns at W, while the network says something else."""
    found = []
    for number in range(MAX_AGAINST + 2):
        start_us = 50_000 * (MOVING_EVERY * 5 + number)
        one = refine(given(**fields)._replace(start_us=start_us, before=before))
        before = one.filter
        found.append(one.outcome)
    return found


@pytest.mark.parametrize(
    ("why", "fields"),
    [
        ("contradicted", {"w": np.array([0.4, 0.9, 0.3]), "covariance": SURE}),
        ("moving", {"v": (0.0, 0.0, 8.0), "covariance": SPREAD}),
    ],
)
def test_a_motion_that_goes_on_outweighs_the_network_for_some_windows(why, fields):
    steady = Filter(np.append(W, np.zeros(3)), np.eye(6) * 0.03**2, 1_000_000)
    assert outcomes(steady, **fields) == ["accepted"] * MAX_AGAINST + [why] * 2
    assert outcomes(None, **fields)[0] == why
    other = Filter(np.append(-W, np.zeros(3)), np.eye(6) * 0.03**2, 1_000_000)
    if why == "contradicted":
        assert outcomes(other, **fields)[0] != "accepted"


def test_a_rate_that_changes_makes_the_answer_less_certain_and_goes_on_changing():
    def after(share):
        steady = Filter(np.append(share * W, np.zeros(3)), np.eye(6) * 0.1**2, 1_000_000)
        return refine(given(before=steady, w=W))

    same, other = after(1.0), after(0.7)
    assert same.outcome == other.outcome == "accepted"
    assert np.linalg.norm(same.change_rad_s) < 0.03
    assert other.change_rad_s @ W > 0.15 * (W @ W)
    assert (np.diagonal(other.rate.covariance) > np.diagonal(same.rate.covariance)).all()
    np.testing.assert_allclose(other.sigma_rad_s, same.sigma_rad_s, rtol=0.2)
