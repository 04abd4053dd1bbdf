"""The firing experiment: rates near the preparing study's, repeatable, and written as told."""

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
def test_rates_are_those_of_the_preparing_study_within_15_per_cent(results, neuron, kind, rate):
    assert results.rates[neuron][kind].mean == pytest.approx(rate, rel=0.15, abs=0.003)


@pytest.mark.parametrize("kind", firing.CURRENTS)
def test_alif_fires_more_than_lif_and_more_with_more_diffusion(results, kind):
    for reading in ("own v", "own v after reset", "neighbour v"):
        names = ["LIF", *(f"ALIF {reading}, D = {d:g}" for d in firing.DIFFUSIONS)]
        means = [results.rates[name][kind].mean for name in names]
        assert means == sorted(means)
        assert means[0] < means[1]


def test_the_literal_equation_6_is_alif_whose_leak_and_diffusion_make_one(results):
    assert results.rates["Eq. (6a) literal, no leak, D = 0"] == results.rates["ALIF own v after reset, D = 0.5"]


def test_the_same_seed_gives_the_same_numbers_and_another_one_others(results):
    assert firing.run(0) == results
    for kind in firing.CURRENTS:
        assert not torch.equal(firing.random_current(kind, 0), firing.random_current(kind, 1))


def test_lif_of_the_experiment_is_the_module_under_each_current(results):
    neurons = LIF(1).double()
    current = torch.stack([firing.random_current("ou", seed) for seed in range(firing.SEEDS)], dim=1)[..., None]
    steps, _ = neurons(current, neurons.initial_state(firing.SEEDS))
    assert steps.s.mean().item() == pytest.approx(results.rates["LIF"]["ou"].mean)


@pytest.mark.parametrize(("kind", "mean", "sd"), [("ou", 0.34, 0.28), ("normal", 0.33, 0.28), ("uniform", 0.5, 0.289)])
def test_a_random_current_has_the_law_it_says(kind, mean, sd):
    current = firing.random_current(kind, seed=3, steps=100_000)
    assert current.mean().item() == pytest.approx(mean, abs=0.02)
    assert current.std().item() == pytest.approx(sd, abs=0.02)
    correlation = torch.corrcoef(torch.stack((current[1:], current[:-1])))[0, 1].item()
    assert correlation == pytest.approx(0.9 if kind == "ou" else 0.0, abs=0.02)


def test_the_report_is_written_as_table_numbers_and_figure(results, tmp_path):
    pytest.importorskip("matplotlib")
    files = firing.save(results, tmp_path / "new" / "folder")
    assert [file.name for file in files] == ["firing.json", "firing.md", "firing.png", "firing.svg"]
    told = json.loads(files[0].read_text())
    assert told["rates"]["LIF"]["ou"]["mean"] == results.rates["LIF"]["ou"].mean
    assert told["command"] == "neurove reproduce firing --seed 0"
    assert "| LIF | 0.098" in files[1].read_text()
    assert files[2].read_bytes().startswith(b"\x89PNG")
    assert b"<svg" in files[3].read_bytes()


def test_without_matplotlib_the_error_names_the_extra_and_nothing_is_written(results, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "matplotlib.figure", None)
    monkeypatch.setitem(sys.modules, "matplotlib.backends.backend_agg", None)
    with pytest.raises(MissingExtra, match=r"matplotlib is not installed: pip install 'neurove\[experiments\]'"):
        firing.save(results, tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_wrong_values_are_named(results, tmp_path):
    with pytest.raises(InvalidField, match="seed=-1: must be at least 0"):
        firing.run(-1)
    with pytest.raises(InvalidField, match="kind='pink': must be one of ou, normal, uniform"):
        firing.random_current("pink", 0)
    (tmp_path / "file").touch()
    pytest.importorskip("matplotlib")
    with pytest.raises(InvalidField, match="out="):
        firing.save(results, tmp_path / "file")
