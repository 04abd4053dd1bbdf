import json

import numpy as np
import pytest

from neurove_core.config import CanonicalConfig, ModelConfig, NetworkConfig
from neurove_core.experiments import repriming
from neurove_core.models import bundle
from neurove_protocol.errors import InvalidField


@pytest.fixture(scope="module")
def results(tmp_path_factory):
    config = ModelConfig(
        canonical=CanonicalConfig(width=22, height=16, hfov_deg=80),
        network=NetworkConfig(channels=(4, 8), features=16, hidden=16),
    )
    path = tmp_path_factory.mktemp("model") / "small.safetensors"
    bundle.save(bundle.untrained(3, config, "small"), path)
    names = []
    found = repriming.run(str(path), streets=1, primed=(2, 24), progress=names.append)
    assert len(names) == 1
    return found


def test_a_model_that_replayed_windows_is_more_settled_than_one_from_rest(results):
    first = {way: errors[0] for way, errors in results.errors.items()}
    assert list(first) == ["cold", "carried", "primed 2", "primed 24"]
    assert first["primed 24"] < first["cold"]
    assert all(len(errors) == repriming.AFTER for errors in results.errors.values())
    assert all(results.worst[way][0] >= first[way] for way in first)


def test_the_error_against_the_truth_stands_beside_in_its_units(results):
    for unit in ("m/s", "deg/s"):
        assert list(results.off_truth[unit]) == [repriming.NEVER, *results.errors]
    speed = results.off_truth["m/s"][repriming.NEVER]  # a model of drawn weights knows nothing of a car's speed
    assert 1 < np.mean(speed) < 30
    text = repriming.to_markdown(results)
    assert f"| never swapped | {speed[0]:.2f} / " in text


def test_the_least_number_of_windows_is_the_first_within_the_bound(results):
    within = [n for n in (2, 24) if results.errors[f"primed {n}"][0] <= repriming.SETTLED]
    assert results.least_primed == (within[0] if within else None)


def test_the_report_is_written_as_table_figures_and_picture(results, tmp_path):
    files = repriming.save(results, tmp_path)
    assert {file.name for file in files} == {f"repriming.{kind}" for kind in ("json", "md", "png", "svg")}
    told = json.loads((tmp_path / "repriming.json").read_text())
    assert told["errors"]["cold"][0] == pytest.approx(results.errors["cold"][0], abs=1e-5)
    assert "| primed 24 |" in (tmp_path / "repriming.md").read_text()


def test_without_streets_or_windows_there_is_nothing_to_measure():
    with pytest.raises(InvalidField, match="streets=0"):
        repriming.run(streets=0)
    with pytest.raises(InvalidField, match="primed=\\[0, 4\\]"):
        repriming.run(primed=(4, 0))
