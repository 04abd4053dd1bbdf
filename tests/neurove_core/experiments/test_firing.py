"""The firing experiment: rates close to the preliminary study, repeatable, written as tables and figures."""

import json
import sys

import pytest
import torch

from neurove_core import LIF
from neurove_core.experiments import firing
from neurove_core.extras import MissingExtra
from neurove_protocol.errors import InvalidField


@pytest.fixture(scope="module")
def results():
    return firing.run(0)


@pytest.mark.parametrize(
    ("neuron", "kind", "rate"),
    [(neuron, kind, rate) for neuron, of_kind in firing.STUDY.items() for kind, rate in of_kind.items()],
)
def test_rates_are_within_15_percent_of_the_preliminary_study(results, neuron, kind, rate):
    assert results.rates[neuron][kind].mean == pytest.approx(rate, rel=0.15, abs=0.003)


@pytest.mark.parametrize("kind", firing.CURRENTS)
def test_alif_fires_more_than_lif_and_more_with_more_diffusion(results, kind):
    for reading in ("own v", "own v after reset", "neighbour v"):
        names = ["LIF", *(f"ALIF {reading}, D = {d:g}" for d in firing.DIFFUSIONS)]
        means = [results.rates[name][kind].mean for name in names]
        assert means == sorted(means)
        assert means[0] < means[1]


def test_the_literal_equation_6_is_alif_whose_leak_and_diffusion_add_up_to_one(results):
    assert results.rates["Eq. (6a) literal, no leak, D = 0"] == results.rates["ALIF own v after reset, D = 0.5"]


def test_the_same_seed_gives_the_same_rates_and_another_seed_other_currents(results):
    assert firing.run(0) == results
    for kind in firing.CURRENTS:
        assert not torch.equal(firing.random_current(kind, 0), firing.random_current(kind, 1))


def test_the_lif_rate_is_that_of_the_lif_module(results):
    neurons = LIF(1).double()
    current = torch.stack([firing.random_current("ou", seed) for seed in range(firing.SEEDS)], dim=1)[..., None]
    steps, _ = neurons(current, neurons.initial_state(firing.SEEDS))
    assert steps.s.mean().item() == pytest.approx(results.rates["LIF"]["ou"].mean)


@pytest.mark.parametrize(("kind", "mean", "sd"), [("ou", 0.34, 0.28), ("normal", 0.33, 0.28), ("uniform", 0.5, 0.289)])
def test_a_random_current_has_its_documented_distribution(kind, mean, sd):
    current = firing.random_current(kind, seed=3, steps=100_000)
    assert current.mean().item() == pytest.approx(mean, abs=0.02)
    assert current.std().item() == pytest.approx(sd, abs=0.02)
    correlation = torch.corrcoef(torch.stack((current[1:], current[:-1])))[0, 1].item()
    assert correlation == pytest.approx(0.9 if kind == "ou" else 0.0, abs=0.02)


def test_the_results_are_written_as_table_json_and_figure(results, tmp_path):
    pytest.importorskip("matplotlib")
    files = firing.save(results, tmp_path / "new" / "folder")
    assert [file.name for file in files] == ["firing.json", "firing.md", "firing.png", "firing.svg"]
    written = json.loads(files[0].read_text())
    assert written["rates"]["LIF"]["ou"]["mean"] == results.rates["LIF"]["ou"].mean
    assert written["command"] == "neurove reproduce firing --seed 0"
    assert "| LIF | 0.098" in files[1].read_text()
    assert files[2].read_bytes().startswith(b"\x89PNG")
    assert b"<svg" in files[3].read_bytes()


def test_without_matplotlib_the_error_names_the_extra_and_nothing_is_written(results, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "matplotlib.figure", None)
    monkeypatch.setitem(sys.modules, "matplotlib.backends.backend_agg", None)
    with pytest.raises(MissingExtra, match=r"matplotlib is not installed: pip install 'neurove\[experiments\]'"):
        firing.save(results, tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_errors_name_the_wrong_value(results, tmp_path):
    with pytest.raises(InvalidField, match="seed=-1: must be at least 0"):
        firing.run(-1)
    with pytest.raises(InvalidField, match="kind='pink': must be one of ou, normal, uniform"):
        firing.random_current("pink", 0)
    (tmp_path / "file").touch()
    pytest.importorskip("matplotlib")
    with pytest.raises(InvalidField, match="out="):
        firing.save(results, tmp_path / "file")
