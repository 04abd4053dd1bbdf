"""The uncertainty of an estimate: fitted to known errors, saved in the bundle, reported in the right units."""

from dataclasses import replace

import numpy as np
import pytest
import safetensors.torch
import torch

from neurove_core import self_test
from neurove_core.config import CanonicalConfig, ModelConfig, NetworkConfig, WindowConfig
from neurove_core.estimator import Estimator, Push
from neurove_core.models import bounds, bundle
from neurove_core.models.bounds import Bounds
from neurove_core.models.bundle import PER_HEIGHT
from neurove_core.models.uncertainty import Uncertainty, coverage, half_width
from neurove_core.training import calibration
from neurove_core.training.calibration import SequenceErrors, laplace_scale, variants_of, with_uncertainty
from neurove_core.training.config import TrainingConfig
from neurove_protocol import CameraInfo, Sensor
from neurove_protocol.errors import BadModel, InvalidField
from tests.builders import make_events

HIDDEN = 6
STEADY = 1.25  # steady output for a constant input of 1 if an output neuron keeps a fifth per step
SMALL = ModelConfig(
    window=WindowConfig(duration_us=10_000, bins=2),
    canonical=CanonicalConfig(width=10, height=8),
    network=NetworkConfig(channels=(3,), features=4, hidden=HIDDEN, cells=1),
)
SENSOR = Sensor(20, 16)
TWO_METRES = CameraInfo(stream="c", width=20, height=16, lens="pinhole", fx=9, fy=9, cx=9.5, cy=7.5, height_m=2.0)


def wild(rng, sequences, windows=60):
    """Errors that grow with the first hidden unit, with a bias per sequence."""
    for number in range(sequences):
        for seen in calibration.VARIANTS:
            inputs = np.concatenate([rng.normal(size=(windows, HIDDEN)), np.full((windows, 1), STEADY)], 1)
            size = np.exp(0.8 * inputs[:, 0] - 1)[:, None, None] * [1, 2, 3, 1, 2, 3]
            error = size * (rng.normal(size=(windows, 2, 6)) + 0.2 * rng.normal(size=6))
            error[..., 4] -= 0.8 * error[..., 0]
            yield SequenceErrors(inputs, error, number, seen, hard=number % 4 == 3)


@pytest.fixture(scope="module")
def made():
    model = replace(bundle.untrained(1, SMALL), linear_unit=PER_HEIGHT, scale=torch.tensor([2.0] * 3 + [0.5] * 3))
    return with_uncertainty(model, list(wild(np.random.default_rng(0), 40)), "a test")


def answers(model, camera=TWO_METRES):
    estimator = Estimator(model)
    events = make_events(3_000, sensor=SENSOR, duration_us=60_000)
    return estimator.push(events, estimator.initial_state(SENSOR, camera), 60_000).estimates


def test_an_error_scale_that_depends_on_the_inputs_is_fitted():
    rng = np.random.default_rng(1)
    inputs = np.concatenate([rng.normal(size=(20_000, 3)), np.ones((20_000, 1))], 1)
    true = np.array([0.5, -1.0, 0.0, -2.0])
    size = np.abs(rng.laplace(size=20_000)) * np.exp(inputs @ true)
    np.testing.assert_allclose(laplace_scale(inputs, size, 1e-6), true, atol=0.03)
    strong = laplace_scale(inputs, size, 1e3)
    assert np.abs(strong[:3]).max() < 0.01
    assert np.exp(strong[3]) == pytest.approx(size.mean(), rel=0.02)


def test_a_model_without_errors_gets_a_finite_scale():
    assert np.isfinite(laplace_scale(np.ones((10, 2)), np.zeros(10), 0.1)).all()


def test_fitted_intervals_have_their_nominal_coverage_on_unseen_sequences(made):
    spread = made.bundle.network.spread
    weights = np.concatenate([spread.weight.detach().numpy(), spread.bias.detach().numpy()[:, None]], 1)
    errors, sigmas = [], []
    for one in wild(np.random.default_rng(7), 60):
        errors.append(one.error[:, 0])
        sigmas.append(np.exp(one.inputs @ weights.T))
    error, sigma = np.concatenate(errors), np.concatenate(sigmas)
    assert ((coverage(error, sigma, 0.9) > 0.85) & (coverage(error, sigma, 0.9) < 0.95)).all()
    wide = sigma[:, 2] > np.median(sigma[:, 2])
    assert np.abs(error[wide, 2]).mean() > 2 * np.abs(error[~wide, 2]).mean()


def test_the_report_gives_the_coverage_of_each_axis_for_each_augmentation(made):
    groups = made.report["groups"]
    assert set(groups) == set(calibration.VARIANTS) | {f"hard scenes, {seen}" for seen in calibration.VARIANTS}
    assert groups["unchanged"]["vz"]["0.9"] == pytest.approx(0.9, abs=0.01)
    assert groups["unchanged"]["vz"]["0.99"] > groups["unchanged"]["vz"]["0.5"]


def test_correlated_errors_are_correlated_in_the_bundle(made):
    correlation = made.bundle.uncertainty.correlation
    assert correlation[0, 4] < -0.2
    assert abs(correlation[1, 2]) < 0.2
    assert torch.linalg.eigvalsh(correlation)[0] > 0


def test_calibration_changes_no_twist_and_a_second_one_replaces_the_first(made):
    before = replace(bundle.untrained(1, SMALL), linear_unit=PER_HEIGHT, scale=made.bundle.scale)
    for one, other in zip(answers(before), answers(made.bundle), strict=True):
        np.testing.assert_allclose(one.twists, other.twists, rtol=1e-6)
        assert (one.covariance, one.uncertain) == (None, False)
        assert other.covariance is not None
    again = with_uncertainty(made.bundle, list(wild(np.random.default_rng(0), 40)), "a test")
    assert again.bundle.digest == made.bundle.digest


def test_calibration_records_the_golden_test_again(tmp_path):
    before = replace(bundle.untrained(1, SMALL), linear_unit=PER_HEIGHT, scale=torch.tensor([2.0] * 3 + [0.5] * 3))
    counts = np.random.default_rng(0).poisson(0.4, (5, 4, 8, 10)).astype(np.uint8)
    wrong = self_test.record(Estimator(before), counts, 0.03)._replace(twists=np.zeros((5, 2, 6), np.float32))
    after = with_uncertainty(replace(before, golden=wrong), list(wild(np.random.default_rng(0), 16)), "a test").bundle
    bundle.save(after, tmp_path / "a.safetensors")
    loaded = bundle.load(tmp_path / "a.safetensors")
    np.testing.assert_array_equal(self_test.answers(Estimator(loaded), counts), loaded.golden.twists)
    assert loaded.golden.tolerance == wrong.tolerance
    assert loaded.digest == after.digest


def test_a_covariance_is_symmetric_positive_definite_and_grows_with_the_square_of_the_height(made):
    low, high = answers(made.bundle, TWO_METRES.model_copy(update={"height_m": 1.0})), answers(made.bundle)
    metres = np.array([2, 2, 2, 1, 1, 1])
    for one, other in zip(low, high, strict=True):
        assert (one.covariance == one.covariance.T).all()
        assert np.linalg.eigvalsh(one.covariance)[0] > 0
        np.testing.assert_allclose(other.covariance, one.covariance * np.outer(metres, metres))


@pytest.mark.parametrize("precision", ["float32", "int8"])
def test_streams_in_one_batch_have_the_same_covariances_as_alone(precision):
    config = SMALL.model_copy(update={"network": SMALL.network.model_copy(update={"precision": precision})})
    model = replace(bundle.untrained(1, config), linear_unit=PER_HEIGHT)
    estimator = Estimator(with_uncertainty(model, list(wild(np.random.default_rng(0), 16)), "a test").bundle)
    estimator.warm_up()
    seen = [make_events(3_000, sensor=SENSOR, duration_us=60_000, seed=seed) for seed in range(3)]
    pushes = [Push(events, estimator.initial_state(SENSOR, TWO_METRES), 60_000) for events in seen]
    for push, together in zip(pushes, estimator.push_many(pushes), strict=True):
        alone = estimator.push(*push)
        assert len(alone.estimates) == len(together.estimates) > 0
        for one, other in zip(alone.estimates, together.estimates, strict=True):
            np.testing.assert_allclose(other.twists, one.twists, rtol=1e-4, atol=1e-5)
            np.testing.assert_allclose(other.covariance, one.covariance, rtol=1e-4)


def sigmas(linear, angular):
    """Covariance with this sigma of each part, the root of the sum of its three variances."""
    return np.diag([linear**2 / 3] * 3 + [angular**2 / 3] * 3)


def at(speed=0.0, rate=0.0):
    return np.array([[0, 0, speed, 0, rate, 0]] * 2, float)


def test_an_estimate_is_uncertain_where_its_sigma_exceeds_the_relative_and_the_absolute_bound():
    unsure = Uncertainty(torch.eye(6), 0.5, "a test", Bounds(0.3, 0.1))
    assert not unsure.is_uncertain(at(0.0), sigmas(0.29, 0.09))  # stationary
    assert unsure.is_uncertain(at(0.0), sigmas(0.31, 0.09))
    assert not unsure.is_uncertain(at(0.65), sigmas(0.31, 0.09))  # small compared with its speed
    assert unsure.is_uncertain(at(0.60), sigmas(0.31, 0.09))
    assert unsure.is_uncertain(at(5.0), sigmas(0.31, 0.11))  # the angular part alone
    assert not unsure.is_uncertain(at(5.0, 0.25), sigmas(0.31, 0.11))
    assert unsure.is_uncertain(at(0.6, 9.0), sigmas(0.31, 0.11))  # each part against its own bounds
    assert np.isfinite(unsure.covariance(np.full(6, 1e30), np.ones(6))).all()


def test_the_bounds_of_a_node_take_precedence_over_those_of_a_bundle_and_those_over_the_defaults():
    usual = Uncertainty(torch.eye(6), 0.3, "a test")
    own = replace(usual, bounds=Bounds(m_s=0.5))
    given = sigmas(bounds.UNCERTAIN_M_S * 1.1, bounds.UNCERTAIN_RAD_S * 0.9)
    assert usual.is_uncertain(at(), given)
    assert not own.is_uncertain(at(), given)
    assert own.is_uncertain(at(), given, Bounds(m_s=0.01))
    assert own.is_uncertain(at(), sigmas(0.1, bounds.UNCERTAIN_RAD_S * 1.1))


def test_an_estimator_flags_by_the_bounds_that_it_was_given(made):
    events, camera = make_events(3_000, sensor=SENSOR, duration_us=60_000), TWO_METRES
    for given, flagged in ((Bounds(1e9, 1e9), False), (Bounds(1e-9, 1e-9), True)):
        small = replace(made.bundle, uncertainty=replace(made.bundle.uncertainty, uncertain_above=1e-9))
        estimator = Estimator(small, bounds=given)
        found = estimator.push(events, estimator.initial_state(SENSOR, camera), 60_000).estimates
        assert {one.uncertain for one in found} == {flagged}


def test_a_bundle_stores_its_bounds_only_where_they_are_set(made, tmp_path):
    plain = made.bundle.to_bytes()
    assert b"uncertain_m_s" not in plain  # the digests of older bundles depend on it
    errors = list(wild(np.random.default_rng(0), 16))
    bounded = with_uncertainty(made.bundle, errors, "a test", Bounds(m_s=0.4)).bundle
    bundle.save(bounded, tmp_path / "a.safetensors")
    assert bundle.load(tmp_path / "a.safetensors").uncertainty.bounds == Bounds(0.4, None)
    again = with_uncertainty(bounded, errors, "a test", Bounds(rad_s=0.2)).bundle
    assert again.uncertainty.bounds == Bounds(0.4, 0.2)


def test_a_calibrated_bundle_is_saved_and_loaded_unchanged(made, tmp_path):
    path = tmp_path / "a.safetensors"
    bundle.save(made.bundle, path)
    loaded = bundle.load(path)
    assert loaded.digest == made.bundle.digest
    assert loaded.uncertainty.uncertain_above == calibration.UNCERTAIN_ABOVE
    assert loaded.uncertainty.provenance == "a test"
    for one, other in zip(answers(made.bundle), answers(loaded), strict=True):
        np.testing.assert_array_equal(one.covariance, other.covariance)


@pytest.mark.parametrize(
    ("row", "column", "value", "why"),
    [(0, 1, 0.5, "not symmetric"), (2, 2, 0.5, "diagonal that is not 1"), (None, None, 1.0, "not positive definite")],
)
def test_an_invalid_correlation_matrix_is_refused(made, row, column, value, why):
    data = made.bundle.to_bytes()
    tensors, about = safetensors.torch.load(data), bundle.read_header(data, "x")
    correlation = tensors["output.correlation"]
    if row is None:
        correlation[:] = value
    else:
        correlation[row, column] = value
    header = {"neurove": about.model_dump_json(exclude_none=True)}
    with pytest.raises(BadModel, match=f"tensor 'output.correlation' .*{why}"):
        bundle.from_bytes(safetensors.torch.save(tensors, header), "x")
    del tensors["spread.bias"]
    with pytest.raises(BadModel, match=r"tensor 'spread.bias' is missing"):
        bundle.from_bytes(safetensors.torch.save(tensors, header), "x")


def test_a_bundle_with_another_camera_or_unit_is_not_calibrated(made, tmp_path):
    config = TrainingConfig(model=SMALL.model_copy(update={"canonical": CanonicalConfig()}))
    with pytest.raises(BadModel, match="differ from those of the configuration"):
        calibration.calibrate(made.bundle, config, tmp_path)
    with pytest.raises(BadModel, match="linear_unit='m/s'"):
        calibration.calibrate(replace(made.bundle, linear_unit="m/s"), TrainingConfig(model=SMALL), tmp_path)
    with pytest.raises(InvalidField, match="sequences=15: must be at least 16"):
        calibration.calibration_sets(TrainingConfig(), 15)


def test_a_sequence_is_used_unchanged_with_gaps_with_few_and_with_many_events_and_as_a_stationary_camera():
    rng = np.random.default_rng(3)
    counts = rng.integers(0, 4, (60, 4, 5, 6)).astype(np.uint8)
    variants = variants_of(rng, counts, np.ones((60, 2, 6), np.float32))
    plain, gaps, few, many, still = (variant for variant, _ in variants)
    assert (plain == counts).all()
    empty = (gaps == 0).all(axis=(1, 2, 3))
    assert 0 < empty.sum() < 60
    assert few[40:].sum() < 0.7 * counts[40:].sum()
    assert many.sum() > counts.sum()
    assert still.mean() < 1
    assert [bool(true.any()) for _, true in variants] == [True, True, True, True, False]


def test_the_half_width_of_an_interval_is_that_of_a_normal_distribution():
    assert half_width(0.5) == pytest.approx(0.6745, abs=1e-4)
    rng = np.random.default_rng(0)
    assert coverage(rng.normal(size=(20_000, 6)), np.ones((20_000, 6)), 0.5) == pytest.approx(0.5, abs=0.02)


def test_a_wider_sigma_multiplies_the_covariance_and_leaves_the_twists(made):
    """As `neurove adapt` does where the validation pieces need it; the factor is exact in the steady state."""
    factor = np.array([1.0, 2.0, 3.0, 1.5, 1.0, 4.0])
    wider = calibration.with_wider_sigma(made.bundle, factor, "by a test")
    assert wider.digest != made.bundle.digest
    assert wider.uncertainty.provenance.endswith("; by a test")
    for one, other in zip(answers(made.bundle), answers(wider), strict=True):
        np.testing.assert_array_equal(one.twists, other.twists)
    ratio = np.sqrt(np.diagonal(other.covariance) / np.diagonal(one.covariance))
    np.testing.assert_allclose(ratio, factor, rtol=0.1)
    with pytest.raises(BadModel, match="has no uncertainty"):
        calibration.with_wider_sigma(bundle.untrained(1, SMALL), factor, "by a test")
