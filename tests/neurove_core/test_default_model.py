"""The model that comes with the package: small, whole, and better than any predictor that sees nothing."""

from pathlib import Path

import pytest

from neurove_core import bundle, models
from neurove_core.estimator import Estimator
from neurove_core.evaluation import answer, judge, report
from neurove_core.io import open_source


def test_it_is_trained_small_and_says_how_it_was_made():
    found = models.find(models.DEFAULT)
    assert models.built_in()[0] is found
    assert found.trained
    assert found.provenance.startswith("neurove train default: ")
    file = Path(models.__file__).with_name("default.safetensors")
    assert file.stat().st_size <= 8 << 20
    assert bundle.load(file).digest == found.digest


@pytest.mark.parametrize("height_m", [0.5, 2.0])
def test_it_sees_how_fast_it_drives_from_any_height(height_m):
    source = f"sim://street?seed=7001&seconds=2.5&camera=pinhole:86x65:75&height={height_m}"
    recording = open_source(source)
    told = report([judge(answer(Estimator(models.find("default")), recording), recording.twists())])
    assert told["re_v_l"] < 0.4 < told["zero"]["re_v_l"]
    assert told["rmse_v_a_deg_s"] < 6
    assert told["scaled"]
