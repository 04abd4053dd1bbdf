"""RMSE and RE as the paper defines them, and the other figures."""

import math

import numpy as np
import pytest

from neurove_core.evaluation.judgement import judgement
from neurove_core.evaluation.metrics import direction_error_deg, figures, r2, relative_error, rmse


def made(windows=8, bins=5, seed=0):
    rng = np.random.default_rng(seed)
    truth = rng.normal(size=(windows * bins, 6)) * [0.1, 0.1, 4, 0.1, 0.3, 0.1]
    return truth, truth + rng.normal(size=truth.shape) * 0.05


def test_rmse_and_re_are_the_papers_equations_written_out():
    truth, estimate = made()
    error = (estimate - truth)[:, :3]
    squares, ratios = 0.0, 0.0
    for e, t in zip(error, truth[:, :3], strict=True):
        squares += sum(x * x for x in e)
        ratios += math.sqrt(sum(x * x for x in e)) / math.sqrt(sum(x * x for x in t))
    assert rmse(error) == pytest.approx(math.sqrt(squares / len(error)))
    assert relative_error(error, truth[:, :3]) == pytest.approx(ratios / len(error))


def test_re_counts_only_truths_above_the_floor():
    truth = np.array([[0, 0, 0.4], [0, 0, 2.0], [0, 0, 4.0]])
    error = np.array([[0, 0, 9.0], [0, 0, 1.0], [0, 0, 1.0]])
    assert relative_error(error, truth, 0.5) == pytest.approx((1 / 2 + 1 / 4) / 2)
    assert relative_error(error, truth) == pytest.approx((9 / 0.4 + 1 / 2 + 1 / 4) / 3)
    assert relative_error(error, truth, 5.0) is None


def test_degrees_match_radians_and_axes_add_up_to_their_group():
    truth, estimate = made()
    found = figures(truth, estimate, 5)
    assert found["rmse_v_a_deg_s"] == pytest.approx(math.degrees(found["rmse_v_a_rad_s"]))
    axes = found["per_axis"]
    assert sum(axes[a]["rmse_m_s"] ** 2 for a in ("vx", "vy", "vz")) == pytest.approx(found["rmse_v_l_m_s"] ** 2)
    assert sum(axes[a]["rmse_rad_s"] ** 2 for a in ("wx", "wy", "wz")) == pytest.approx(found["rmse_v_a_rad_s"] ** 2)
    assert axes["wy"]["rmse_deg_s"] == pytest.approx(math.degrees(axes["wy"]["rmse_rad_s"]))


def test_the_zero_predictor_has_a_relative_error_of_one_and_the_mean_an_r2_of_zero():
    truth, _ = made()
    zero = figures(truth, np.zeros_like(truth), 5)
    mean = figures(truth, np.broadcast_to(truth.mean(0), truth.shape), 5)
    assert zero["re_v_l"] == zero["re_v_a"] == pytest.approx(1)
    assert mean["r2_v_l"] == pytest.approx(0, abs=1e-12)
    assert mean["rmse_v_l_m_s"] == pytest.approx(mean["spread_v_l_m_s"])
    assert mean["per_axis"]["vz"]["correlation"] is None


def test_a_perfect_estimate_has_no_errors():
    truth, _ = made()
    found = figures(truth, truth, 5)
    for name in ("rmse_v_l_m_s", "rmse_v_a_deg_s", "re_v_l", "re_v_a", "worst_window_error_v_l_m_s"):
        assert found[name] == 0
    assert found["r2_v_l"] == found["r2_v_a"] == 1
    assert found["median_direction_error_v_l_deg"] == pytest.approx(0, abs=1e-5)


def test_speed_and_direction_errors_are_separate():
    truth = np.tile([0, 0, 4.0], (10, 1))
    turned = np.tile([4.0, 0, 0], (10, 1))
    assert direction_error_deg(truth, 2 * truth, 0.5) == 0
    assert direction_error_deg(truth, turned, 0.5) == pytest.approx(90)
    found = figures(np.hstack([truth, truth]), np.hstack([turned, 2 * truth]), 5)
    assert found["speed_rmse_v_l_m_s"] == 0
    assert found["speed_rmse_v_a_rad_s"] == pytest.approx(4)


def test_the_worst_window_is_found():
    truth, _ = made()
    estimate = truth.copy()
    estimate[30:35, 0] += 3.0
    found = figures(truth, estimate, 5)
    assert (found["worst_window_v_l"], found["worst_window_error_v_l_m_s"]) == (6, pytest.approx(3))
    assert found["windows"] == 8


def test_a_stationary_truth_has_no_relative_error_and_no_r2():
    found = figures(np.zeros((10, 6)), np.ones((10, 6)), 5)
    assert found["re_v_l"] is found["r2_v_a"] is found["median_direction_error_v_a_deg"] is None
    assert r2(np.zeros((3, 1)), np.ones((3, 1))) is None


@pytest.mark.parametrize("noise", [0, 1e-15, 1e-8])
def test_a_constant_truth_has_no_r2_and_no_correlation(noise):
    rng = np.random.default_rng(1)
    truth = np.tile([0.3, 0, 2, 0, 0, 0.1], (40, 1)) + noise * rng.normal(size=(40, 6))
    found = figures(truth, truth + 0.1 * rng.normal(size=truth.shape), 5)
    assert found["r2_v_l"] is found["r2_v_a"] is found["per_axis"]["vx"]["r2"] is None
    assert found["per_axis"]["vx"]["correlation"] is None


def report_of(truth, estimate):
    found = figures(truth, estimate, 5)
    mean, zero = np.broadcast_to(truth.mean(0), truth.shape), np.zeros_like(truth)
    return found | {"mean": figures(truth, mean, 5), "zero": figures(truth, zero, 5)}


def test_the_judgement_compares_with_both_constants():
    truth, estimate = made()
    assert judgement(report_of(truth, estimate)).count("is better than any constant") == 2
    worse = judgement(report_of(truth, truth * -1.0))
    assert worse.count("is worse than zero velocity") == 2
    mean = truth + (truth.mean(0) - truth) * 1.0
    assert "linear velocity is no better than the mean of the truth" in judgement(report_of(truth, mean))
    drive = truth * [0.01, 0.01, 0.1, 1, 1, 1] + [0, 0, 5, 0, 0, 0]
    between = drive + np.array([0.0, 0.0, 2.0, 0.0, 0.0, 0.0])
    assert "linear velocity is worse than the mean of the truth (2 m/s; mean" in judgement(report_of(drive, between))


def test_the_judgement_of_a_constant_truth_does_not_count_its_mean_as_a_rival():
    truth = np.tile([0, 0, 2.0, 0, 0, 0], (40, 1))
    told = judgement(report_of(truth, truth + 0.1))
    assert "linear velocity has a constant truth, and is better than zero velocity (0.173 m/s; zero 2)" in told
    assert "angular velocity has a constant truth of zero, and is off by 9.92 deg/s" in told
    assert "is worse than zero velocity" in judgement(report_of(truth, truth * -2))
