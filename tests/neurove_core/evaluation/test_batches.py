"""Recordings evaluated together give the estimates of each alone."""

import numpy as np
import pytest
import torch

from neurove_core.config import CanonicalConfig, ModelConfig, NetworkConfig
from neurove_core.estimator import Estimator
from neurove_core.evaluation.estimates import estimate_recording, estimate_recordings
from neurove_core.models import bundle
from neurove_core.networks.device import TOLERANCE, DeviceRunner, difference
from neurove_core.sources import open_source

CAMERA = "camera=pinhole:24x18:75"
URLS = (
    f"sim://street?seed=20020&seconds=0.5&{CAMERA}&imu=200",
    f"sim://street?seed=20021&seconds=0.04&{CAMERA}",  # no window
    f"sim://room?seed=20022&seconds=0.3&{CAMERA}",
    f"sim://street?seed=20023&seconds=0.4&{CAMERA}",
)


class Kept:
    """A simulated recording that is rendered once."""

    def __init__(self, url):
        self._source = open_source(url)
        self._chunks = list(self._source.chunks())

    def __getattr__(self, name):
        return getattr(self._source, name)

    def chunks(self):
        return iter(self._chunks)


@pytest.fixture(scope="module")
def recordings():
    return [Kept(url) for url in URLS]


@pytest.fixture(scope="module", params=[(), (2, 4)], ids=["one scale", "three scales"])
def model(request):
    network = NetworkConfig(channels=(8, 16), features=16, hidden=16, v_th=0.4)
    config = ModelConfig(canonical=CanonicalConfig(width=24, height=18), network=network, scales=request.param)
    return bundle.untrained(20_024, config)


def assert_same(one, other, tolerance):
    assert one.name == other.name
    np.testing.assert_array_equal(one.start_us, other.start_us)
    np.testing.assert_array_equal(one.events, other.events)
    assert one.sources == other.sources
    assert one.firing_rate.keys() == other.firing_rate.keys()
    assert difference(one.twists, other.twists) <= tolerance


@pytest.mark.parametrize("at_once", [2, 64])
def test_recordings_in_one_batch_are_estimated_as_each_alone_bit_for_bit(model, recordings, at_once):
    estimator, heard = Estimator(model), []
    found = estimate_recordings(estimator, recordings, heard.append, inertial=True, at_once=at_once)
    for one, recording in zip(found, recordings, strict=True):
        alone = estimate_recording(estimator, recording, inertial=True)
        assert_same(one, alone, 0.0)
        assert one.firing_rate == alone.firing_rate
    assert [len(one.start_us) > 0 for one in found] == [True, False, True, True]
    assert heard == sorted(heard)
    assert heard[-1] == sum(chunk.n for recording in recordings for chunk in recording.chunks())
    assert estimate_recordings(estimator, []) == []


def test_the_network_on_a_device_estimates_as_the_engine_within_the_tolerance(model, recordings):
    ours = estimate_recordings(Estimator(model, DeviceRunner(model.network, torch.device("cpu"))), recordings)
    for one, other in zip(ours, estimate_recordings(Estimator(model), recordings), strict=True):
        assert_same(one, other, TOLERANCE)
