from dataclasses import replace

import numpy as np
import pytest

from neurove_core.models import metadata
from neurove_service.streams.comparison import Comparison, TrialLimits, WindowResult, violation
from tests.bundles import make_bundle


def trial(proven, tried, *, rates=(0.2, 0.2), ms=1.0, serving_is_tried=False, windows=20, reach_us=0, late_us=0):
    """A trial in which each model estimates the same twist in every window."""
    comparison = Comparison(serving_is_tried=serving_is_tried, window_ms=50.0, reach_us=reach_us)
    serving, standby = (tried, proven) if serving_is_tried else (proven, tried)
    serving_rate, standby_rate = rates[::-1] if serving_is_tried else rates
    for i in range(windows):
        comparison.add_serving(WindowResult(i * 50_000, np.array(serving), serving_rate), ms)
        comparison.add_standby(WindowResult(i * 50_000 + late_us, np.array(standby), standby_rate), ms)
    return comparison


DRIVING = (0.0, 0.0, 2.0, 0.0, 0.5, 0.0)


@pytest.mark.parametrize("serving_is_tried", [False, True])
def test_models_that_agree_have_no_divergence(serving_is_tried):
    figures = trial(DRIVING, DRIVING, serving_is_tried=serving_is_tried).figures()
    assert figures.divergence == 0
    assert violation(figures, TrialLimits(divergence=0.01)) is None


@pytest.mark.parametrize("serving_is_tried", [False, True])
@pytest.mark.parametrize(
    ("tried", "divergence"),
    [((0, 0, 3, 0, 0.5, 0), 0.5), ((0, 0, 2, 0, 1.5, 0), 2.0), ((0, 0, 0, 0, 0, 0), 1.0)],
)
def test_divergence_is_the_difference_in_units_of_the_proven_models_motion(tried, divergence, serving_is_tried):
    figures = trial(DRIVING, tried, serving_is_tried=serving_is_tried).figures()
    assert figures.divergence == pytest.approx(divergence)
    wrong = violation(figures, TrialLimits(divergence=divergence - 0.1))
    assert (wrong.field, wrong.value) == ("divergence", pytest.approx(divergence))
    assert violation(figures, TrialLimits(divergence=divergence + 0.1)) is None


def test_small_differences_of_a_stationary_camera_stay_small():
    assert trial((0.0,) * 6, (0.05, 0, 0, 0, 0, 0.02)).figures().divergence < 0.5


def test_a_model_that_stops_firing_or_fires_too_much_is_found():
    for rates in ((0.3, 0.0), (0.05, 0.9)):
        assert violation(trial(DRIVING, DRIVING, rates=rates).figures(), TrialLimits()).field == "rate_ratio"
    assert violation(trial(DRIVING, DRIVING, rates=(0.0, 0.0)).figures(), TrialLimits()) is None


def test_a_slow_model_is_found_with_its_figure_and_bound():
    wrong = violation(trial(DRIVING, DRIVING, ms=30.0).figures(), TrialLimits(latency_share=0.5))
    assert str(wrong) == "latency_ms 30, the bound is 25"


@pytest.mark.parametrize("serving_is_tried", [False, True])
@pytest.mark.parametrize(
    ("own", "words"),
    [
        (metadata.BundleLimits(mean_dv_m_s=0.4), "mean_dv_m_s 0.5, the bound is 0.4"),
        (metadata.BundleLimits(mean_dw_rad_s=0.1), "mean_dw_rad_s 0.2, the bound is 0.1"),
        (metadata.BundleLimits(latency_ratio=0.9), "latency_ratio 1, the bound is 0.9"),
    ],
)
def test_a_bundle_may_be_stricter_about_itself_than_the_node(own, words, serving_is_tried):
    figures = trial(DRIVING, (0.3, 0.4, 2, 0, 0.5, 0.2), serving_is_tried=serving_is_tried).figures()
    assert violation(figures, TrialLimits()) is None
    strict = TrialLimits().and_of(replace(make_bundle(), metadata=metadata.Metadata(limits=own)))
    assert str(violation(figures, strict)) == words
    lax = metadata.BundleLimits(mean_dv_m_s=0.6, mean_dw_rad_s=0.3, latency_ratio=1.1)
    lax_too = TrialLimits(divergence=0.1).and_of(replace(make_bundle(), metadata=metadata.Metadata(limits=lax)))
    assert violation(figures, lax_too).field == "divergence"  # the limits of the node still hold


def test_with_too_few_windows_no_limit_is_checked():
    assert violation(trial(DRIVING, (9,) * 6, ms=99, windows=7).figures(), TrialLimits()) is None
    assert trial(DRIVING, DRIVING, windows=0).figures().divergence == 0


def test_newest_bounds_the_windows_that_are_evaluated():
    comparison = trial(DRIVING, DRIVING, windows=100)
    for i in range(100, 108):
        comparison.add_serving(WindowResult(i * 50_000, np.array(DRIVING), 0.2), 1.0)
        comparison.add_standby(WindowResult(i * 50_000, np.array(DRIVING) * 4, 0.2), 1.0)
    assert violation(comparison.figures(), TrialLimits(divergence=2.0)) is None
    assert violation(comparison.figures(), TrialLimits(divergence=2.0), newest=8).field == "divergence"


def test_windows_are_compared_only_if_their_ends_are_within_reach():
    assert len(trial(DRIVING, DRIVING, reach_us=10_000, late_us=10_000).figures().pairs) == 20
    assert len(trial(DRIVING, DRIVING, reach_us=10_000, late_us=10_001).figures().pairs) == 0


def test_a_fault_takes_precedence_over_all_figures():
    comparison = trial(DRIVING, DRIVING)
    comparison.fault = "planted"
    assert str(violation(comparison.figures(), TrialLimits())) == "fault planted, the bound is none"
