"""The refinement finds the angular velocity that the network missed, and leaves the network's answer where it must."""

import numpy as np
import pytest

from neurove_core.ingest.sample import Sample
from neurove_core.refine import rotation
from neurove_core.refine.rotation import Filter, Given, refine
from neurove_core.refine.view import MAX_PIXELS, View
from neurove_protocol import CameraInfo
from tests.neurove_core.evaluation.test_contrast import of_rotation, of_slide
from tests.neurove_core.geometry.test_geometry import ECD

VIEW = View.of(ECD)
SPREAD = np.diag([0.3, 0.3, 0.3, 0.3, 0.3, 0.3]) ** 2
W = np.array([0.4, -0.9, 0.3])


def sample_of(events):
    return Sample((events.t - events.t[0]).astype(np.int32), events.x, events.y)


TURNING = sample_of(of_rotation(ECD, W, 0.05, points=4000))


def given(sample=TURNING, w=W / 2, v=(0.0, 0.0, 0.0), **fields):
    twist = np.concatenate([v, w]).astype(float)
    known = {"covariance": SPREAD, "low_activity": False, "before": None}
    return Given(1_000_000, 50_000, sample, VIEW, twist, **(known | fields))


@pytest.mark.parametrize("share", [0.0, 0.5, 1.3])
@pytest.mark.parametrize("w", [W, -2 * W, 0.2 * W], ids=["usual", "fast", "slow"])
def test_the_rate_of_a_turning_camera_is_found_from_a_wrong_answer_of_the_network(w, share):
    found = refine(given(sample_of(of_rotation(ECD, w, 0.05, points=4000)), w=share * w, covariance=np.eye(6)))
    assert found.outcome == "accepted"
    error = found.rate.w_rad_s - w
    assert np.linalg.norm(error) < 0.05 * np.linalg.norm(w) + 0.04
    assert error @ np.linalg.solve(found.rate.covariance, error) < 16
    assert np.trace(found.rate.covariance) < 0.05


def test_the_last_window_helps_and_a_long_gap_forgets_it():
    first = refine(given()).filter
    assert first is not None
    with_it = refine(given()._replace(start_us=1_050_000, before=first))
    assert with_it.outcome == "accepted"
    assert np.trace(with_it.rate.covariance) < np.trace(refine(given()).rate.covariance)
    late = refine(given(low_activity=True)._replace(start_us=1_050_000 + 100 * 50_000, before=first))
    assert late.filter is None


def test_a_sideways_slide_is_not_taken_for_a_turn():
    slide = sample_of(of_slide(ECD, np.array([0.3, 0.0]), 0.05, points=2000))
    found = refine(given(slide, w=np.zeros(3), covariance=SPREAD / 4))
    assert np.abs(found.rate.w_rad_s).max() < 0.5 * 0.3  # rotation alone would explain it as 0.3 rad/s


def over_windows(sample, windows=8):
    """The refined rate of the last of some windows in a row with the same events; the network sees no motion."""
    before, found = None, None
    for number in range(windows):
        known = given(sample, w=np.zeros(3), covariance=SPREAD / 4, before=before)
        found = refine(known._replace(start_us=1_000_000 + number * 50_000))
        before = found.filter
    return found


def test_odds_of_a_motion_across_the_axis_follow_the_events():
    slide = over_windows(sample_of(of_slide(ECD, np.array([0.3, 0.0]), 0.05, points=2000)), 3)
    turn = over_windows(sample_of(of_rotation(ECD, np.array([0.3, 0.0, 0.0]), 0.05, points=4000)), 3)
    assert slide.filter.aside > 0 > turn.filter.aside


def test_where_no_motion_across_the_axis_is_shown_a_false_one_is_given_up():
    """Few blurred events leave open what turned and what slid: 0.15 rad/s each before, and a turn of 0.3 rad/s now."""
    rng, sample = (
        np.random.default_rng(20060),
        sample_of(of_rotation(ECD, np.array([0.3, 0.0, 0.0]), 0.05, points=4000)),
    )
    x, y = (np.clip(c + rng.integers(-2, 3, c.size), 0, 179).astype(c.dtype) for c in (sample.x, sample.y))
    shared = np.array([0.15, 0.0, 0.0, 0.0, -0.15, 0.0])
    found = []
    for odds in (-8.0, 8.0):
        before = Filter(shared, np.diag([0.1] * 3 + [0.05] * 3) ** 2, 1_000_000, aside=odds)
        found.append(refine(given(Sample(sample.t_us, x, y), w=np.zeros(3), before=before)).motion)
    assert abs(found[0][4]) < 0.5 * abs(found[1][4])
    assert abs(found[0][0] - 0.3) < abs(found[1][0] - 0.3)


def test_a_slide_that_goes_on_does_not_become_a_turn():
    found = over_windows(sample_of(of_slide(ECD, np.array([0.3, 0.0]), 0.05, points=2000)))
    assert np.abs(found.rate.w_rad_s).max() < 0.5 * 0.3


def rejected(outcome, **fields):
    known = given(**fields)
    found = refine(known)
    assert found.outcome == outcome
    np.testing.assert_array_equal(found.rate.w_rad_s, known.twist[3:])
    np.testing.assert_array_equal(found.rate.covariance, known.covariance[3:, 3:])


def part(sample, kept):
    return Sample(*(column[kept] for column in sample))


def test_few_events_or_low_activity_leave_the_answer_of_the_network():
    rejected("few events", low_activity=True)
    rejected("few events", sample=part(TURNING, slice(rotation.MIN_EVENTS - 1)))


def test_events_in_one_place_leave_the_answer_of_the_network():
    dense = sample_of(of_rotation(ECD, W, 0.05, points=12000))
    near = np.abs(dense.x.astype(int) - 120) + np.abs(dense.y.astype(int) - 90) < 30
    rejected("narrow", sample=part(dense, near))


def test_two_halves_that_turn_differently_leave_the_answer_of_the_network():
    other = sample_of(of_rotation(ECD, -W, 0.05, points=4000))
    left, right = part(TURNING, TURNING.x < 120), part(other, other.x >= 120)
    both = Sample(*(np.concatenate(columns) for columns in zip(left, right, strict=True)))
    rejected("disagreeing", sample=part(both, np.argsort(both.t_us, kind="stable")), w=np.zeros(3))


def test_a_network_that_is_certain_of_another_rate_is_not_contradicted():
    rejected("contradicted", w=np.array([0.4, 0.9, 0.3]), covariance=np.diag([0.05] * 6) ** 2)


def test_events_that_are_hardly_sharper_with_motion_leave_the_answer_of_the_network():
    slow = sample_of(of_rotation(ECD, 0.08 * W, 0.05, points=30000))
    rejected("still", sample=slow, w=np.zeros(3))
    assert refine(given(slow, w=0.08 * W)).outcome == "accepted"


def clusters(seed):
    """Events in random places, as a flickering light makes them, and a random answer of the network."""
    rng = np.random.default_rng(seed)
    count, places = int(rng.integers(600, 4000)), int(rng.integers(8, 60))
    middle = rng.uniform(0, [239, 179], (places, 2))[rng.integers(0, places, count)]
    x, y = np.clip(np.rint(middle + rng.normal(0, 6, (count, 2))), 0, [239, 179]).astype(np.uint16).T
    t_us = np.sort(rng.integers(0, 50_000, count)).astype(np.int32)
    return given(Sample(t_us, x, y), w=rng.normal(0, 0.5, 3), covariance=np.eye(6) * 10 ** rng.uniform(-2, 1))


def test_a_covariance_is_positive_whatever_the_events():
    found = [refine(clusters(seed)) for seed in range(60)]
    assert "no maximum" in {one.outcome for one in found}
    for one in found:
        assert np.linalg.eigvalsh(one.rate.covariance)[0] > 0
        assert one.filter is None or np.linalg.eigvalsh(one.filter.covariance)[0] > 0


def test_a_fast_drive_leaves_the_answer_of_the_network():
    rejected("moving", v=(0.0, 0.0, 8.0))
    assert refine(given(v=(0.0, 0.0, 8.0), height_m=40.0)).outcome == "accepted"
    assert refine(given(v=(0.0, 0.0, 1.3), covariance=np.diag([1, 1, 1, 0.3, 0.3, 0.3]) ** 2)).outcome == "accepted"


def test_the_result_depends_on_nothing_but_what_is_given():
    first = refine(given(before=Filter(np.zeros(6), np.eye(6) * 0.01, 1_000_000)))
    again = refine(given(before=Filter(np.zeros(6), np.eye(6) * 0.01, 1_000_000)))
    np.testing.assert_array_equal(first.rate.w_rad_s, again.rate.w_rad_s)
    np.testing.assert_array_equal(first.filter.covariance, again.filter.covariance)


def test_a_sensor_that_is_too_large_has_no_view():
    side = int(MAX_PIXELS**0.5) + 1
    lens = {"lens": "pinhole", "fx": 900.0, "fy": 900.0, "cx": 512.0, "cy": 512.0}
    assert View.of(CameraInfo(stream="cam0", width=side, height=side, **lens)) is None
