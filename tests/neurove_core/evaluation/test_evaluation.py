"""A model is evaluated on the estimates that the service publishes, against the truth of each bin."""

from dataclasses import replace

import numpy as np
import pytest

from neurove_core.config import CanonicalConfig, ModelConfig, NetworkConfig
from neurove_core.estimator import Estimator
from neurove_core.evaluation.estimates import estimate_recording
from neurove_core.evaluation.evaluate import NoTruth, evaluate, report
from neurove_core.geometry.motion import Twists
from neurove_core.io.packets import slices
from neurove_core.models import bundle
from neurove_core.models.bundle import PER_HEIGHT
from neurove_core.sources import open_source
from neurove_protocol import EventPacket
from neurove_service.models.slot import ModelSlot
from neurove_service.streams.intake import Arrival
from neurove_service.streams.stream import Stream

SMALL = ModelConfig(
    canonical=CanonicalConfig(width=24, height=18), network=NetworkConfig(channels=(4, 4), features=8, hidden=8)
)
SOURCE = "sim://street?seed=4&seconds=1.2&camera=pinhole:24x18:75&height=2"


@pytest.fixture(scope="module")
def recording():
    return open_source(SOURCE)


@pytest.fixture(scope="module")
def model():
    return bundle.untrained(3, SMALL, "small")


def test_the_estimates_are_those_that_the_service_publishes(recording, model, tmp_path):
    path = tmp_path / "small.safetensors"
    bundle.save(model, path)
    stream = Stream("cam0", ModelSlot(str(path)))
    stream.set_camera(recording.camera("cam0"))
    published = []
    for seq, piece in enumerate(slices(recording.chunks())):
        packet = EventPacket("cam0", seq, recording.sensor, piece.t0_us, piece.events)
        published += stream.accept(packet, Arrival(0, 0))
    estimates = estimate_recording(Estimator(model), recording)
    assert estimates.start_us.tolist() == [one.start_us for one in published]
    assert estimates.events.tolist() == [one.events for one in published]
    np.testing.assert_array_equal(estimates.twists, np.array([one.twists for one in published]))
    assert 0 < estimates.firing_rate["all"] < 1
    assert set(estimates.firing_rate) == {"block 1", "block 2", "cell 1", "cell 2", "all"}


def test_each_bin_is_paired_with_the_truth_of_its_own_time(recording, model):
    evaluation = evaluate(estimate_recording(Estimator(model), recording), recording.twists())
    assert evaluation.end_us[0] == 510_000  # the first half second is skipped
    middle = recording.trajectory.twist((evaluation.end_us - 5_000) / 1e6)
    np.testing.assert_allclose(evaluation.truth, middle, atol=2e-3)


def test_windows_without_truth_are_left_out_and_an_error_says_if_none_remains(recording, model):
    estimates, whole = estimate_recording(Estimator(model), recording), recording.twists()
    part = Twists(whole.t[:901], whole.twist[:901])
    assert evaluate(estimates, part).end_us[-1] == 900_000
    with pytest.raises(NoTruth, match=r"none of its \d+ windows lies after the first 0.5 s and within the truth"):
        evaluate(estimates, Twists(whole.t[:300], whole.twist[:300]))


def test_the_estimate_of_a_model_per_metre_is_scaled_by_the_height_of_the_camera(recording, model):
    per_height = estimate_recording(Estimator(replace(model, linear_unit=PER_HEIGHT)), recording)
    plain = estimate_recording(Estimator(model), recording)
    np.testing.assert_allclose(per_height.twists, plain.twists * [2, 2, 2, 1, 1, 1])
    assert per_height.scaled


def test_without_a_height_the_estimate_assumes_one_metre(recording, model):
    estimator = Estimator(replace(model, linear_unit=PER_HEIGHT))
    camera = recording.camera("cam0").model_copy(update={"height_m": None})
    events = next(recording.since(0))
    pushed = [
        made.push(events, made.initial_state(recording.sensor, camera), 100_000).estimates
        for made in (estimator, Estimator(model))
    ]
    assert pushed[0]
    for a, b in zip(*pushed, strict=True):
        np.testing.assert_array_equal(a.twists, b.twists)


def test_a_bundle_keeps_its_linear_unit_and_an_old_bundle_is_in_metres_per_second(model, tmp_path):
    path = tmp_path / "a.safetensors"
    bundle.save(replace(model, linear_unit=PER_HEIGHT), path)
    assert bundle.load(path).linear_unit == PER_HEIGHT
    old = model.to_bytes().replace(b',\\"linear_unit\\":\\"m/s\\"', b"")
    padded = int.from_bytes(old[:8], "little") - (len(model.to_bytes()) - len(old))
    assert bundle.from_bytes(padded.to_bytes(8, "little") + old[8:], "old").linear_unit == "m/s"


def test_the_report_has_figures_of_constant_predictors(recording, model):
    evaluation = evaluate(estimate_recording(Estimator(model), recording), recording.twists())
    figures = report([evaluation, evaluation])
    assert figures["zero"]["re_v_l"] == pytest.approx(1)
    assert figures["mean"]["r2_v_l"] == pytest.approx(0, abs=1e-9)
    assert figures["windows"] == 2 * figures["recordings"][0]["windows"]
    for key in ("rmse_v_l_m_s", "rmse_v_a_deg_s", "re_v_l", "re_v_a", "per_axis", "windows", "firing_rate"):
        assert key in figures
