"""The default model: small, complete, and better than any predictor that ignores the events."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch

from neurove_core import models
from neurove_core.engine.engine import Engine
from neurove_core.estimator import Estimator
from neurove_core.evaluation.estimates import estimate_recording
from neurove_core.evaluation.evaluate import evaluate, report
from neurove_core.models import bundle
from neurove_core.networks.encoding import to_spikes
from neurove_core.sources import open_source
from neurove_core.training import data
from neurove_core.training.batches import with_gain


def test_it_is_trained_and_small_and_has_its_provenance():
    found = models.find(models.DEFAULT)
    assert models.built_in()[0] is found
    assert found.trained
    assert found.provenance.startswith("neurove model average of ")
    file = Path(models.__file__).with_name("default.safetensors")
    assert file.stat().st_size <= 8 << 20
    assert bundle.load(file).digest == found.digest


def test_importing_the_package_of_models_does_not_load_torch():
    program = "import sys, neurove_core.models; sys.exit('torch' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", program], check=False).returncode == 0


@pytest.mark.parametrize("height_m", [0.5, 2.0])
def test_it_estimates_the_speed_of_a_drive_at_any_camera_height(height_m):
    source = f"sim://street?seed=7001&seconds=2.5&camera=pinhole:86x65:75&height={height_m}"
    recording = open_source(source)
    results = report([evaluate(estimate_recording(Estimator(models.find("default")), recording), recording.twists())])
    assert results["re_v_l"] < 0.4 < results["zero"]["re_v_l"]
    assert results["rmse_v_a_deg_s"] < 6
    assert results["scaled"]


def counts_of(scene):
    """Counts of the windows of a drive through a scene (50, 2n, H, W)."""
    found = models.find("default")
    if found.uncertainty is None:
        pytest.skip("the default model is not calibrated: neurove calibrate default")
    recording = open_source(f"sim://{scene}?seed=7001&seconds=2.5&camera=pinhole:86x65:75&height=1")
    return data.sequence_of(recording, found.config).counts


@pytest.fixture(scope="module")
def drive():
    return counts_of("street")


def uncertainty_of(counts):
    """Per window: sigma of vz [1/s], whether it is uncertain, and vz [1/s]."""
    found = models.find("default")
    engine, state = Engine(found.network), found.network.initial_state()
    scale, offset = found.scale.double().numpy(), found.offset.double().numpy()
    sigmas, uncertain, speed = [], [], []
    for window in counts:
        spikes = to_spikes(torch.from_numpy(window)[None, None], found.config.network.encoding)
        twists, state = engine(spikes, state)
        log_sigma = found.network.log_sigma(state)[0].double().numpy()
        covariance = found.uncertainty.covariance(log_sigma, scale)
        sigmas.append(np.sqrt(covariance[2, 2]))
        twist = twists[0, 0].double().numpy() * scale + offset
        uncertain.append(found.uncertainty.is_uncertain(twist, covariance))
        speed.append(twist[:, 2].mean())
    return np.array(sigmas), np.array(uncertain), np.array(speed)


def test_its_sigma_is_low_on_a_normal_drive_and_higher_with_few_or_no_events(drive):
    usual, flagged, _ = uncertainty_of(drive)
    assert flagged[16:].mean() < 0.2
    blank, few = drive.copy(), drive.copy()
    blank[30:] = 0
    few[30:] = with_gain(np.random.default_rng(0), few[30:], 0.01)
    for counts, wider in ((blank, 1.2), (few, 1.4)):  # a window without events is also flagged low_activity
        sigma, _, _ = uncertainty_of(counts)
        assert (sigma[:30] == usual[:30]).all()
        assert np.median(sigma[35:]) > wider * np.median(usual[35:])


def test_its_sigma_is_higher_over_a_ground_without_texture(drive):
    (sigma, flagged, _), (usual, _, _) = uncertainty_of(counts_of("bare-street")), uncertainty_of(drive)
    assert np.median(sigma) > 1.2 * np.median(usual)
    assert flagged[16:].mean() > 0.5


def test_its_sigma_is_higher_after_a_gap(drive):
    counts = drive.copy()
    counts[30:40] = 0
    (sigma, _, _), (usual, _, _) = uncertainty_of(counts), uncertainty_of(drive)
    assert sigma[36:41].mean() > 1.3 * usual[36:41].mean()


def test_after_a_second_without_events_its_estimates_are_uncertain(drive):
    counts = drive.copy()
    counts[30:] = 0
    _, flagged, _ = uncertainty_of(counts)
    assert flagged[35:].mean() > 0.5


def test_after_half_a_second_without_events_it_recovers_the_speed(drive):
    counts = drive.copy()
    counts[15:25] = 0
    (_, _, speed), (_, _, usual) = uncertainty_of(counts), uncertainty_of(drive)
    assert (speed[:15] == usual[:15]).all()
    assert abs(speed[-5:].mean() - usual[-5:].mean()) < 0.15 * usual[-5:].mean()
