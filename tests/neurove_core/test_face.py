"""The public face: every name loads, loads only what it needs, and six lines give estimates of a recording."""

import subprocess
import sys
from itertools import islice
from pathlib import Path

import numpy as np
import pytest

import neurove_core
from neurove_core import Estimator, load_model, models
from neurove_core.config import CanonicalConfig, ModelConfig, NetworkConfig, WindowConfig
from neurove_core.io.packets import slices
from neurove_core.models import bundle
from neurove_core.sources import open_source
from neurove_protocol.errors import BadModel

SMALL = ModelConfig(
    window=WindowConfig(duration_us=10_000, bins=2),
    canonical=CanonicalConfig(width=16, height=12),
    network=NetworkConfig(channels=(4, 6), features=8, hidden=8),
)
WINDOWS = 40


@pytest.mark.parametrize("name", sorted(neurove_core.__all__))
def test_every_public_name_loads_and_is_documented(name):
    found = getattr(neurove_core, name)
    assert found.__doc__
    assert f"`{name}" in neurove_core.__doc__


@pytest.mark.parametrize("module", ["neurove_core", "neurove_core.io"])
def test_reading_recordings_does_not_load_torch(module):
    code = f"import sys, {module}; assert 'torch' not in sys.modules"
    subprocess.run([sys.executable, "-c", code], check=True)


def test_an_unknown_name_is_an_attribute_error():
    with pytest.raises(AttributeError, match="no attribute 'GRU'"):
        _ = neurove_core.GRU


def test_a_model_is_loaded_by_its_name_or_from_its_file(tmp_path: Path):
    file = tmp_path / "small.safetensors"
    bundle.save(bundle.untrained(3, SMALL, name="small"), file)
    assert load_model("default") is models.find("default")
    assert load_model(file).name == load_model(str(file)).name == "small"
    with pytest.raises(BadModel, match="No such file"):
        load_model(tmp_path / "missing.safetensors")


def test_estimates_of_a_recording_are_those_of_its_packets_one_for_each_complete_window():
    estimator, recording = Estimator(bundle.untrained(0, SMALL)), open_source("pattern://?seed=3")
    found = list(islice(estimator.estimates(recording), WINDOWS))  # the pattern is endless
    state, pushed = estimator.initial_state(recording.sensor, recording.camera("cam0")), []
    for piece in slices(recording.chunks()):
        result = estimator.push(piece.events, state, piece.t0_us)
        state, pushed = result.state, pushed + result.estimates
        if len(pushed) >= WINDOWS:
            break
    assert np.diff([one.start_us for one in found]).tolist() == [10_000] * (WINDOWS - 1)
    for one, other in zip(found, pushed, strict=False):
        assert one.start_us == other.start_us
        np.testing.assert_array_equal(one.twists, other.twists)
