from dataclasses import replace

import numpy as np
import pytest

from neurove_core.models import metadata
from neurove_service.streams.comparison import Comparison, Outcome, TrialLimits, finding
from tests.bundles import make_bundle


def trial(proven, tried, *, rates=(0.2, 0.2), ms=1.0, front_is_tried=False, windows=20, reach_us=0, late_us=0):
    """A trial in which both models say the same twist in every window."""
    comparison = Comparison(front_is_tried=front_is_tried, window_ms=50.0, reach_us=reach_us)
    front, beside = (tried, proven) if front_is_tried else (proven, tried)
    front_rate, beside_rate = rates[::-1] if front_is_tried else rates
    for i in range(windows):
        comparison.front(Outcome(i * 50_000, np.array(front), front_rate), ms)
        comparison.beside(Outcome(i * 50_000 + late_us, np.array(beside), beside_rate), ms)
    return comparison


DRIVING = (0.0, 0.0, 2.0, 0.0, 0.5, 0.0)


@pytest.mark.parametrize("front_is_tried", [False, True])
def test_models_that_agree_are_not_told_apart(front_is_tried):
    measured = trial(DRIVING, DRIVING, front_is_tried=front_is_tried).measured()
    assert measured.divergence == 0
    assert finding(measured, TrialLimits(divergence=0.01)) is None


@pytest.mark.parametrize("front_is_tried", [False, True])
@pytest.mark.parametrize(
    ("tried", "divergence"),
    [((0, 0, 3, 0, 0.5, 0), 0.5), ((0, 0, 2, 0, 1.5, 0), 2.0), ((0, 0, 0, 0, 0, 0), 1.0)],
)
def test_divergence_is_the_difference_in_units_of_the_proven_models_motion(tried, divergence, front_is_tried):
    measured = trial(DRIVING, tried, front_is_tried=front_is_tried).measured()
    assert measured.divergence == pytest.approx(divergence)
    wrong = finding(measured, TrialLimits(divergence=divergence - 0.1))
    assert (wrong.field, wrong.value) == ("divergence", pytest.approx(divergence))
    assert finding(measured, TrialLimits(divergence=divergence + 0.1)) is None


def test_at_rest_small_differences_are_small():
    assert trial((0.0,) * 6, (0.05, 0, 0, 0, 0, 0.02)).measured().divergence < 0.5


def test_a_model_that_falls_silent_or_fires_without_end_is_found():
    for rates in ((0.3, 0.0), (0.05, 0.9)):
        assert finding(trial(DRIVING, DRIVING, rates=rates).measured(), TrialLimits()).field == "rate_ratio"
    assert finding(trial(DRIVING, DRIVING, rates=(0.0, 0.0)).measured(), TrialLimits()) is None


def test_a_slow_model_is_found_with_its_figure_and_bound():
    wrong = finding(trial(DRIVING, DRIVING, ms=30.0).measured(), TrialLimits(latency_share=0.5))
    assert str(wrong) == "latency_ms 30, the bound is 25"


@pytest.mark.parametrize("front_is_tried", [False, True])
@pytest.mark.parametrize(
    ("own", "words"),
    [
        (metadata.BundleLimits(mean_dv_m_s=0.4), "mean_dv_m_s 0.5, the bound is 0.4"),
        (metadata.BundleLimits(mean_dw_rad_s=0.1), "mean_dw_rad_s 0.2, the bound is 0.1"),
        (metadata.BundleLimits(latency_ratio=0.9), "latency_ratio 1, the bound is 0.9"),
    ],
)
def test_a_bundle_may_be_stricter_about_itself_than_the_node(own, words, front_is_tried):
    measured = trial(DRIVING, (0.3, 0.4, 2, 0, 0.5, 0.2), front_is_tried=front_is_tried).measured()
    assert finding(measured, TrialLimits()) is None
    strict = TrialLimits().and_of(replace(make_bundle(), metadata=metadata.Metadata(limits=own)))
    assert str(finding(measured, strict)) == words
    lax = metadata.BundleLimits(mean_dv_m_s=0.6, mean_dw_rad_s=0.3, latency_ratio=1.1)
    lax_too = TrialLimits(divergence=0.1).and_of(replace(make_bundle(), metadata=metadata.Metadata(limits=lax)))
    assert finding(measured, lax_too).field == "divergence"  # what the node says holds all the same


def test_too_few_windows_say_nothing():
    assert finding(trial(DRIVING, (9,) * 6, ms=99, windows=7).measured(), TrialLimits()) is None
    assert trial(DRIVING, DRIVING, windows=0).measured().divergence == 0


def test_only_the_newest_windows_are_judged_where_asked():
    comparison = trial(DRIVING, DRIVING, windows=100)
    for i in range(100, 108):
        comparison.front(Outcome(i * 50_000, np.array(DRIVING), 0.2), 1.0)
        comparison.beside(Outcome(i * 50_000, np.array(DRIVING) * 4, 0.2), 1.0)
    assert finding(comparison.measured(), TrialLimits(divergence=2.0)) is None
    assert finding(comparison.measured(), TrialLimits(divergence=2.0), newest=8).field == "divergence"


def test_windows_that_end_apart_are_compared_within_reach_alone():
    assert len(trial(DRIVING, DRIVING, reach_us=10_000, late_us=10_000).measured().pairs) == 20
    assert len(trial(DRIVING, DRIVING, reach_us=10_000, late_us=10_001).measured().pairs) == 0


def test_a_fault_goes_before_all_figures():
    comparison = trial(DRIVING, DRIVING)
    comparison.fault = "planted"
    assert str(finding(comparison.measured(), TrialLimits())) == "fault planted, the bound is none"
