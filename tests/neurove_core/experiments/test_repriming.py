"""The repriming experiment: errors after a model swap, by start state, written as tables and figures."""

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


def test_a_primed_model_has_a_smaller_error_than_one_from_the_zero_state(results):
    first = {start: errors[0] for start, errors in results.errors.items()}
    assert list(first) == ["cold", "carried", "primed 2", "primed 24"]
    assert first["primed 24"] < first["cold"]
    assert all(len(errors) == repriming.AFTER for errors in results.errors.values())
    assert all(results.worst[start][0] >= first[start] for start in first)


def test_the_error_against_the_truth_is_given_in_m_s_and_deg_s(results):
    for unit in ("m/s", "deg/s"):
        assert list(results.off_truth[unit]) == [repriming.NEVER, *results.errors]
    speed = results.off_truth["m/s"][repriming.NEVER]  # a model with random weights cannot estimate the speed of a car
    assert 1 < np.mean(speed) < 30
    text = repriming.to_markdown(results)
    assert f"| never swapped | {speed[0]:.2f} / " in text


def test_least_primed_is_the_first_number_of_windows_within_the_bound(results):
    within = [n for n in (2, 24) if results.errors[f"primed {n}"][0] <= repriming.SETTLED]
    assert results.least_primed == (within[0] if within else None)


def test_the_results_are_written_as_tables_json_and_figure(results, tmp_path):
    files = repriming.save(results, tmp_path)
    assert {file.name for file in files} == {f"repriming.{kind}" for kind in ("json", "md", "png", "svg")}
    written = json.loads((tmp_path / "repriming.json").read_text())
    assert written["errors"]["cold"][0] == pytest.approx(results.errors["cold"][0], abs=1e-5)
    assert "| primed 24 |" in (tmp_path / "repriming.md").read_text()


def test_zero_streets_or_windows_are_refused():
    with pytest.raises(InvalidField, match="streets=0"):
        repriming.run(streets=0)
    with pytest.raises(InvalidField, match="primed=\\[0, 4\\]"):
        repriming.run(primed=(4, 0))
